"""Settings of the artifact store."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ArtifactsConfig:
    """Where artifacts live.

    Attributes:
        root: directory (relative to the working directory) or `s3://bucket/prefix`.
        wait: seconds to wait for another process that writes the same artifact.
        reference: folder of the reference results; default: those that come with wbm.
    """

    root: str = "artifacts"
    wait: float = 0.0
    reference: str | None = None

    def __post_init__(self) -> None:
        if not self.root:
            raise ValueError("root is empty; give a directory or an s3:// URL")
        if self.wait < 0:
            raise ValueError(f"wait is {self.wait} s; it cannot be negative")

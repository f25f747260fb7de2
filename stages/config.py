"""The root of the configuration: one frozen dataclass, a field for each section.

A section's dataclass lives beside its consumer in a module without heavy imports (no torch, warp or mujoco), so that
`wbm plan` stays fast. Adding a section is an import, a field, and, where it has presets, a group in `conf/`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from wbm.artifacts.config import ArtifactsConfig


@dataclass(frozen=True)
class Config:
    """Everything that can be set on the command line.

    Attributes:
        seed: the seed from which all others derive.
        note: free text for the manifest; never part of a key.
        policy: what to evaluate or export, as `kind/name[/key]` or `reference/name`; default: the student.
        inputs: input slot -> artifact to use in place of the newest one.
        teachers: the suite: names of presets in `conf/teacher/`.
    """

    seed: int = 0
    note: str | None = None
    policy: str | None = None
    inputs: dict[str, str] = field(default_factory=dict)
    teachers: tuple[str, ...] = ("top_down", "side")
    artifacts: ArtifactsConfig = field(default_factory=ArtifactsConfig)

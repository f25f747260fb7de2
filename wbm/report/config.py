"""The evaluation protocol as configuration."""

from __future__ import annotations

from dataclasses import dataclass, field

SPLITS = ("train", "test", "all")


@dataclass(frozen=True)
class EvaluationConfig:
    """Values of `conf/evaluation/*.yaml`.

    Attributes:
        episodes: number of episodes; episode i depends on `seed` and i alone.
        seed: seed of the protocol.
        split: objects to grasp: `train`, `test` or `all`.
        num_envs: environments that run side by side.
        start: `whole_body`, or `local` at the pre-grasp (what a teacher was trained on).
        condition: what a student is given of its target: `both`, the `mask` alone or the `text` alone.
        workers: processes; does not change the result.
        videos: episodes to film, as many successes as failures where there are both.
        video_width, video_height: size of a film, pixels (even).
        video_fps: frames a second of the film.
        filmstrips: successful episodes shown as a strip of key frames.
        record_episodes: episodes stored as Zarr and MCAP.
        embed_mb: largest total size of the videos inside the page, MB.
    """

    episodes: int = 300
    seed: int = 1
    split: str = "test"
    num_envs: int = 32
    start: str = "whole_body"
    condition: str = "both"
    workers: int = field(default=2, metadata={"key": False})
    videos: int = 8
    video_width: int = 480
    video_height: int = 360
    video_fps: float = 12.5
    filmstrips: int = 2
    record_episodes: int = 2
    embed_mb: float = 24.0

    def __post_init__(self) -> None:
        if self.split not in SPLITS:
            raise ValueError(f"evaluation.split is {self.split!r}, must be one of {', '.join(SPLITS)}")
        for name, allowed in (("start", ("whole_body", "local")), ("condition", ("both", "mask", "text"))):
            if getattr(self, name) not in allowed:
                raise ValueError(f"evaluation.{name} is {getattr(self, name)!r}, must be one of {', '.join(allowed)}")
        for name in ("episodes", "num_envs", "workers", "video_fps"):
            if not getattr(self, name) > 0:
                raise ValueError(f"evaluation.{name} is {getattr(self, name)}, must be positive")
        for name in ("videos", "filmstrips", "record_episodes", "embed_mb"):
            if getattr(self, name) < 0:
                raise ValueError(f"evaluation.{name} is {getattr(self, name)}, must not be negative")
        for name in ("video_width", "video_height"):
            if getattr(self, name) < 16 or getattr(self, name) % 2:
                raise ValueError(f"evaluation.{name} is {getattr(self, name)}, must be even and at least 16 (H.264)")

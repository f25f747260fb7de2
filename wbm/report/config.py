"""The evaluation protocol as configuration."""

from __future__ import annotations

from dataclasses import dataclass

SPLITS = ("train", "test", "all")


@dataclass(frozen=True)
class EvaluationConfig:
    """Values of `conf/evaluation/*.yaml`.

    Attributes:
        episodes: number of episodes; episode i depends on `seed` and i alone.
        seed: seed of the protocol.
        split: objects to grasp: `train`, `test` or `all`.
        num_envs: environments that run side by side.
        max_time_s: an episode that has not succeeded by then fails with `timeout`, s.
        lift_height_m: height above the start that counts as lifted, m.
        hold_time_s: how long the object must stay lifted, s.
        distractors: distractor objects in each scene, at most.
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
    max_time_s: float = 16.0
    lift_height_m: float = 0.10
    hold_time_s: float = 1.0
    distractors: int = 2
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
        for name in ("episodes", "num_envs", "max_time_s", "lift_height_m", "hold_time_s", "video_fps"):
            if not getattr(self, name) > 0:
                raise ValueError(f"evaluation.{name} is {getattr(self, name)}, must be positive")
        for name in ("distractors", "videos", "filmstrips", "record_episodes", "embed_mb"):
            if getattr(self, name) < 0:
                raise ValueError(f"evaluation.{name} is {getattr(self, name)}, must not be negative")
        for name in ("video_width", "video_height"):
            if getattr(self, name) < 16 or getattr(self, name) % 2:
                raise ValueError(f"evaluation.{name} is {getattr(self, name)}, must be even and at least 16 (H.264)")

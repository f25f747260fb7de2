"""Settings of rollout generation: values only."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class NoiseConfig:
    """Noise on what is executed, while the recorded action stays clean: x' = correlation x + N(0, innovation * scale).

    Attributes:
        correlation: of the first-order process from step to step.
        innovation: share of the scale that enters in a step.
        scale: base, arm, hand and neck joints, m or rad.
        levels: an episode's noise is one of these factors of the scale, drawn uniformly.
        free: further factor in free space, where larger errors than in contact can be mended.
        spell: mean number of steps that noise lasts, and that it then pauses, so that its effects are seen mended; 0
            never pauses.
    """

    correlation: float = 0.85
    innovation: float = 0.25
    scale: tuple[float, float, float, float] = (0.012, 0.03, 0.06, 0.04)
    levels: tuple[float, ...] = (0.0, 0.5, 1.0, 1.5)
    free: float = 2.0
    spell: float = 20.0

    def __post_init__(self) -> None:
        if not 0 <= self.correlation < 1:
            raise ValueError(f"rollouts.noise.correlation must be in [0, 1), not {self.correlation}")
        if not self.levels or min(*self.levels, *self.scale, self.innovation, self.free) < 0:
            raise ValueError("rollouts.noise: levels needs a factor, and nothing may be negative")
        if self.spell != 0 and self.spell < 1:
            raise ValueError(f"rollouts.noise.spell must be 0 or at least one step, not {self.spell}")


@dataclass(frozen=True)
class RolloutsConfig:
    """How the dataset is made. A shard is the unit of work and of resume.

    Attributes:
        shards: number of shards.
        episodes: episodes tried in a shard.
        num_envs: environments that run side by side in a process.
        workers: processes; does not change the result.
        pregrasp_share: share of the episodes that start at the pre-grasp.
        scatter_share: share that starts off the usual path, so that the student learns the way back (`env.scatter`).
        keep: `successes`, or `all` for a short pipeline whose teacher has hardly learned.
        physics: `evaluate` (fine physics) or `train` (the physics that teachers learn in, faster).
        seed_offset: added to the seed, so that rollouts never repeat the episodes of training or evaluation.
        samples: episodes of the first shard that are also written as MCAP.
        noise: what is injected into the executed action.
    """

    shards: int = 8
    episodes: int = 96
    num_envs: int = 48
    workers: int = field(default=2, metadata={"key": False})
    pregrasp_share: float = 0.2
    scatter_share: float = 0.4
    keep: str = "successes"
    physics: str = "evaluate"
    seed_offset: int = 10_000
    samples: int = 2
    noise: NoiseConfig = field(default_factory=NoiseConfig)

    def __post_init__(self) -> None:
        if min(self.shards, self.episodes, self.num_envs, self.workers) < 1:
            raise ValueError("rollouts: shards, episodes, num_envs and workers must be at least 1")
        if self.keep not in ("successes", "all"):
            raise ValueError(f"rollouts.keep={self.keep}: use successes or all")
        if self.physics not in ("evaluate", "train"):
            raise ValueError(f"rollouts.physics={self.physics}: use evaluate or train")
        if min(self.pregrasp_share, self.scatter_share) < 0 or self.pregrasp_share + self.scatter_share > 1:
            raise ValueError(
                "rollouts.pregrasp_share and rollouts.scatter_share must be in [0, 1] together, not "
                f"{self.pregrasp_share} and {self.scatter_share}"
            )

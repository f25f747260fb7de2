"""Settings of the ablation sweep behind Figure 4 of the paper: values only."""

from __future__ import annotations

from dataclasses import dataclass, field

ARMS = ("full", "no_active_vision", "joint_space")
"""Names of the presets in `conf/env/` that make an arm."""
READINGS = ("rl", "student", "both")


@dataclass(frozen=True)
class Figure4Config:
    """The sweep: every arm with every seed, all with the same budget.

    Attributes:
        reading: `rl` (one policy a run, trained by PPO on the whole-body episode), `student` (a distilled student an
            arm) or `both`.
        arms: which arms are run.
        seeds: runs of each arm in the RL reading.
        env_steps: environment steps of a run, approach included.
        num_envs: environments in parallel.
        supports: kinds of scene.
        grasps: approaches of the scenes' pre-grasps.
        reach_far: weight of the part of the reaching reward that is felt from the start pose; the same in every arm.
        evaluations: deterministic evaluations on training objects along a run.
        eval_episodes: episodes of each of them.
        episodes: episodes of the final evaluation of a run, on held-out objects and in fine physics.
        eval_envs: environments of the evaluations.
        arm, seed: the run at hand; the command sets them.
    """

    reading: str = field(default="rl", metadata={"key": False})
    arms: tuple[str, ...] = field(default=ARMS, metadata={"key": False})
    seeds: int = field(default=3, metadata={"key": False})
    env_steps: int = 1_000_000
    num_envs: int = 128
    supports: tuple[str, ...] = ("table", "bin")
    grasps: tuple[str, ...] = ("top_down",)
    reach_far: float = 0.5
    evaluations: int = 4
    eval_episodes: int = 48
    episodes: int = 100
    eval_envs: int = 50
    arm: str = "full"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.reading not in READINGS:
            raise ValueError(f"figure4.reading is {self.reading!r}; choose one of {', '.join(READINGS)}")
        unknown = [a for a in (*self.arms, self.arm) if a not in ARMS]
        if unknown or not self.arms or len(set(self.arms)) < len(self.arms):
            raise ValueError(f"figure4.arms must name each of {', '.join(ARMS)} at most once")
        for name in ("seeds", "env_steps", "num_envs", "evaluations", "eval_episodes", "episodes", "eval_envs"):
            if getattr(self, name) < 1:
                raise ValueError(f"figure4.{name} must be at least 1, not {getattr(self, name)}")
        if self.reach_far < 0:
            raise ValueError(f"figure4.reach_far must not be negative, not {self.reach_far}")

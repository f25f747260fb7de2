"""Settings of learning: values only, so that the command line can read them without torch."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TeacherConfig:
    """Which teacher is trained and for how long.

    Attributes:
        name: the artifact's name, such as `top_down`.
        grasp: approach of its pre-grasps, `top_down` or `side`.
        supports: kinds of scene that it learns on.
        split: objects that it learns on.
        eval_split: objects of the periodic evaluation.
        num_envs: environments in parallel.
        iterations: PPO iterations at most.
        eval_every: iterations between deterministic evaluations.
        eval_episodes: episodes of one evaluation.
        eval_envs: environments of the evaluation.
        patience: stop after this many evaluations without a better one; 0 never stops early.
        target: stop once an evaluation reaches this success rate (1.01 never does).
        checkpoint_every: iterations between checkpoints.
        curriculum: how much more often families of objects that fail are drawn: 0 draws scenes evenly, 1 in proportion
            to a family's failure rate (plus a floor).
    """

    name: str = "top_down"
    grasp: str = "top_down"
    supports: tuple[str, ...] = ("table", "bin")
    split: str = "train"
    eval_split: str = "val"
    num_envs: int = 128
    iterations: int = 400
    eval_every: int = 100
    eval_episodes: int = 128
    eval_envs: int = 64
    patience: int = 6
    target: float = 1.01
    checkpoint_every: int = 1
    curriculum: float = 1.0

    def __post_init__(self) -> None:
        if self.grasp not in ("top_down", "side"):
            raise ValueError(f"teacher.grasp is {self.grasp!r}; choose top_down or side")
        for name in ("num_envs", "iterations", "eval_every", "eval_episodes", "eval_envs", "checkpoint_every"):
            if getattr(self, name) < 1:
                raise ValueError(f"teacher.{name} must be at least 1, not {getattr(self, name)}")
        if not 0 <= self.curriculum <= 1:
            raise ValueError(f"teacher.curriculum must lie in [0, 1], not {self.curriculum}")
        if self.patience < 0:
            raise ValueError(f"teacher.patience must be 0 (never stop) or more, not {self.patience}")


@dataclass(frozen=True)
class PpoConfig:
    """Proximal policy optimisation (Schulman et al. 2017).

    Attributes:
        steps: environment steps of one iteration.
        epochs: passes over an iteration's data.
        minibatches: minibatches of a pass.
        hidden: widths of the hidden layers of actor and critic.
        activation: hidden activation.
        gamma: discount.
        lam: GAE parameter.
        clip: clipping of the probability ratio.
        lr: first learning rate.
        schedule: `adaptive` follows `desired_kl`, `linear` falls from `lr` to `lr_final` of it, `fixed` keeps `lr`.
        lr_final: share of `lr` that the `linear` schedule ends with.
        desired_kl: divergence that the adaptive schedule aims at.
        entropy: entropy bonus at the start; it falls linearly to 0 at the last iteration.
        value_coef: weight of the value loss.
        max_grad_norm: gradient clipping.
        init_std: first standard deviation of the actions.
        clip_value: clip the value loss too.
    """

    steps: int = 32
    epochs: int = 4
    minibatches: int = 8
    hidden: tuple[int, ...] = (256, 128, 64)
    activation: str = "elu"
    gamma: float = 0.98
    lam: float = 0.95
    clip: float = 0.2
    lr: float = 4e-4
    schedule: str = "linear"
    lr_final: float = 0.1
    desired_kl: float = 0.02
    entropy: float = 0.0005
    value_coef: float = 1.0
    max_grad_norm: float = 1.0
    init_std: float = 0.55
    clip_value: bool = False

    def __post_init__(self) -> None:
        if self.schedule not in ("adaptive", "linear", "fixed"):
            raise ValueError(f"ppo.schedule is {self.schedule!r}; choose adaptive, linear or fixed")
        if not (0 < self.gamma <= 1 and 0 < self.lam <= 1):
            raise ValueError(f"ppo.gamma ({self.gamma}) and ppo.lam ({self.lam}) must lie in (0, 1]")
        for name in ("steps", "epochs", "minibatches", "lr", "desired_kl", "init_std"):
            if getattr(self, name) <= 0:
                raise ValueError(f"ppo.{name} must be positive, not {getattr(self, name)}")

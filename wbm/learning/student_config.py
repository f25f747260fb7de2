"""Configuration of the student and of its distillation (no heavy imports)."""

from __future__ import annotations

from dataclasses import dataclass, field

_LARGEST = 8192  # a specification from a stranger must not ask for all memory


@dataclass(frozen=True)
class StudentConfig:
    """Sizes of the student network.

    Attributes:
        width: of every token.
        layers: transformer layers.
        heads: attention heads; divides `width`.
        feedforward: hidden width of a layer's feed-forward block.
        point_width: hidden width of the point encoders.
        attention_tokens: attention-pooled tokens of the depth cloud.
        proprio_tokens: tokens of the proprioceptive state.
        lidar_tokens: tokens of the LiDAR cloud; 0 leaves the LiDAR out.
        chunk: actions predicted at once; the first is the one of now.
        local_radius: metres; points nearer than this describe a point's surroundings; 0 leaves them out.
        use_prev_action: whether the action of the step before is an input. It foretells the next one so well that a
            student given it learns to repeat it, and then never starts to move.
        use_velocity: whether joint velocities are an input; they foretell the next action too.
        use_text: whether the instruction is.
        use_mask: whether the target mask is.
    """

    width: int = 96
    layers: int = 2
    heads: int = 4
    feedforward: int = 288
    point_width: int = 64
    attention_tokens: int = 6
    proprio_tokens: int = 4
    lidar_tokens: int = 1
    chunk: int = 1
    local_radius: float = 0.06
    use_prev_action: bool = False
    use_velocity: bool = False
    use_text: bool = True
    use_mask: bool = True

    def __post_init__(self) -> None:
        least = {"lidar_tokens": 0}
        for name in (
            "width",
            "layers",
            "heads",
            "feedforward",
            "point_width",
            "attention_tokens",
            "proprio_tokens",
            "lidar_tokens",
            "chunk",
        ):
            low, value = least.get(name, 1), getattr(self, name)
            if not low <= value <= _LARGEST:
                raise ValueError(f"student.{name} must lie in [{low}, {_LARGEST}], is {value}")
        if self.width % self.heads:
            raise ValueError(f"student.width {self.width} must be a multiple of student.heads {self.heads}")
        if self.local_radius < 0:
            raise ValueError(f"student.local_radius must not be negative, is {self.local_radius}")
        if not (self.use_text or self.use_mask):
            raise ValueError("student.use_text and student.use_mask are both off: nothing tells the student its target")


@dataclass(frozen=True)
class AugmentConfig:
    """What is done to a stored observation before the student sees it. Shares and probabilities are in [0, 1].

    Attributes:
        point_dropout: each cloud loses a share of its points drawn from 0 to this.
        cloud_dropout: probability that a whole cloud is lost.
        depth_noise: metres of Gaussian noise on depth points, at 1 m; grows with the square of the distance.
        lidar_noise: metres of Gaussian noise on LiDAR points.
        brightness: colours are scaled by 1 +- up to this.
        mask_drop: probability that no target mask is given.
        text_drop: probability that no instruction is given, where the mask is.
        mask_miss: a given mask loses a share of its points drawn from 0 to this.
        mask_spill: probability that a given mask also covers a patch elsewhere.
        mask_swap: probability that a given mask covers a patch elsewhere instead, where the instruction is given.
        patch_radius: metres, of the patches.
    """

    point_dropout: float = 0.3
    cloud_dropout: float = 0.02
    depth_noise: float = 0.003
    lidar_noise: float = 0.01
    brightness: float = 0.15
    mask_drop: float = 0.35
    text_drop: float = 0.25
    mask_miss: float = 0.4
    mask_spill: float = 0.1
    mask_swap: float = 0.02
    patch_radius: float = 0.04

    def __post_init__(self) -> None:
        for name in (
            "point_dropout",
            "cloud_dropout",
            "brightness",
            "mask_drop",
            "text_drop",
            "mask_miss",
            "mask_spill",
            "mask_swap",
        ):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"distill.augment.{name} must lie in [0, 1], is {getattr(self, name)}")
        for name in ("depth_noise", "lidar_noise", "patch_radius"):
            if getattr(self, name) < 0:
                raise ValueError(f"distill.augment.{name} must not be negative, is {getattr(self, name)}")


@dataclass(frozen=True)
class DistillConfig:
    """Training of the student, equation (8) and what is added to it.

    Attributes:
        iterations: gradient steps of behaviour cloning (fixed: a time budget would not be reproducible).
        batch_size: samples a step.
        lr: learning rate after the warm-up.
        lr_final: share of `lr` that the cosine ends at.
        warmup: steps of linear warm-up.
        weight_decay: of AdamW.
        clip: largest gradient norm.
        ema: decay of the averaged weights, which are the student.
        beta: smooth L1 turns linear at this error, in action units.
        neck_weight: weight of the neck's loss.
        contact_gain: arm and hand weigh 1 + gain * sigmoid((distance - d) / width).
        contact_distance: metres, see `contact_gain`.
        contact_width: metres, see `contact_gain`.
        p_obj_weight: weight of the squared error [1/m^2] of the object's position.
        p_obj_cap: largest value of that term.
        mask_weight: weight of the target mask's cross-entropy.
        data_share: share of the episodes that are used, for ablations.
        max_noise: episodes with more noise injected than this are left out, for ablations.
        pregrasp_share: share of a batch taken from episodes that start at the pre-grasp, when there are any.
        val_share: share of episodes held out for the validation curve.
        val_every: steps between points of the validation curve.
        val_batches: batches of a validation.
        checkpoint_every: steps between checkpoints.
        threads: of torch; part of the determinism class.
        workers: processes that load batches; does not change the result.
        seed: of weights, batches and augmentation.
        device: "cpu" or "cuda".
        dagger_rounds: rounds after behaviour cloning in which the student acts, controller and teachers say what they
            would have done, and training goes on with that too (Ross et al. 2011).
        dagger_episodes: episodes a round.
        dagger_iterations: gradient steps a round.
        dagger_lr: learning rate of the rounds, as a share of `lr`.
        augment: changes to the observations.
    """

    iterations: int = 6000
    batch_size: int = 192
    lr: float = 1e-3
    lr_final: float = 0.03
    warmup: int = 100
    weight_decay: float = 1e-4
    clip: float = 1.0
    ema: float = 0.999
    beta: float = 0.5
    neck_weight: float = 2.0
    contact_gain: float = 3.0
    contact_distance: float = 0.15
    contact_width: float = 0.02
    p_obj_weight: float = 100.0
    p_obj_cap: float = 4.0
    mask_weight: float = 0.2
    data_share: float = 1.0
    max_noise: float = 1e9
    pregrasp_share: float = 0.3
    val_share: float = 0.05
    val_every: int = 500
    val_batches: int = 4
    checkpoint_every: int = 100
    threads: int = 2
    workers: int = field(default=0, metadata={"key": False})
    seed: int = 0
    device: str = "cpu"
    dagger_rounds: int = 0
    dagger_episodes: int = 384
    dagger_iterations: int = 1000
    dagger_lr: float = 0.3
    augment: AugmentConfig = field(default_factory=AugmentConfig)

    def __post_init__(self) -> None:
        for name in (
            "iterations",
            "batch_size",
            "val_every",
            "val_batches",
            "checkpoint_every",
            "threads",
            "dagger_episodes",
            "dagger_iterations",
        ):
            if getattr(self, name) < 1:
                raise ValueError(f"distill.{name} must be at least 1, is {getattr(self, name)}")
        for name in ("lr", "clip", "beta", "contact_width", "dagger_lr"):
            if getattr(self, name) <= 0:
                raise ValueError(f"distill.{name} must be positive, is {getattr(self, name)}")
        for name in ("data_share", "pregrasp_share", "val_share", "lr_final", "ema"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"distill.{name} must lie in [0, 1], is {getattr(self, name)}")
        for name in ("warmup", "workers", "dagger_rounds", "max_noise", "weight_decay", "p_obj_weight", "mask_weight"):
            if getattr(self, name) < 0:
                raise ValueError(f"distill.{name} must not be negative, is {getattr(self, name)}")
        if self.val_share >= 1.0:
            raise ValueError("distill.val_share 1 leaves nothing to train on")

    @property
    def total_iterations(self) -> int:
        """Gradient steps of behaviour cloning and all rounds."""
        return self.iterations + self.dagger_rounds * self.dagger_iterations

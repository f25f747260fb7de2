"""Settings of the grasping environments: values only."""

from __future__ import annotations

from dataclasses import dataclass, field

from wbm.envs.seen_config import SeenConfig


@dataclass(frozen=True)
class ActionConfig:
    """What a policy's action in [-1, 1] means.

    Attributes:
        term: `wbc` (six relative end-effector values executed by the controller, and the hand) or `joint` (32 joint
            targets; nothing else changes).
        hand: `mix` (16 joints, a common closure and a closure a finger) or `joints` (16 joints).
        ee_step: end-effector target motion at an action of 1, m a step.
        ee_turn: the same for rotation, rad a step.
        ee_leash: the target stays within this distance of the hand, m.
        ee_turn_leash: the same for rotation, rad.
        feed_forward: share of the target's own velocity that the controller is told.
        hand_step: hand joint motion at an action of 1, rad a step, for each joint's own value.
        closure_step: the same for the common closure.
        finger_step: the same for a finger's closure.
        hand_leash: hand targets stay within this angle of the joints, rad; bounds the grip force.
        body_step: joint target increments of base (m, m, rad), arm and neck at an action of 1 (`joint` term).
        body_leash: the same targets stay within this distance of the joints (`joint` term).
        neck: `gaze` (the controller looks at the target) or `fixed` (no active vision).
        limit: actions are clipped to +-limit.
    """

    term: str = "wbc"
    hand: str = "mix"
    ee_step: float = 0.015
    ee_turn: float = 0.06
    ee_leash: float = 0.06
    ee_turn_leash: float = 0.35
    feed_forward: float = 0.8
    hand_step: float = 0.06
    closure_step: float = 0.10
    finger_step: float = 0.08
    hand_leash: float = 0.5
    body_step: tuple[float, float, float] = (0.02, 0.05, 0.03)
    body_leash: tuple[float, float, float] = (0.10, 0.25, 0.15)
    neck: str = "gaze"
    limit: float = 1.0

    def __post_init__(self) -> None:
        for name, allowed in (("term", ("wbc", "joint")), ("hand", ("mix", "joints")), ("neck", ("gaze", "fixed"))):
            if getattr(self, name) not in allowed:
                raise ValueError(f"env.action.{name} is {getattr(self, name)!r}; choose one of {allowed}")
        if min(self.ee_step, self.ee_turn, self.ee_leash, self.ee_turn_leash, self.hand_leash, self.limit) <= 0:
            raise ValueError("env.action steps, leashes and limit must be positive")


@dataclass(frozen=True)
class RewardConfig:
    """Weights of equation (6) and the shape of its terms; every weight is multiplied by `scale`.

    Attributes:
        reach, contact, grasp, lift, stable, col, act, smooth: weights of the eight terms.
        drop: subtracted once when an episode ends early: dropped, out of reach or in a forbidden contact.
        scale: common factor, 1/step.
        reach_length: decay of the reaching term, m.
        reach_far, reach_far_length: weight within the reaching term of a part that is felt from afar, and its decay, m.
        enclose: share of the enclosing shape beside the contact pattern in the grasp term.
        lift_open: share of the lift term that is paid without opposition.
        goal_height: height above the settled height that the lift term asks for, m.
        goal_width: how sharply, m.
        overshoot_height, overshoot_width: the lift term decays above this height, m.
        drift_free, drift_width: it decays too beyond this horizontal distance from the settled place, m.
        hold: weight of holding the object above the success height inside the stability term.
        hold_speed, hold_turn: speeds in the world at which that has decayed, m/s and rad/s.
        slip_speed, spin_speed: speeds relative to the hand at which the stability term has decayed, m/s and rad/s.
        support_force: hand force on supports and distractors that counts as one collision unit, N.
        grip_force: finger force above which grip is penalised, N.
    """

    reach: float = 1.0
    contact: float = 0.5
    grasp: float = 1.0
    lift: float = 8.0
    stable: float = 1.0
    col: float = 1.0
    act: float = 0.005
    smooth: float = 0.01
    drop: float = 50.0
    scale: float = 0.02
    reach_length: float = 0.10
    reach_far: float = 0.0
    reach_far_length: float = 0.6
    enclose: float = 0.5
    lift_open: float = 0.25
    goal_height: float = 0.16
    goal_width: float = 0.05
    overshoot_height: float = 0.20
    overshoot_width: float = 0.05
    drift_free: float = 0.06
    drift_width: float = 0.08
    hold: float = 2.0
    hold_speed: float = 0.4
    hold_turn: float = 1.0
    slip_speed: float = 0.15
    spin_speed: float = 3.0
    support_force: float = 20.0
    grip_force: float = 15.0

    def __post_init__(self) -> None:
        lengths = ("reach_length", "reach_far_length", "goal_width", "overshoot_width", "drift_width")
        lengths += ("hold_speed", "hold_turn")
        for name in (*lengths, "slip_speed", "spin_speed", "support_force"):
            if getattr(self, name) <= 0:
                raise ValueError(f"env.reward.{name} must be positive, not {getattr(self, name)}")


@dataclass(frozen=True)
class Range:
    """A uniform range with a switch: `low` to `high` where `on`."""

    low: float
    high: float
    on: bool = True

    def __post_init__(self) -> None:
        if self.low > self.high:
            raise ValueError(f"a randomisation range runs from {self.low} to {self.high}; swap its ends")


@dataclass(frozen=True)
class RandomizationConfig:
    """What differs between episodes. Object geometry, pose, support height and clutter come with the scene record.

    Attributes:
        friction: sliding friction of the target.
        mass: factor on the target's mass.
        arm_gain: factor on the position and velocity gains of base, arm and neck.
        hand_gain: factor on the hand's position gains.
        contact_time: time constant of the target's contacts, s.
        start_offset: pre-grasp offset along each axis of the grasp frame, m.
        start_tilt: pre-grasp rotation about the grasp frame's x and y, rad.
        start_yaw: pre-grasp rotation about the approach direction, rad.
        start_hand: offset of each hand joint at the start, rad.
        scene: draw the scene record at random (geometry, pose, support height, clutter); else in order.
    """

    friction: Range = field(default_factory=lambda: Range(0.6, 1.2))
    mass: Range = field(default_factory=lambda: Range(0.7, 1.4))
    arm_gain: Range = field(default_factory=lambda: Range(0.85, 1.15))
    hand_gain: Range = field(default_factory=lambda: Range(0.8, 1.2))
    contact_time: Range = field(default_factory=lambda: Range(0.015, 0.03))
    start_offset: Range = field(default_factory=lambda: Range(-0.02, 0.02))
    start_tilt: Range = field(default_factory=lambda: Range(-0.15, 0.15))
    start_yaw: Range = field(default_factory=lambda: Range(-0.5, 0.5))
    start_hand: Range = field(default_factory=lambda: Range(-0.08, 0.08))
    scene: bool = True


@dataclass(frozen=True)
class ScatterConfig:
    """Starts anywhere between the start pose and the pre-grasp, off the usual path, for demonstrations of the way back.

    Attributes:
        per_scene: such starts kept for each scene.
        base: largest offset of the base along x and y, m.
        yaw: largest offset of its heading, rad.
        arm: largest offset of each arm joint, rad.
        neck: largest offset of each neck joint, rad.
        clearance: least distance from everything, m; felt up to the controller's reach (`wbc.reach`, `wbc.reach_self`).
    """

    per_scene: int = 6
    base: float = 0.2
    yaw: float = 0.4
    arm: float = 0.5
    neck: float = 0.5
    clearance: float = 0.025

    def __post_init__(self) -> None:
        if self.per_scene < 1 or min(self.base, self.yaw, self.arm, self.neck, self.clearance) < 0:
            raise ValueError("env.scatter: per_scene must be at least 1, and no offset negative")


@dataclass(frozen=True)
class EnvConfig:
    """A grasping environment.

    Attributes:
        start: `local` (at a pre-grasp) or `whole_body` (away from the support).
        pregrasp_share: share of whole-body episodes that start at the pre-grasp all the same.
        scatter_share: share of whole-body episodes that start scattered, see `scatter`.
        episode_s: length of the contact-rich phase, s.
        approach_s: time allowed for the approach in whole-body episodes, s.
        approach_speed: speed of the end-effector target on its way to the pre-grasp, m/s.
        approach_rate: it slows down to this times the distance left, 1/s.
        approach_turn: largest speed at which the target turns there, rad/s.
        approach_leash: how far the target may run ahead of the hand, m.
        approach_back: the way leads over a point this far behind the pre-grasp against the approach direction, m.
        success_height: lift above the settled height that counts, m.
        success_hold_s: how long it must be held, s.
        standoff: distance from the object's surface to the grasp frame at the pre-grasp, m.
        reach_radius: the object is out of reach beyond this horizontal distance from its settled place, m.
        drop_height: a lifted object below this height that is not held has been dropped, m.
        hand_margin: added to the controller's safety distance of the hand while it works, m; negative lets it touch.
        contact_base: the controller's weight on the base's motion while the hand works.
        max_hand_force: hand force on supports or distractors that is a forbidden collision, N.
        fall_height: the object is out of reach this far below its settled height, m.
        finish_s: end the episode with success after holding this long in a row, s; 0 plays every episode to its end.
        end_on_collision: end the episode at the first forbidden contact; else it is judged at the end.
        max_speed: object speed that means the physics is unstable, m/s.
        starts_per_scene: pre-grasp solutions kept for each scene.
        observe: `privileged` (the teacher always knows the target's pose) or `seen` (only while the camera sees it).
        seen: what `observe=seen` means.
        scatter: where scattered episodes start.
    """

    start: str = "local"
    pregrasp_share: float = 0.0
    scatter_share: float = 0.0
    episode_s: float = 3.6
    approach_s: float = 6.0
    approach_speed: float = 0.5
    approach_rate: float = 4.0
    approach_turn: float = 1.5
    approach_leash: float = 0.15
    approach_back: float = 0.12
    success_height: float = 0.10
    success_hold_s: float = 1.0
    standoff: float = 0.06
    reach_radius: float = 0.35
    drop_height: float = 0.03
    hand_margin: float = -0.025
    contact_base: float = 1.0
    max_hand_force: float = 60.0
    fall_height: float = 0.10
    finish_s: float = 0.0
    end_on_collision: bool = True
    max_speed: float = 15.0
    starts_per_scene: int = 8
    observe: str = "privileged"
    seen: SeenConfig = field(default_factory=SeenConfig)
    scatter: ScatterConfig = field(default_factory=ScatterConfig)
    action: ActionConfig = field(default_factory=ActionConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    randomization: RandomizationConfig = field(default_factory=RandomizationConfig)

    def __post_init__(self) -> None:
        if self.start not in ("local", "whole_body"):
            raise ValueError(f"env.start is {self.start!r}; choose local or whole_body")
        if self.observe not in ("privileged", "seen"):
            raise ValueError(f"env.observe is {self.observe!r}; choose privileged or seen")
        if min(self.pregrasp_share, self.scatter_share) < 0.0 or self.pregrasp_share + self.scatter_share > 1.0:
            raise ValueError(
                "env.pregrasp_share and env.scatter_share must be within 0 and 1 together, not "
                f"{self.pregrasp_share} and {self.scatter_share}"
            )
        for name in ("approach_s", "approach_speed", "approach_rate", "approach_turn", "approach_leash"):
            if getattr(self, name) <= 0:
                raise ValueError(f"env.{name} must be positive, not {getattr(self, name)}")
        if self.approach_back < 0:
            raise ValueError(f"env.approach_back must not be negative, not {self.approach_back}")
        if self.episode_s <= self.success_hold_s:
            raise ValueError(f"env.episode_s ({self.episode_s}) must exceed env.success_hold_s ({self.success_hold_s})")
        if 0 < self.finish_s < self.success_hold_s:
            raise ValueError(f"env.finish_s ({self.finish_s}) must be 0 or at least env.success_hold_s")
        if self.starts_per_scene < 1:
            raise ValueError(f"env.starts_per_scene must be at least 1, not {self.starts_per_scene}")

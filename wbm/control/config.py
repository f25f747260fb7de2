"""Configuration of the whole-body controller."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

SOLVERS = ("qp", "paper")
INTEGRATE = ("target", "measured")


@dataclass(frozen=True)
class WbcWeights:
    """Weights of the objectives in (1); velocities are m/s or rad/s, so all are comparable.

    `look` turns the neck and `face` the base towards what the gaze rows alone would not find; `paper` has neither.
    """

    ee_position: float = 10.0
    ee_rotation: float = 2.0
    gaze: float = 0.5
    distance: float = 0.05
    posture: float = 0.004
    posture_base: float = 0.0
    centring: float = 0.05
    base: float = 0.1
    smoothness: float = 0.3
    damping: float = 0.01
    look: float = 1.0
    face: float = 1.0
    collision: float = 0.02

    def __post_init__(self) -> None:
        _check_numbers("wbc.weights", self, least=0.0)
        if self.damping < 1e-3:
            raise ValueError(f"wbc.weights.damping: {self.damping} is below 1e-3, where the solve loses its digits")


@dataclass(frozen=True)
class WbcGains:
    """Gains (1/s), speeds (m/s, rad/s), distances (m) and the dampers' constants.

    Attributes:
        ee_position, ee_rotation, gaze, distance, posture: proportional gains, 1/s.
        centring: speed away from a limit at the limit, rad/s.
        ee_speed, ee_turn, gaze_turn: largest commanded speeds, m/s and rad/s.
        distance_min, distance_max: viewing distances without cost, m.
        safe_obstacle, safe_self: distances that dampers keep, m (`d_min`; `d_safe` of the paper's equation 4 is
            this plus the reach).
        gamma: share of the gap that may be used in one step.
        brake: deceleration that dampers count on, m/s^2.
        escape: speed out of a violated safety distance, m/s.
        ee_damping: `K_d` of (2), `paper` only, unitless.
        repulsion: `eta` of (4), `paper` only.
    """

    ee_position: float = 4.0
    ee_rotation: float = 4.0
    gaze: float = 4.0
    distance: float = 1.0
    posture: float = 0.5
    centring: float = 0.5
    ee_speed: float = 0.7
    ee_turn: float = 2.0
    gaze_turn: float = 2.0
    distance_min: float = 0.35
    distance_max: float = 1.5
    safe_obstacle: float = 0.02
    safe_self: float = 0.02
    gamma: float = 0.25
    brake: float = 1.2
    escape: float = 0.2
    ee_damping: float = 0.1
    repulsion: float = 0.0005

    def __post_init__(self) -> None:
        _check_numbers("wbc.gains", self, least=0.0)
        if not 0.0 < self.gamma <= 1.0:
            raise ValueError(f"wbc.gains.gamma: {self.gamma} is not in (0, 1]")
        if self.brake <= 0.0:
            raise ValueError(f"wbc.gains.brake: {self.brake} must be positive")


@dataclass(frozen=True)
class WbcConfig:
    """The controller's settings; weights and gains are only the start values of its live arrays.

    Attributes:
        solver: `qp`, or `paper` for equations (1) to (4) as printed.
        dt: control step, s.
        integrate: `target` integrates velocities from the previous target, so that limits hold exactly whatever the
            measured joints do; `measured` starts from the measured joints in every step.
        lead_time: how far the target may run ahead of the measured joint, in seconds at full speed.
        lag: delay of the position actuators, s (kv / kp); `ctrl` leads `q_target` by it.
        reach, reach_self: gaps beyond these are not looked at, to obstacles and to itself, m.
        slack_weight: weight of a damper's slack.
        iterations: largest number of Newton steps.
        distance_floor: floor on d in (4), m, `paper` only.
    """

    solver: str = "qp"
    dt: float = 0.04
    integrate: str = "target"
    lead_time: float = 0.4
    lag: float = 0.1
    reach: float = 0.2
    reach_self: float = 0.08
    slack_weight: float = 1.0e5
    iterations: int = 120
    distance_floor: float = 0.01
    weights: WbcWeights = field(default_factory=WbcWeights)
    gains: WbcGains = field(default_factory=WbcGains)

    def __post_init__(self) -> None:
        if self.solver not in SOLVERS:
            raise ValueError(f"wbc.solver: {self.solver!r} is not one of {', '.join(SOLVERS)}")
        if self.integrate not in INTEGRATE:
            raise ValueError(f"wbc.integrate: {self.integrate!r} is not one of {', '.join(INTEGRATE)}")
        for name in ("dt", "lead_time", "reach", "reach_self", "slack_weight", "iterations", "distance_floor"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"wbc.{name}: {value} must be positive and finite")
        if not (math.isfinite(self.lag) and self.lag >= 0.0):
            raise ValueError(f"wbc.lag: {self.lag} must be zero or more seconds")


def _check_numbers(where: str, config: object, least: float) -> None:
    for item in fields(config):  # type: ignore[arg-type]
        value = getattr(config, item.name)
        if not (math.isfinite(value) and value >= least):
            raise ValueError(f"{where}.{item.name}: {value} must be a finite number of at least {least:g}")

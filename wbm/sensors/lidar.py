"""Unitree L2 LiDAR with its two-axis scan."""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np

from wbm.kernels.noise import RayNoise
from wbm.sensors.ray_sensor import ExtrinsicNoise, RaySensor
from wbm.sensors.scene import RayScene

MAX_PATTERNS = 64
SEED_SALT = 0x4C32


@dataclass(frozen=True)
class LidarNoise:
    """Errors of a time-of-flight scanner; a zero switches a term off.

    The range error is normal with a constant deviation (the maker's accuracy of 20 mm is taken as two deviations). The
    chance of losing a return is `drop + drop_far (r / max_range)^2`: the echo's power falls with the square of the
    range. Sparsity loses whole arcs of a sweep, as lost packets do.

    Attributes:
        sigma: range deviation, m.
        drop, drop_far: chances.
        sparsity: chance of losing an arc.
        arc: consecutive rays in an arc.
    """

    sigma: float = 0.01
    drop: float = 0.01
    drop_far: float = 0.2
    sparsity: float = 0.05
    arc: int = 16

    def __post_init__(self) -> None:
        if self.sigma < 0 or self.arc < 1:
            raise ValueError("LiDAR noise: need sigma >= 0 and arc >= 1")
        if not all(0 <= p <= 1 for p in (self.drop, self.drop_far, self.sparsity)):
            raise ValueError("LiDAR noise: drop, drop_far and sparsity are chances in [0, 1]")


@dataclass(frozen=True)
class LidarConfig:
    """Published geometry of the L2, thinned to a number of rays in a policy step.

    Attributes:
        num_rays: rays in a policy step (the device measures 64,800 points/s, 2,592 at 25 Hz).
        step_hz: policy rate, Hz; a step's rays cover 1 / step_hz seconds.
        sweep_hz, spin_hz: rates of the vertical sweep and of the head about its vertical axis, Hz.
        min_elevation_deg: lowest elevation; a sweep runs from there over the zenith to the same elevation on the other
            side, so that the vertical field of view is 90 - min_elevation_deg = 96 degrees.
        min_range, max_range: m.
        bundle: rays in a culling bundle.
        noise: error model; None is exact.
        extrinsic: mounting error.
    """

    num_rays: int = 1024
    step_hz: float = 25.0
    sweep_hz: float = 216.0
    spin_hz: float = 5.55
    min_elevation_deg: float = -6.0
    min_range: float = 0.05
    max_range: float = 30.0
    bundle: int = 64
    noise: LidarNoise | None = None
    extrinsic: ExtrinsicNoise = field(default_factory=ExtrinsicNoise)

    def __post_init__(self) -> None:
        if self.num_rays < 1 or self.bundle < 1:
            raise ValueError(f"LiDAR: num_rays and bundle must be >= 1, got {self.num_rays}, {self.bundle}")
        if min(self.step_hz, self.sweep_hz, self.spin_hz) <= 0:
            raise ValueError("LiDAR: step_hz, sweep_hz and spin_hz must be positive")
        if not -90 <= self.min_elevation_deg < 90:
            raise ValueError("LiDAR: min_elevation_deg must lie in [-90, 90)")
        if not 0 <= self.min_range < self.max_range:
            raise ValueError("LiDAR: need 0 <= min_range < max_range")


def scan_rays(config: LidarConfig) -> np.ndarray:
    """Unit rays [Q,num_rays,3] of a step for each of the Q phases at which a sweep can start, z up.

    At time t since the step began, with the sweep's phase `f` at that moment:
    `alpha = a0 + (pi - 2 a0) frac(f + sweep_hz t)`, `theta = 2 pi spin_hz t`,
    `d = R_z(theta) (cos alpha, 0, sin alpha)`. The head's angle at the step's start turns the whole pattern and is left
    to `aim_sensors`. Q is the period of `sweep_hz / step_hz` modulo 1 as a fraction (25 for 216 / 25).
    """
    ratio = sweep_ratio(config)
    time = (np.arange(config.num_rays) + 0.5) / (config.num_rays * config.step_hz)
    low = np.radians(config.min_elevation_deg)
    start = np.array([float(q * ratio % 1) for q in range(ratio.denominator)])
    alpha = low + (np.pi - 2 * low) * ((start[:, None] + config.sweep_hz * time) % 1.0)
    theta = np.broadcast_to(2 * np.pi * config.spin_hz * time, alpha.shape)
    return np.stack([np.cos(alpha) * np.cos(theta), np.cos(alpha) * np.sin(theta), np.sin(alpha)], axis=-1)


def sweep_ratio(config: LidarConfig) -> Fraction:
    """Sweeps in a step as a fraction with at most `MAX_PATTERNS` phases."""
    return Fraction(config.sweep_hz / config.step_hz).limit_denominator(MAX_PATTERNS)


class Lidar(RaySensor):
    """Scans of a `RayScene` in time order, rolling with each environment's `step`.

    The sensor frame is L, which does not turn with the head; z up.
    """

    def __init__(self, config: LidarConfig, scene: RayScene, exclude_body: int = -1, seed: int = 0) -> None:
        """`exclude_body` is the body that carries the LiDAR."""
        self.config = config
        noise = RayNoise()
        if config.noise is not None:
            noise.active = 1
            noise.sigma, noise.drop, noise.drop_far = config.noise.sigma, config.noise.drop, config.noise.drop_far
            noise.burst, noise.burst_len = config.noise.sparsity, config.noise.arc
        super().__init__(
            scene,
            scan_rays(config),
            config.min_range,
            config.max_range,
            turn=config.spin_hz / config.step_hz,
            exclude_body=exclude_body,
            bundle=config.bundle,
            noise=noise,
            extrinsic=config.extrinsic,
            # Keeps the draws apart from those of a camera with the same seed.
            seed=seed ^ SEED_SALT,
        )

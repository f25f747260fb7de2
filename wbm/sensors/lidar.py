"""Unitree L2 LiDAR with its two-axis scan."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from wbm.kernels.noise import RayNoise
from wbm.sensors.config import LidarConfig
from wbm.sensors.ray_sensor import RaySensor
from wbm.sensors.scene import RayScene

MAX_PATTERNS = 64
SEED_SALT = 0x4C32


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

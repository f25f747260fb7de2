"""Unitree L2 LiDAR with its two-axis scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import warp as wp

from wbm.kernels.rays_scan import spin_sensor
from wbm.sensors.scene import RayScene
from wbm.sensors.tracer import RayTracer

MAX_PATTERNS = 64


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
    """

    num_rays: int = 1024
    step_hz: float = 25.0
    sweep_hz: float = 216.0
    spin_hz: float = 5.55
    min_elevation_deg: float = -6.0
    min_range: float = 0.05
    max_range: float = 30.0
    bundle: int = 64

    def __post_init__(self) -> None:
        if self.num_rays < 1:
            raise ValueError(f"LiDAR: num_rays must be >= 1, got {self.num_rays}")
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
    to `spin_sensor`. Q is the period of `sweep_hz / step_hz` modulo 1 as a fraction (25 for 216 / 25).
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


class Lidar:
    """Scans of all or some environments of a `RayScene`, rolling with each environment's step.

    Live inputs: `pos` [N] vec3 and `quat` [N] vec4 (w x y z) of the LiDAR frame in the world, `step` [N] int32, the
    policy step of each environment's episode. Outputs in time order along R = num_rays: see `RayTracer`; `point_s` is
    in the LiDAR frame L, which does not turn with the head.
    """

    def __init__(self, config: LidarConfig, scene: RayScene, exclude_body: int = -1) -> None:
        """`exclude_body` is the body that carries the LiDAR; its instances are not seen."""
        self.config, self.scene = config, scene
        n = scene.num_envs
        self.tracer = RayTracer(
            scene, scan_rays(config), config.min_range, config.max_range, exclude_body, config.bundle, spinning=True
        )
        self.pos, self.quat = wp.zeros(n, dtype=wp.vec3, device=scene.device), self.tracer.frame_quat
        self.step = wp.zeros(n, dtype=wp.int32, device=scene.device)
        self._turn = float(Fraction(config.spin_hz / config.step_hz).limit_denominator(10**6))
        for name in ("range", "instance", "id", "color", "valid", "ok", "point_s", "point_w"):
            setattr(self, name, getattr(self.tracer, name))

    def render(self, env_ids: Sequence[int] | np.ndarray | wp.array | None = None) -> None:
        """Scan the given environments (all for None) at their live poses and steps into the output arrays."""
        tracer, ids = self.tracer, self.tracer.env_index(env_ids)
        if ids.shape[0] == 0:
            return
        wp.launch(
            spin_sensor,
            dim=ids.shape[0],
            inputs=[ids, self.step, self._turn, sweep_ratio(self.config).denominator, self.pos, self.quat],
            outputs=[tracer.pattern, tracer.pos, tracer.quat],
            device=self.scene.device,
        )
        tracer.trace(ids)
        tracer.fill(ids)

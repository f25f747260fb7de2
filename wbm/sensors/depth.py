"""RealSense D435 depth camera."""

from __future__ import annotations

import numpy as np

from wbm.kernels.noise import RayNoise
from wbm.sensors.config import DepthConfig
from wbm.sensors.ray_sensor import RaySensor
from wbm.sensors.scene import RayScene


def pinhole_rays(width: int, height: int, hfov_deg: float, vfov_deg: float) -> np.ndarray:
    """Unit rays [H*W,3] through the pixel centres, row by row; x right, y down, z forward.

    `u = (j + 1/2 - W/2) / f_x`, `f_x = W / (2 tan(hfov / 2))`, and so for v.
    """
    x = (np.arange(width) + 0.5 - width / 2) / (width / 2) * np.tan(np.radians(hfov_deg) / 2)
    y = (np.arange(height) + 0.5 - height / 2) / (height / 2) * np.tan(np.radians(vfov_deg) / 2)
    rays = np.stack([*np.meshgrid(x, y), np.ones((height, width))], axis=-1).reshape(-1, 3)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


class DepthCamera(RaySensor):
    """Depth images of a `RayScene`, row by row (R = height * width); the sensor frame is optical (z forward)."""

    def __init__(self, config: DepthConfig, scene: RayScene, exclude_body: int = -1, seed: int = 0) -> None:
        """`exclude_body` is the body that carries the camera."""
        self.config = config
        noise = RayNoise()
        if config.noise is not None:
            noise.active = 1
            noise.axial, noise.drop = config.noise.axial(config.hfov_deg), config.noise.drop
            noise.edge, noise.edge_jump, noise.width = config.noise.edge, config.noise.edge_jump, config.width
        super().__init__(
            scene,
            pinhole_rays(config.width, config.height, config.hfov_deg, config.vfov_deg)[None],
            config.min_range,
            config.max_range,
            planar=True,
            exclude_body=exclude_body,
            bundle=config.bundle,
            noise=noise,
            extrinsic=config.extrinsic,
            seed=seed,
        )

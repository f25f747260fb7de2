"""RealSense D435 depth camera."""

from __future__ import annotations

import numpy as np

from wbm.kernels.noise import RayNoise
from wbm.sensors.config import DepthConfig
from wbm.sensors.ray_sensor import RaySensor
from wbm.sensors.scene import RayScene


def pinhole_rays(width: int, height: int, hfov_deg: float, vfov_deg: float, center: float = 1.0) -> np.ndarray:
    """Unit rays [H*W,3] through the pixel centres, row by row; x right, y down, z forward.

    `u = w((j + 1/2 - W/2) / (W/2)) tan(hfov / 2)`, and so for v, with `w(s) = c s + (1 - c) s^3`: denser in the middle
    where c, `center`, is below 1.
    """
    x = _warp(width, center) * np.tan(np.radians(hfov_deg) / 2)
    y = _warp(height, center) * np.tan(np.radians(vfov_deg) / 2)
    rays = np.stack([*np.meshgrid(x, y), np.ones((height, width))], axis=-1).reshape(-1, 3)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def pixel_areas(width: int, height: int, center: float) -> np.ndarray:
    """Area [H*W] of each pixel of `pinhole_rays` in the image plane, in pixels of an even grid."""
    along = [center + 3 * (1 - center) * _even(size) ** 2 for size in (height, width)]
    return np.multiply.outer(*along).ravel()


def _even(size: int) -> np.ndarray:
    return (np.arange(size) + 0.5 - size / 2) / (size / 2)


def _warp(size: int, center: float) -> np.ndarray:
    s = _even(size)
    return center * s + (1 - center) * s**3


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
            pinhole_rays(config.width, config.height, config.hfov_deg, config.vfov_deg, config.center)[None],
            config.min_range,
            config.max_range,
            planar=True,
            exclude_body=exclude_body,
            bundle=config.bundle,
            noise=noise,
            extrinsic=config.extrinsic,
            seed=seed,
        )

"""RealSense D435 depth camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from wbm.sensors.scene import RayScene
from wbm.sensors.tracer import RayTracer


@dataclass(frozen=True)
class DepthConfig:
    """Published optics of the D435 (depth stream) at a chosen resolution.

    Attributes:
        width, height: rays.
        hfov_deg, vfov_deg: field of view, degrees.
        min_range, max_range: planar depth outside of which a return is invalid, m.
        bundle: rays in a culling bundle.
    """

    width: int = 80
    height: int = 60
    hfov_deg: float = 87.0
    vfov_deg: float = 58.0
    min_range: float = 0.2
    max_range: float = 3.0
    bundle: int = 64

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"depth camera: width and height must be >= 1, got {self.width} x {self.height}")
        if not (0 < self.hfov_deg < 180 and 0 < self.vfov_deg < 180):
            raise ValueError("depth camera: fields of view must lie in (0, 180) degrees")
        if not 0 <= self.min_range < self.max_range:
            raise ValueError("depth camera: need 0 <= min_range < max_range")


def pinhole_rays(width: int, height: int, hfov_deg: float, vfov_deg: float) -> np.ndarray:
    """Unit rays [H*W,3] through the pixel centres, row by row; x right, y down, z forward.

    `u = (j + 1/2 - W/2) / f_x`, `f_x = W / (2 tan(hfov / 2))`, and so for v.
    """
    x = (np.arange(width) + 0.5 - width / 2) / (width / 2) * np.tan(np.radians(hfov_deg) / 2)
    y = (np.arange(height) + 0.5 - height / 2) / (height / 2) * np.tan(np.radians(vfov_deg) / 2)
    rays = np.stack([*np.meshgrid(x, y), np.ones((height, width))], axis=-1).reshape(-1, 3)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


class DepthCamera:
    """Depth images of all or some environments of a `RayScene`.

    Live inputs: `pos` [N] vec3 and `quat` [N] vec4 (w x y z) of the optical frame in the world.
    Outputs, row-major with R = height * width: see `RayTracer`.
    """

    def __init__(self, config: DepthConfig, scene: RayScene, exclude_body: int = -1) -> None:
        """`exclude_body` is the body that carries the camera; its instances are not seen."""
        rays = pinhole_rays(config.width, config.height, config.hfov_deg, config.vfov_deg)
        self.config, self.scene = config, scene
        self.tracer = RayTracer(
            scene, rays[None], config.min_range, config.max_range, exclude_body, config.bundle, planar=True
        )
        self.pos, self.quat = self.tracer.pos, self.tracer.quat
        for name in ("range", "depth", "instance", "id", "color", "valid", "ok", "point_s", "point_w"):
            setattr(self, name, getattr(self.tracer, name))

    def render(self, env_ids: Sequence[int] | np.ndarray | wp.array | None = None) -> None:
        """Render the given environments (all for None) from the live poses into the output arrays."""
        ids = self.tracer.trace(env_ids)
        self.tracer.fill(ids)

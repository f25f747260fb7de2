"""RealSense D435 depth camera."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from wbm.kernels.noise import RayNoise
from wbm.sensors.ray_sensor import ExtrinsicNoise, RaySensor
from wbm.sensors.scene import RayScene


@dataclass(frozen=True)
class DepthNoise:
    """Errors of a stereo depth camera; a zero switches a term off.

    `sigma(z) = subpixel z^2 / (f_px baseline)` with `f_px = stream_width / (2 tan(hfov / 2))`: a disparity error of
    `subpixel` pixels propagated through `z = f_px baseline / disparity` (Intel, "Tuning depth cameras for best
    performance", RMS error; Nguyen et al., 2012, measure the same law). The stream's width is the device's, whatever
    the number of rays.

    Attributes:
        subpixel: disparity deviation, px.
        baseline: m.
        stream_width: columns of the device's own stream, px.
        drop: chance of losing any pixel.
        edge: chance of losing a pixel at a depth discontinuity (one of its four neighbours is a miss or differs).
        edge_jump: relative difference of depth that makes a discontinuity.
    """

    subpixel: float = 0.08
    baseline: float = 0.050
    stream_width: int = 848
    drop: float = 0.02
    edge: float = 0.3
    edge_jump: float = 0.05

    def __post_init__(self) -> None:
        if self.subpixel < 0 or self.baseline <= 0 or self.stream_width < 1 or self.edge_jump < 0:
            raise ValueError("depth noise: need subpixel, edge_jump >= 0, baseline > 0 and stream_width >= 1")
        if not (0 <= self.drop <= 1 and 0 <= self.edge <= 1):
            raise ValueError("depth noise: drop and edge are chances in [0, 1]")

    def axial(self, hfov_deg: float) -> float:
        """k in `sigma(z) = k z^2`, 1/m."""
        focal = self.stream_width / (2 * np.tan(np.radians(hfov_deg) / 2))
        return float(self.subpixel / (focal * self.baseline))


@dataclass(frozen=True)
class DepthConfig:
    """Published optics of the D435's depth stream at a chosen resolution.

    Attributes:
        width, height: rays.
        hfov_deg, vfov_deg: field of view, degrees.
        min_range, max_range: planar depth outside of which a return is invalid, m.
        bundle: rays in a culling bundle.
        noise: error model; None is exact.
        extrinsic: mounting error.
    """

    width: int = 80
    height: int = 60
    hfov_deg: float = 87.0
    vfov_deg: float = 58.0
    min_range: float = 0.2
    max_range: float = 3.0
    bundle: int = 64
    noise: DepthNoise | None = None
    extrinsic: ExtrinsicNoise = field(default_factory=ExtrinsicNoise)

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1 or self.bundle < 1:
            raise ValueError(
                f"depth camera: width, height, bundle must be >= 1, got {self.width} x {self.height}, {self.bundle}"
            )
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

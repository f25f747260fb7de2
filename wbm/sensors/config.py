"""Settings of the sensors: values only."""

from __future__ import annotations

import math
from dataclasses import dataclass, field


@dataclass(frozen=True)
class ExtrinsicNoise:
    """Mounting error, drawn once an episode: the rays leave the pose `X_WS exp(xi)`, the points are placed with `X_WS`.

    Attributes:
        sigma_pos: deviation of each coordinate, m.
        sigma_rot: deviation of each component of the rotation vector, rad.
    """

    sigma_pos: float = 0.0
    sigma_rot: float = 0.0

    def __post_init__(self) -> None:
        if self.sigma_pos < 0 or self.sigma_rot < 0:
            raise ValueError("extrinsic noise: sigma_pos and sigma_rot must be >= 0")


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
        focal = self.stream_width / (2 * math.tan(math.radians(hfov_deg) / 2))
        return self.subpixel / (focal * self.baseline)


@dataclass(frozen=True)
class DepthConfig:
    """Published optics of the D435's depth stream at a chosen resolution.

    Attributes:
        width, height: rays.
        hfov_deg, vfov_deg: field of view, degrees.
        center: spacing of the rays in the middle of the image, as a share of an even grid's; 1 is even. A gaze that
            keeps its target there sees more of it with as many rays.
        min_range, max_range: planar depth outside of which a return is invalid, m.
        bundle: rays in a culling bundle.
        noise: error model; None is exact.
        extrinsic: mounting error.
    """

    width: int = 80
    height: int = 60
    hfov_deg: float = 87.0
    vfov_deg: float = 58.0
    center: float = 1.0
    min_range: float = 0.2
    max_range: float = 3.0
    bundle: int = field(default=32, metadata={"key": False})
    noise: DepthNoise | None = None
    extrinsic: ExtrinsicNoise = field(default_factory=ExtrinsicNoise)

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1 or self.bundle < 1:
            raise ValueError(
                f"depth camera: width, height, bundle must be >= 1, got {self.width} x {self.height}, {self.bundle}"
            )
        if not (0 < self.hfov_deg < 180 and 0 < self.vfov_deg < 180):
            raise ValueError("depth camera: fields of view must lie in (0, 180) degrees")
        if not 0 < self.center <= 1:
            raise ValueError(f"depth camera: center must lie in (0, 1], not {self.center}")
        if not 0 <= self.min_range < self.max_range:
            raise ValueError("depth camera: need 0 <= min_range < max_range")


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
    bundle: int = field(default=32, metadata={"key": False})
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


@dataclass(frozen=True)
class DelayConfig:
    """When frames are delivered, in policy steps.

    Attributes:
        delay_min, delay_max: an episode's delay is drawn uniformly from these whole numbers.
        lost: chance that a frame is not delivered; the one before it stays.
        hold_max: a frame is held for at most this many steps beyond the delay.
    """

    delay_min: int = 0
    delay_max: int = 0
    lost: float = 0.0
    hold_max: int = 3

    def __post_init__(self) -> None:
        if not 0 <= self.delay_min <= self.delay_max or self.hold_max < 0:
            raise ValueError("delay: need 0 <= delay_min <= delay_max and hold_max >= 0")
        if not 0 <= self.lost <= 1:
            raise ValueError("delay: lost is a chance in [0, 1]")

    @property
    def active(self) -> bool:
        """Whether any frame can be late."""
        return self.delay_max > 0 or self.lost > 0


@dataclass(frozen=True)
class CloudConfig:
    """How a scan becomes a cloud.

    Attributes:
        num_points: P.
        target_share: share of the P points that may lie on the target while others can fill the rest.
        crop_min, crop_max: corners of the box of points that are kept, base frame, m.
        self_filter: whether points on the robot are left out.
        delay: latency of the cloud.
    """

    num_points: int = 256
    target_share: float = 0.4
    crop_min: tuple[float, float, float] = (-3.0, -3.0, -0.1)
    crop_max: tuple[float, float, float] = (3.0, 3.0, 2.5)
    self_filter: bool = False
    delay: DelayConfig = field(default_factory=DelayConfig)

    def __post_init__(self) -> None:
        if self.num_points < 1:
            raise ValueError(f"cloud: num_points must be >= 1, got {self.num_points}")
        if not 0 <= self.target_share <= 1:
            raise ValueError("cloud: target_share must lie in [0, 1]")
        if any(lo >= hi for lo, hi in zip(self.crop_min, self.crop_max, strict=True)):
            raise ValueError("cloud: crop_min must lie below crop_max")


@dataclass(frozen=True)
class SensorsConfig:
    """What the policy sees.

    Attributes:
        depth, lidar: the devices.
        depth_cloud, lidar_cloud: the clouds made of their returns.
    """

    depth: DepthConfig = field(default_factory=DepthConfig)
    lidar: LidarConfig = field(default_factory=LidarConfig)
    depth_cloud: CloudConfig = field(default_factory=CloudConfig)
    lidar_cloud: CloudConfig = field(
        default_factory=lambda: CloudConfig(crop_min=(-6.0, -6.0, -0.1), crop_max=(6.0, 6.0, 2.5))
    )

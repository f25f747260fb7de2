"""Configuration of the exported contract: what the runtime tolerates and how it is checked."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DeployConfig:
    """Values of `conf/deploy/*.yaml`.

    Attributes:
        num_golden: golden input and output vectors in the bundle.
        parity_tolerance: largest difference between torch and ONNX on them (action units).
        max_age_joints_s: joint readings older than this are refused, s.
        max_age_cloud_s: point clouds older than this are refused, s.
        delay_joints_s: expected age of joint readings, s (told to the roboticist; compensated for).
        delay_cloud_s: expected age of point clouds, s.
        limit_tolerance: how far a measured joint may be outside its range, m or rad.
        velocity_factor: measured speeds above this multiple of the limit are refused.
        consistency: largest gap between a measured move and the measured speed times the step, m or rad.
        range_camera_m: largest distance of a camera point, m; beyond it the unit is suspect.
        range_lidar_m: largest distance of a LiDAR point, m.
        range_min_m: a cloud whose median distance is below this has a suspect unit, m.
        base_box_m: half width of the square around the start that the base may roll in, m.
        floor_clearance_m: lowest height of grasp centre, fingertips and camera above the floor, m.
        reach_m: largest horizontal distance of the grasp centre from the base's centre, m.
        sign_key: path of an ed25519 private key (PEM); empty for no signature.
        mcap_flush_s: a log loses at most this much when its process is killed, s.
    """

    num_golden: int = 16
    parity_tolerance: float = 1e-5
    max_age_joints_s: float = 0.06
    max_age_cloud_s: float = 0.25
    delay_joints_s: float = 0.0
    delay_cloud_s: float = 0.04
    limit_tolerance: float = 0.05
    velocity_factor: float = 1.5
    consistency: float = 0.06
    range_camera_m: float = 12.0
    range_lidar_m: float = 35.0
    range_min_m: float = 0.02
    base_box_m: float = 5.0
    floor_clearance_m: float = 0.0
    reach_m: float = 1.4
    sign_key: str = ""
    mcap_flush_s: float = 0.25

    def __post_init__(self) -> None:
        if self.num_golden < 1:
            raise ValueError(f"deploy.num_golden is {self.num_golden}, must be at least 1")
        for name in (
            "parity_tolerance", "max_age_joints_s", "max_age_cloud_s", "limit_tolerance", "velocity_factor",
            "consistency", "range_camera_m", "range_lidar_m", "base_box_m", "reach_m", "mcap_flush_s",
        ):  # fmt: skip
            if not getattr(self, name) > 0:
                raise ValueError(f"deploy.{name} is {getattr(self, name)}, must be positive")
        for name in ("delay_joints_s", "delay_cloud_s", "range_min_m", "floor_clearance_m"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"deploy.{name} is {getattr(self, name)}, must not be negative")
        if self.delay_joints_s >= self.max_age_joints_s or self.delay_cloud_s >= self.max_age_cloud_s:
            raise ValueError("deploy: expected delays must be smaller than the largest ages")

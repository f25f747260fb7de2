"""What a robot must implement: a few methods that give readings and take joint targets."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from wbm.deploy.contract import UNITS, Contract
from wbm.deploy.faults import Fault, Refused

SENSORS = ("joints", "depth", "lidar")


@dataclass(frozen=True)
class Reading:
    """What the robot measured, each part with the time of its measurement.

    Attributes:
        stamps: `joints`, `depth`, `lidar`: times on the clock that `PolicyRuntime.step` is given, s.
        joint_names: names in the order of `q` and `qd`, as the driver believes it to be.
        q: joint positions [32], m or rad; the base in the odometry's frame.
        qd: joint velocities [32], m/s or rad/s; the base's first two along the odometry's x and y.
        depth_xyz: points [P,3] in the camera's optical frame, m; zeros where not valid.
        depth_rgb: colours [P,3], 0 to 255.
        depth_valid: 1 where a point is a return [P].
        depth_target: 1 where a segmenter marks the target [P]; all 0 without one.
        lidar_xyz: points [M,3] in the LiDAR's frame, m.
        lidar_valid: 1 where a point is a return [M].
    """

    stamps: dict[str, float]
    joint_names: tuple[str, ...]
    q: np.ndarray
    qd: np.ndarray
    depth_xyz: np.ndarray
    depth_rgb: np.ndarray
    depth_valid: np.ndarray
    depth_target: np.ndarray
    lidar_xyz: np.ndarray
    lidar_valid: np.ndarray


@dataclass(frozen=True)
class Command:
    """What the robot shall do next.

    Attributes:
        stamp: when it was decided, s.
        q_target: joint targets [32] inside every limit, m or rad.
        qd_target: the velocity that leads there within one policy step [32].
        action: the network's answer [32], clipped.
    """

    stamp: float
    q_target: np.ndarray
    qd_target: np.ndarray
    action: np.ndarray


@dataclass(frozen=True)
class DriverInfo:
    """How a driver describes itself before the first step; it must match the contract word for word.

    Attributes:
        joint_names: order of its arrays.
        units: as in the contract.
        camera_frame, lidar_frame: frames of the clouds that it delivers.
        rate_hz: how often it delivers readings and takes commands.
    """

    joint_names: tuple[str, ...]
    units: dict[str, str] = field(default_factory=lambda: dict(UNITS))
    camera_frame: str = "camera"
    lidar_frame: str = "lidar"
    rate_hz: float = 25.0


class Driver(Protocol):
    """A robot or a simulator. Methods may raise `Refused(REFLEX | DISCONNECTED, ...)`."""

    @property
    def info(self) -> DriverInfo:
        """Self-description, checked once against the contract."""
        ...

    def now(self) -> float:
        """The clock of the stamps, s."""
        ...

    def read(self) -> Reading:
        """The newest reading; blocks until one is due."""
        ...

    def command(self, command: Command) -> None:
        """Follow a command until the next one comes."""
        ...

    def hold(self, reason: str) -> None:
        """Come to rest and stay there; called after every refusal and at the end."""
        ...


def check_driver(info: DriverInfo, contract: Contract) -> None:
    """Compare a driver's self-description with the contract.

    Raises:
        Refused: `DRIVER_MISMATCH` with the first difference.
    """
    sensors = contract.data["sensors"]
    pairs = {
        "joint_names": (tuple(info.joint_names), contract.joint_names),
        "units": (info.units, contract.data["units"]),
        "camera_frame": (info.camera_frame, sensors["camera"]["frame"]),
        "lidar_frame": (info.lidar_frame, sensors["lidar"]["frame"]),
        "rate_hz": (info.rate_hz, contract.schema.rate_hz),
    }
    for name, (found, expected) in pairs.items():
        if found != expected:
            raise Refused(Fault.DRIVER_MISMATCH, f"driver says {name} is {found}, the contract says {expected}")

"""The safety filter: refuses bad readings by name and keeps every target inside every limit."""

from __future__ import annotations

import math

import numpy as np

from wbm.deploy.contract import Contract
from wbm.deploy.driver import SENSORS, Reading
from wbm.deploy.faults import Fault, Refused
from wbm.robot import joints

_CLOUDS = {"depth": ("camera", "depth_xyz", "depth_valid"), "lidar": ("lidar", "lidar_xyz", "lidar_valid")}
_STIFF = np.r_[joints.BASE, joints.ARM, joints.NECK]  # joints that contact cannot stop within a step
_CLOCK_SLACK_S = 1e-3


class SafetyFilter:
    """Stateful checks between sensors and policy, and exact limits between policy and robot.

    Position, velocity and acceleration limits of the target sequence hold exactly and together: the velocity is bounded
    so that braking with the acceleration limit always ends at or before the joint limit (see `brake_velocity`).
    """

    def __init__(self, contract: Contract) -> None:
        self.contract = contract
        self._dt = contract.dt
        self._names = contract.joint_names
        p, m = contract.schema.num_depth_points, contract.schema.num_lidar_points
        n = len(self._names)
        self._shapes = {
            "q": (n,), "qd": (n,), "depth_xyz": (p, 3), "depth_rgb": (p, 3), "depth_valid": (p,),
            "depth_target": (p,), "lidar_xyz": (m, 3), "lidar_valid": (m,),
        }  # fmt: skip
        self.reset()

    def reset(self) -> None:
        """Forget the past; the next reading starts a new episode."""
        self._last: Reading | None = None
        self._origin: np.ndarray | None = None
        self._low, self._high = self.contract.q_min.copy(), self.contract.q_max.copy()
        self._q_cmd: np.ndarray | None = None
        self._v_cmd = np.zeros(len(self._names))

    def check(self, reading: Reading, now: float) -> None:
        """Accept a reading or refuse it; a refused reading leaves no trace in the filter.

        Args:
            reading: what the driver delivered.
            now: time on the clock of the stamps, s.

        Raises:
            Refused: with the name of the first fault.
        """
        if not math.isfinite(now):
            raise Refused(Fault.NOT_FINITE, f"the clock says {now}")
        self._check_form(reading)
        self._check_stamps(reading, now)
        self._check_joints(reading)
        self._check_clouds(reading)
        if self._origin is None:
            self._origin = np.array(reading.q[:2], dtype=np.float64)
            half = self.contract.data["workspace"][
                "base_box_m"
            ]  # the base brakes at the box's wall as at a joint limit
            self._low[:2] = np.maximum(self._low[:2], self._origin - half)
            self._high[:2] = np.minimum(self._high[:2], self._origin + half)
            self._q_cmd = np.clip(np.asarray(reading.q, dtype=np.float64), self._low, self._high)
        self._last = reading

    def _check_form(self, reading: Reading) -> None:
        if not reading.joint_names:
            raise Refused(Fault.DROPPED, "reading has no joint names")
        if tuple(reading.joint_names) != self._names:
            wrong = next(
                (
                    f"{a} where {b} is expected"
                    for a, b in zip(reading.joint_names, self._names, strict=False)
                    if a != b
                ),
                "length",
            )
            raise Refused(Fault.WRONG_ORDER, f"joint order differs from the contract: {wrong}")
        for name, shape in self._shapes.items():
            array = getattr(reading, name)
            if array is None:
                raise Refused(Fault.DROPPED, f"reading has no {name}")
            if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
                raise Refused(
                    Fault.WRONG_TYPE,
                    f"{name} is {getattr(array, 'dtype', type(array).__name__)}, expected numbers in an array",
                )
            if array.shape != shape:
                raise Refused(Fault.WRONG_SHAPE, f"{name} has shape {array.shape}, expected {shape}")
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise Refused(Fault.NOT_FINITE, f"{name} holds values that are not finite")
        for name in ("depth_valid", "depth_target", "lidar_valid"):
            if ((getattr(reading, name) != 0) & (getattr(reading, name) != 1)).any():
                raise Refused(Fault.WRONG_TYPE, f"{name} holds values other than 0 and 1")
        if (reading.depth_rgb < 0).any() or (reading.depth_rgb > 255).any():
            raise Refused(Fault.UNITS, "depth_rgb is outside 0 to 255")

    def _check_stamps(self, reading: Reading, now: float) -> None:
        oldest = self.contract.data["max_age"]
        for sensor in SENSORS:
            stamp = (reading.stamps or {}).get(sensor)
            if stamp is None:
                raise Refused(Fault.DROPPED, f"reading has no stamp for {sensor}")
            if not math.isfinite(stamp):
                raise Refused(Fault.NOT_FINITE, f"stamp of {sensor} is {stamp}")
            if stamp > now + _CLOCK_SLACK_S:
                raise Refused(
                    Fault.FUTURE_STAMP, f"{sensor} was measured {stamp - now:.3f} s after now; check the clocks"
                )
            if now - stamp > oldest[f"{sensor}_s"]:
                raise Refused(
                    Fault.STALE,
                    f"{sensor} is {now - stamp:.3f} s old, at most {oldest[f'{sensor}_s']:.3f} s is accepted",
                )
            if self._last is not None:
                before = self._last.stamps[sensor]
                # A slow camera may repeat its frame; joints must be new in each step.
                if stamp < before or (sensor == "joints" and stamp == before):
                    raise Refused(Fault.NOT_ADVANCING, f"stamp of {sensor} went from {before:.3f} to {stamp:.3f} s")

    def _check_joints(self, reading: Reading) -> None:
        c, tol = self.contract, self.contract.data["tolerances"]
        q, qd = np.asarray(reading.q, dtype=np.float64), np.asarray(reading.qd, dtype=np.float64)
        outside = (q < c.q_min - tol["limit"]) | (q > c.q_max + tol["limit"])
        if outside.any():
            i = int(np.argmax(np.maximum(c.q_min - q, q - c.q_max)))
            scaled = np.any((np.abs(q) > 2 * np.pi + 0.1)[3:])
            if scaled:
                raise Refused(Fault.UNITS, f"{self._names[i]} reads {q[i]:.3f}: more than a turn; are these degrees?")
            raise Refused(
                Fault.OUT_OF_LIMITS, f"{self._names[i]} reads {q[i]:.4f}, outside {c.q_min[i]:.4f} to {c.q_max[i]:.4f}"
            )
        fast = np.abs(qd) > tol["velocity_factor"] * c.qd_max
        if fast.any():
            i = int(np.argmax(np.abs(qd) / c.qd_max))
            raise Refused(
                Fault.VELOCITY, f"{self._names[i]} moves at {qd[i]:.3f}, its limit is {c.qd_max[i]:.3f}; check the unit"
            )
        if self._last is not None:
            self._check_motion(reading, q, qd)
        half = c.data["workspace"]["base_box_m"]
        origin = q[:2] if self._origin is None else self._origin
        if (np.abs(q[:2] - origin) > half + tol["limit"]).any():
            raise Refused(
                Fault.WORKSPACE,
                f"the base is {np.abs(q[:2] - origin).max():.2f} m from its start, allowed {half:.2f} m",
            )

    def _check_motion(self, reading: Reading, q: np.ndarray, qd: np.ndarray) -> None:
        """Positions and velocities must tell the same story: catches permuted values, wrong scales and jumps."""
        c, tol, last = self.contract, self.contract.data["tolerances"], self._last
        assert last is not None
        dt = reading.stamps["joints"] - last.stamps["joints"]
        moved = q - np.asarray(last.q, dtype=np.float64)
        jump = np.abs(moved) - (tol["velocity_factor"] * c.qd_max * dt + tol["consistency"])
        if (jump > 0).any():
            i = int(np.argmax(jump))
            raise Refused(Fault.INCONSISTENT, f"{self._names[i]} jumped by {moved[i]:.4f} in {dt:.3f} s")
        mean = 0.5 * (qd + np.asarray(last.qd, dtype=np.float64))
        gap = np.abs(moved - mean * dt)[_STIFF] - tol["consistency"] * max(1.0, dt / self._dt)
        if (gap > 0).any():
            i = int(_STIFF[np.argmax(gap)])
            raise Refused(
                Fault.INCONSISTENT,
                f"{self._names[i]} moved {moved[i]:.4f} in {dt:.3f} s, its velocity says {mean[i] * dt:.4f}",
            )

    def _check_clouds(self, reading: Reading) -> None:
        for sensor, (limits, points, valid) in _CLOUDS.items():
            xyz = getattr(reading, points)[getattr(reading, valid) != 0]
            if not len(xyz):
                continue
            distance = np.sqrt(np.einsum("ij,ij->i", xyz, xyz, dtype=np.float64))
            bounds = self.contract.data["sensors"][limits]
            if distance.max() > bounds["max_range_m"] or np.median(distance) < bounds["min_range_m"]:
                raise Refused(
                    Fault.UNITS,
                    f"{sensor} points lie {np.median(distance):.4g} m away (median; largest {distance.max():.4g} m), "
                    f"expected {bounds['min_range_m']:.3g} to {bounds['max_range_m']:.3g} m; are these millimetres?",
                )

    def limit(self, q_target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The nearest target that all limits allow, given what was commanded before.

        Args:
            q_target: wished joint positions [32].

        Returns:
            Target [32] and the velocity towards it [32]; both become the filter's state.

        Raises:
            Refused: `POLICY_OUTPUT` for a target that is not finite, `DROPPED` before the first reading.
        """
        if self._q_cmd is None:
            raise Refused(Fault.DROPPED, "no reading was accepted yet")
        if not np.isfinite(q_target).all():
            raise Refused(Fault.POLICY_OUTPUT, "the joint target holds values that are not finite")
        c, dt, q = self.contract, self._dt, self._q_cmd
        step = c.qdd_max * dt
        upper = np.minimum(np.minimum(c.qd_max, self._v_cmd + step), brake_velocity(self._high - q, c.qdd_max, dt))
        lower = np.maximum(np.maximum(-c.qd_max, self._v_cmd - step), -brake_velocity(q - self._low, c.qdd_max, dt))
        velocity = np.clip((q_target - q) / dt, lower, upper)
        # Rounding may leave the last bit outside; the clip moves the target by less than 1e-15.
        target = np.clip(q + velocity * dt, self._low, self._high)
        self._q_cmd, self._v_cmd = target, velocity
        return target, velocity

    def rest(self) -> None:
        """The robot was told to hold: start again from where it is, at rest."""
        self._v_cmd = np.zeros(len(self._names))
        if self._last is not None:
            self._q_cmd = np.clip(np.asarray(self._last.q, dtype=np.float64), self._low, self._high)


def brake_velocity(distance: np.ndarray, acceleration: np.ndarray, dt: float) -> np.ndarray:
    """Largest velocity for one step of `dt` after which a stop within `distance` is still possible.

    With w = v / (a dt) and n = floor(w) full braking steps, step and stop need (n + 1) w - n (n + 1) / 2 in units of
    a dt^2. Solved for w at u = distance / (a dt^2): n = floor((sqrt(1 + 8 u) - 1) / 2), w = u / (n + 1) + n / 2.

    Args:
        distance: room left to the limit (>= 0), m or rad.
        acceleration: limit, m/s^2 or rad/s^2.
        dt: step, s.
    """
    unit = acceleration * dt
    u = np.maximum(distance, 0.0) / (unit * dt)
    n = np.floor((np.sqrt(1.0 + 8.0 * u) - 1.0) / 2.0)
    return unit * (u / (n + 1.0) + n / 2.0)

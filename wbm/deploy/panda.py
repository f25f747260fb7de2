"""A Panda (or FR3) arm as the arm of a driver, through libfranka in a process of its own."""

from __future__ import annotations

import json
import subprocess
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from wbm.deploy.contract import Contract
from wbm.deploy.driver import Command, Driver, DriverInfo, Reading
from wbm.deploy.faults import Fault, Refused
from wbm.robot import joints

STREAM = Path(__file__).with_name("panda_stream.py")
FCI_QDD_MAX = (
    3.0  # rad/s^2: the control interface refuses 10 (and 5,000 rad/s^3), and a lost cycle multiplies what it sees
)
_STALE_S = 0.1

# Franka Control Interface, FR3: joint ranges (rad), and offset (rad/s) and deceleration (rad/s^2) of the rule that
# narrows the velocity near their ends.
FR3_RANGE = np.array(
    [
        [-2.7501, 2.7501],
        [-1.7918, 1.7918],
        [-2.9065, 2.9065],
        [-3.0481, -0.1458],
        [-2.8101, 2.8101],
        [0.5409, 4.5205],
        [-3.0196, 3.0196],
    ]
)
FR3_ENVELOPE = ((0.30, 6.0), (0.20, 2.585), (0.20, 3.5), (0.30, 4.0), (0.35, 17.0), (0.35, 5.5), (0.35, 17.0))
_RANGE_MARGIN, _ENVELOPE_SHARE = 0.05, 0.6  # the rule also judges the measured joint, which lags its command


@dataclass(frozen=True)
class ArmState:
    """Measured arm.

    Attributes:
        stamp: monotonic time, s.
        q, qd: positions and velocities [7], rad and rad/s.
        success_rate: share of the last 100 commands that reached the arm in time.
    """

    stamp: float
    q: np.ndarray
    qd: np.ndarray
    success_rate: float = 1.0


class PandaArm:
    """The arm alone.

    Args:
        host: address of the control interface.
        contract: gives limits and rate.
        python: interpreter that has `pylibfranka` (see docs/deploy.md).
        model: "panda" or "fr3"; an FR3's narrower rules are kept on top of the contract's.
        timeout_s: how long to wait for the first state, s.

    Raises:
        ValueError: another model.
        Refused: `DISCONNECTED` when no state arrives, with libfranka's message.
    """

    def __init__(
        self, host: str, contract: Contract, python: str | Path, model: str = "panda", timeout_s: float = 15.0
    ) -> None:
        if model not in ("panda", "fr3"):
            raise ValueError(f"arm model is {model!r}, must be panda or fr3")
        arm = joints.ARM
        q_min, q_max = contract.q_min[arm], contract.q_max[arm]
        if model == "fr3":
            q_min = np.maximum(q_min, FR3_RANGE[:, 0] + _RANGE_MARGIN)
            q_max = np.minimum(q_max, FR3_RANGE[:, 1] - _RANGE_MARGIN)
        limits = {
            "period": contract.dt,
            "q_min": q_min.tolist(),
            "q_max": q_max.tolist(),
            "envelope": [(o, _ENVELOPE_SHARE * d) for o, d in FR3_ENVELOPE] if model == "fr3" else None,
            "qd_max": contract.qd_max[arm].tolist(),
            "qdd_max": np.minimum(contract.qdd_max[arm], FCI_QDD_MAX).tolist(),
        }
        self._lock = threading.Condition()
        self._given = -np.inf
        self._state: ArmState | None = None
        self._error: dict[str, str] | None = None
        self._first = threading.Event()
        self.worst_success_rate = 1.0
        self._process = subprocess.Popen(
            [str(python), str(STREAM), host, json.dumps(limits)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._reader = threading.Thread(target=self._read, name="panda-states", daemon=True)
        self._reader.start()
        if not self._first.wait(timeout_s):
            self.close()
            raise Refused(
                Fault.DISCONNECTED, f"no state from {host} within {timeout_s:.0f} s; is the control interface on?"
            )
        self._check()

    def state(self) -> ArmState:
        """The newest measured state; waits a moment for one that was not given before.

        Raises:
            Refused: `REFLEX` when the arm stopped itself, `DISCONNECTED` when states no longer come.
        """
        with self._lock:
            self._lock.wait_for(
                lambda: self._error or (self._state and self._state.stamp > self._given), timeout=_STALE_S
            )
            state = self._state
        self._check()
        assert state is not None
        self._given = state.stamp
        if time.monotonic() - state.stamp > _STALE_S:
            raise Refused(Fault.DISCONNECTED, f"no state from the arm for {time.monotonic() - state.stamp:.2f} s")
        return state

    def command(self, q_target: np.ndarray) -> None:
        """Move to `q_target` [7] within one policy period.

        Raises:
            Refused: as `state`.
        """
        self._check()
        self._send({"q": np.asarray(q_target, float).tolist()})

    def close(self) -> None:
        """Come to rest and disconnect."""
        self._send({"stop": True})
        try:
            self._process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join(timeout=5)
        for pipe in (self._process.stdin, self._process.stdout):
            with suppress(BrokenPipeError):  # what was not sent any more is of no use to an ended process
                if pipe is not None:
                    pipe.close()

    def _send(self, message: dict[str, Any]) -> None:
        pipe = self._process.stdin
        assert pipe is not None
        try:
            pipe.write(json.dumps(message) + "\n")
            pipe.flush()
        except (BrokenPipeError, ValueError, OSError):
            return  # the process has ended; `_check` knows why

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            message = json.loads(line)
            with self._lock:
                if "error" in message:
                    self._error = message
                else:
                    rate = float(message["rate"])
                    self._state = ArmState(message["t"], np.array(message["q"]), np.array(message["qd"]), rate)
                    self.worst_success_rate = min(self.worst_success_rate, rate or 1.0)  # 0 before the motion starts
                self._lock.notify_all()
            self._first.set()
        with self._lock:
            if self._error is None:
                self._error = {"error": "the stream has ended", "kind": "disconnected"}
            self._lock.notify_all()
        self._first.set()

    def _check(self) -> None:
        with self._lock:
            error = self._error
        if error is not None:
            fault = Fault.REFLEX if error["kind"] == "reflex" else Fault.DISCONNECTED
            raise Refused(fault, error["error"].replace("\n", " "))


class PandaDriver:
    """A whole robot whose arm is a Panda and whose other joints and sensors come from another driver.

    Args:
        arm: the connected arm.
        rest: drives base, hand and neck and delivers the clouds; its clock must be `time.monotonic`.
    """

    def __init__(self, arm: PandaArm, rest: Driver) -> None:
        self._arm, self._rest = arm, rest

    @property
    def info(self) -> DriverInfo:
        """As the other driver describes itself."""
        return self._rest.info

    def now(self) -> float:
        """Monotonic time, s."""
        return time.monotonic()

    def read(self) -> Reading:
        """The other driver's reading with the arm's joints in place."""
        reading, state = self._rest.read(), self._arm.state()
        q, qd = reading.q.copy(), reading.qd.copy()
        q[joints.ARM], qd[joints.ARM] = state.q, state.qd
        stamps = reading.stamps | {"joints": min(reading.stamps["joints"], state.stamp)}
        return replace(reading, q=q, qd=qd, stamps=stamps)

    def command(self, command: Command) -> None:
        """Send each part its targets."""
        self._arm.command(command.q_target[joints.ARM])
        self._rest.command(command)

    def hold(self, reason: str) -> None:
        """The arm rests at its last target by itself when no command comes; the other parts are told."""
        self._rest.hold(reason)

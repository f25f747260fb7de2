"""Streams joint targets to a Panda or FR3 at 1 kHz through libfranka; runs as a process of its own.

It needs `pylibfranka` and nothing else (not even this package), so that it can live in a virtual environment of its
own and no work in the policy's process can delay its cycle. Commands come as JSON lines on standard input, states
and errors leave as JSON lines on standard output:

    in   {"q": [7]}                    target to be reached in one policy period
         {"stop": true}                come to rest and end
    out  {"t": s, "q": [7], "qd": [7], "rate": r}    measured; r is the share of the last 100 commands that came in time
         {"error": text, "kind": "reflex" | "disconnected"}

    python panda_stream.py HOST '{"period": 0.04, "q_min": [..], "q_max": [..], "qd_max": [..], "qdd_max": [..],
                                  "envelope": [[offset, deceleration], ..] or null}'
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
import threading
import time
from typing import Any

CYCLE = 1e-3  # libfranka's control cycle, s
GAIN = 20.0  # 1/s, with which the stream follows its reference
SMOOTHING_S = 1e-2  # time constant of the last filter; bounds jerk by 2 qdd_max / SMOOTHING_S
REPORT_EVERY = 4  # cycles
MAX_MISSED = 20  # cycles; the arm stops by itself when it misses more


class Follower:
    """One joint: follows the targets of a policy within position, velocity, acceleration and jerk limits.

    The reference runs straight to each new target. The joint's velocity is the reference's plus a gain on the gap,
    boxed by the limits and by the velocity from which the joint can still brake; a first-order filter then bounds the
    jerk. The filter is a weighted mean of the past, so that it cannot leave limits that its input keeps.

    An FR3 also narrows the velocity near the ends of a joint's range: |v| <= sqrt(2 d x) - o at distance x from the
    end. `envelope` is (o, d) of that rule, in rad/s and rad/s^2.
    """

    def __init__(
        self,
        q: float,
        q_min: float,
        q_max: float,
        qd_max: float,
        qdd_max: float,
        period: float,
        envelope: tuple[float, float] | None = None,
    ) -> None:
        self.q_min, self.q_max, self.qd_max, self.qdd_max, self.period = q_min, q_max, qd_max, qdd_max, period
        self.envelope = envelope
        self.q, self.v, self.out = q, 0.0, q
        self._reference, self._slope, self._left = q, 0.0, 0
        self._blend = -math.expm1(-CYCLE / SMOOTHING_S)

    def aim(self, target: float) -> None:
        """Take a new target, to be reached one period from now."""
        self._left = max(1, round(self.period / CYCLE))
        self._slope = (target - self._reference) / (self._left * CYCLE)

    def step(self) -> float:
        """Advance one cycle and return the position to command."""
        slope = 0.0
        if self._left > 0:
            self._left -= 1
            slope = self._slope
            self._reference += slope * CYCLE
        wish = slope + GAIN * (self._reference - self.q)
        step = self.qdd_max * CYCLE
        high = min(self.qd_max, self.v + step, self._brake(self.q_max - self.q))
        low = max(-self.qd_max, self.v - step, -self._brake(self.q - self.q_min))
        self.v = min(max(wish, low), high)
        self.q = min(max(self.q + self.v * CYCLE, self.q_min), self.q_max)
        self.out += self._blend * (self.q - self.out)
        return self.out

    @property
    def resting(self) -> bool:
        """Whether the joint has come to rest at its reference."""
        return self._left == 0 and abs(self.v) < 1e-5 and abs(self.q - self.out) < 1e-6

    def _brake(self, distance: float) -> float:
        """Largest velocity from which braking ends within `distance` (see `wbm.deploy.safety.brake_velocity`)."""
        unit, distance = self.qdd_max * CYCLE, max(distance, 0.0)
        u = distance / (unit * CYCLE)
        n = math.floor((math.sqrt(1.0 + 8.0 * u) - 1.0) / 2.0)
        bound = unit * (u / (n + 1.0) + n / 2.0)
        if self.envelope is None:
            return bound
        offset, deceleration = self.envelope
        # The arm judges the velocity at the end of the cycle's move, hence half a cycle of margin on either side.
        return min(bound, max(0.0, math.sqrt(2.0 * deceleration * distance) - offset - 2.0 * deceleration * CYCLE))


class _Commands(threading.Thread):
    """Reads standard input so that the control cycle never waits for it."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.newest: list[float] | None = None
        self.stopped = False

    def run(self) -> None:
        for line in sys.stdin:
            message = json.loads(line)
            if message.get("stop"):
                break
            self.newest = message["q"]
        self.stopped = True  # also when the parent dies: its end of the pipe closes


def _ask_for_real_time() -> None:
    """Libfranka wants a real-time thread; where the system does not allow it, the cycle takes its chances."""
    with contextlib.suppress(PermissionError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(60))


def _say(message: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(message) + "\n")
    sys.stdout.flush()


def stream(host: str, limits: dict[str, Any]) -> None:
    """Control the robot until told to stop."""
    import pylibfranka as franka

    commands = _Commands()
    commands.start()
    _ask_for_real_time()
    robot = franka.Robot(host, franka.RealtimeConfig.kIgnore)
    control = robot.start_joint_position_control(franka.ControllerMode.JointImpedance)
    state, _ = control.readOnce()
    names = ("q_min", "q_max", "qd_max", "qdd_max")
    envelopes = limits["envelope"] or [None] * len(state.q_d)
    joints = [
        Follower(q, **{n: limits[n][i] for n in names}, period=limits["period"], envelope=envelopes[i])
        for i, q in enumerate(state.q_d)
    ]
    cycle, cycles = 0, 1
    while True:
        if commands.newest is not None:
            target, commands.newest = commands.newest, None
            for joint, value in zip(joints, target, strict=True):
                joint.aim(value)
        for _ in range(cycles - 1):  # cycles that this process missed and the arm extrapolated
            for joint in joints:
                joint.step()
        command = franka.JointPositions([joint.step() for joint in joints])
        command.motion_finished = commands.stopped and all(joint.resting for joint in joints)
        control.writeOnce(command)
        if cycle % REPORT_EVERY == 0:
            rate = state.control_command_success_rate
            _say({"t": time.monotonic(), "q": list(state.q), "qd": list(state.dq), "rate": rate})
        if command.motion_finished:
            return
        state, elapsed = control.readOnce()
        cycles = min(max(1, round(elapsed.to_sec() / CYCLE)), MAX_MISSED)
        cycle += 1


def main() -> int:
    """Stream until stopped; errors are told to the parent by name."""
    import pylibfranka as franka

    try:
        stream(sys.argv[1], json.loads(sys.argv[2]))
    except franka.ControlException as error:
        _say({"error": str(error), "kind": "reflex"})
        return 1
    except (franka.NetworkException, franka.FrankaException, RuntimeError) as error:
        _say({"error": str(error), "kind": "disconnected"})
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())

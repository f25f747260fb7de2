"""How a running job hears that it must go, and goes where nothing is lost.

Slurm says so with SIGUSR2 (a time limit comes near, or the job is preempted and the cluster sends the user's signal)
or with SIGTERM (preempted, or cancelled). Either way the work runs on to its next safe point, where all of it is on
disk. If none comes in time, it is broken off where it is: the last checkpoint counts.
"""

from __future__ import annotations

import signal
import time
from types import FrameType


class Stopped(BaseException):
    """The run was asked to stop; what is finished is kept. No `Exception`, so that a stage does not swallow it."""


class StopSignal:
    """Listens for Slurm's signals within a `with` block.

    Args:
        patience_s: how long a safe point may take to come; None waits for it without end.

    Attributes:
        requested: whether the job was asked to stop.
        requeue: whether the job has to queue itself again: after SIGUSR2. After SIGTERM, Slurm does what it decided.
    """

    def __init__(self, patience_s: float | None) -> None:
        self.patience_s = patience_s
        self.requested = False
        self.requeue = False

    def __enter__(self) -> StopSignal:
        signals = (signal.SIGUSR2, signal.SIGTERM)
        self._before = {number: signal.signal(number, self._hear) for number in signals}
        self._before[signal.SIGALRM] = signal.signal(signal.SIGALRM, self._break_off)
        return self

    def __exit__(self, *_: object) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def asked(self) -> bool:
        """Whether to stop at the next safe point."""
        return self.requested

    def _hear(self, number: int, _: FrameType | None) -> None:
        if not self.requested and self.patience_s is not None:
            signal.setitimer(signal.ITIMER_REAL, self.patience_s)
        self.requested = True
        self.requeue |= number == signal.SIGUSR2

    def _break_off(self, *_: object) -> None:
        raise Stopped(f"no safe point within {self.patience_s:.0f} s")


def wait_to_be_ended(limit_s: float = 900.0) -> None:
    """Idle until Slurm ends the process; a job that exits by itself would count as failed and not be requeued."""
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        time.sleep(1.0)

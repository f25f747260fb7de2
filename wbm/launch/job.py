"""What runs on the node: the task of a submission, between Slurm's signals."""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import BrokenExecutor
from pathlib import Path

from wbm.launch.stop import Stopped, StopSignal, wait_to_be_ended
from wbm.launch.submission import read, write_result


class Job:
    """The callable that submitit pickles. It holds names only: everything else is read when the job runs.

    Args:
        place: folder of the submission.
        task: name of the task.
        patience_s: see `StopSignal`.
        retries: how often the job may start again after a crash.
    """

    def __init__(self, place: Path, task: str, patience_s: float, retries: int) -> None:
        self.place, self.task, self.patience_s, self.retries = place, task, patience_s, retries

    def __call__(self) -> None:
        rank = int(os.environ.get("SLURM_PROCID", "0"))
        requeue = signal.getsignal(signal.SIGUSR2)  # submitit's, which queues the job again and exits
        _join_ranks()
        submission = read(self.place)
        module, _, function = submission.entry.partition(":")
        stop = StopSignal(self.patience_s if rank == 0 else None)  # rank 0 speaks for all
        try:
            with stop:
                try:
                    getattr(importlib.import_module(module), function)(self.place, submission.task(self.task), stop)
                except BrokenExecutor:
                    time.sleep(1.0)  # Slurm signals every process: a worker may have heard what comes here next
                    raise
        except Stopped as reason:
            print(f"stopped: {reason}", file=sys.stderr, flush=True)
        except BrokenExecutor as error:  # the kernel took a worker process, mostly for its memory
            if not stop.requested:
                if not self._may_retry(rank):
                    raise
                stop.requeue = True
            print(f"{error}; {'stopping' if stop.requested else 'starting again'}", file=sys.stderr, flush=True)
        else:
            return
        if rank == 0 and stop.requeue and not (self.place / "cancelled").exists():
            assert callable(requeue)
            _insist(requeue)
        wait_to_be_ended()

    def checkpoint(self):
        """Submitit asks what to run after requeuing: the same."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)

    def _may_retry(self, rank: int) -> bool:
        if rank == 0:
            with open(crash_file(self.place, os.environ["SLURM_JOB_ID"]), "a+", encoding="utf-8") as stream:
                stream.write("crash\n")
                stream.seek(0)
                if len(stream.readlines()) <= self.retries:
                    return True
            write_result(self.place, self.task, {"state": "failed", "message": f"crashed {self.retries + 1} times"})
        return False


def _insist(requeue: Callable[[int, None], object]) -> None:
    """Queue the job again; a controller that is away comes back. Leaves by `SystemExit` when it is done."""
    while True:
        try:
            requeue(signal.SIGUSR2, None)
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
            print(f"requeue: {error}", file=sys.stderr, flush=True)
            time.sleep(2.0)


def crash_file(place: Path, job: str) -> Path:
    """One line for each crash of a Slurm job; the batch script counts them too."""
    return place / "log" / f"crashes-{job}"


def _join_ranks() -> None:
    """Tell torch.distributed of the processes of this job, where there are several."""
    if int(os.environ.get("SLURM_NTASKS", "1")) > 1:
        from submitit.helpers import TorchDistributedEnvironment

        TorchDistributedEnvironment().export(overwrite=True)

"""Runs jobs in worker processes that keep what is expensive to build from one job to the next."""

from __future__ import annotations

import ctypes
import importlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from typing import Any

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
_PR_SET_PDEATHSIG = 1


def run_jobs(module: str, jobs: Sequence[Any], workers: int) -> Iterator[Any]:
    """Yield `module.work(job)` of every job as they finish, in no particular order.

    Each process runs one thread, so that the result does not depend on the number of processes. When the caller stops
    early, or a job fails, the processes are ended.

    Args:
        module: importable name of a module with a function `work`.
        jobs: picklable arguments.
        workers: processes at most.
    """
    if not jobs:
        return
    before = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(workers, len(jobs)), mp_context=context, initializer=_quiet)
    try:
        futures: list[Future] = [pool.submit(_work, module, job) for job in jobs]
        for future in as_completed(futures):
            yield future.result()
        # All is done: a worker that ends by itself gives back the semaphores of the libraries that it loaded, where one
        # that is terminated leaves them to multiprocessing's resource tracker, which then warns of a leak.
        pool.shutdown(wait=True)
    finally:
        for process in list((pool._processes or {}).values()):
            process.terminate()
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _quiet() -> None:
    """Ctrl-C and Slurm's warning go to the parent alone, which ends its workers; killed, it takes them along (Linux).

    Else a worker would go on writing its shard while the next run writes the same one.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGUSR2, signal.SIG_IGN)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        parent = multiprocessing.parent_process()
        if parent is not None and parent.pid != os.getppid():
            os._exit(1)  # it was killed before we asked to be told
    import torch
    import warp as wp

    torch.set_num_threads(1)
    wp.config.log_level = wp.LOG_ERROR


def _work(module: str, job: Any) -> Any:
    return importlib.import_module(module).work(job)

"""Runs jobs in processes of their own, bounded in time and memory: a job may crash without taking the run with it."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any


def run_isolated(
    function: Callable[..., Any], jobs: Sequence[tuple], workers: int, timeout: float, memory_mb: int
) -> Iterator[tuple[int, Any, str]]:
    """Call `function(*job)` for every job, `workers` at a time, each in its own process.

    Yields:
        (index, result, reason) as jobs end; a job that failed has result None and the reason in words.
    """
    context = multiprocessing.get_context("forkserver" if os.name == "posix" else "spawn")
    if os.name == "posix":
        context.set_forkserver_preload([function.__module__])
    running: dict[Connection, tuple[int, Any, float]] = {}
    waiting = iter(enumerate(jobs))
    exhausted = False
    try:
        while running or not exhausted:
            while len(running) < max(1, workers) and not exhausted:
                item = next(waiting, None)
                if item is None:
                    exhausted = True
                    break
                reader, writer = context.Pipe(duplex=False)
                process = context.Process(target=_child, args=(writer, function, item[1], memory_mb), daemon=True)
                process.start()
                writer.close()
                running[reader] = (item[0], process, time.monotonic() + timeout)
            soonest = min((end for _, _, end in running.values()), default=0.0)
            ready = wait(list(running), timeout=max(0.0, soonest - time.monotonic())) if running else []
            for reader in list(running):
                index, process, end = running[reader]
                if reader in ready:
                    yield (index, *_receive(reader, process))
                elif time.monotonic() >= end:
                    process.kill()
                    yield index, None, f"took longer than {timeout:g} s"
                else:
                    continue
                process.join()
                reader.close()
                del running[reader]
    finally:
        for _, process, _ in running.values():
            process.kill()


def _receive(reader: Connection, process: Any) -> tuple[Any, str]:
    try:
        return reader.recv()
    except (EOFError, OSError):
        process.join()
        return None, f"the process that read it ended with status {process.exitcode}"


def _child(writer: Connection, function: Callable[..., Any], job: tuple, memory_mb: int) -> None:
    if os.name == "posix":
        import resource

        limit = memory_mb << 20
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    try:
        result = (function(*job), "")
    except MemoryError:
        result = (None, f"needs more than {memory_mb} MB of memory")
    except Exception as error:  # whatever a file does to the code that reads it, the file is named and skipped
        result = (None, f"{type(error).__name__}: {str(error)[:120]}")
    writer.send(result)
    writer.close()

"""What a process can do to be on time: real-time priority, and a garbage collector with little to look at."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager

PRIORITY = 30  # above everything that is not real-time, below the kernel's own threads and a 1 kHz stream


@contextmanager
def realtime(priority: int = PRIORITY) -> Iterator[str]:
    """Run the block at SCHED_FIFO where the system allows it, with all objects made so far out of the collector's way.

    A full collection walks every object that lives: tens of milliseconds once a network is loaded. After `gc.freeze`
    it walks only what the loop itself has made.

    Yields:
        What was reached: "fifo 30", or "none" without the right to it (root, or `ulimit -r`).
    """
    gc.collect()
    gc.freeze()
    before = None
    try:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (AttributeError, OSError):  # another system, or no right to it
        before = None
    try:
        yield f"fifo {priority}" if before else "none"
    finally:
        if before:
            os.sched_setscheduler(0, *before)
        gc.unfreeze()

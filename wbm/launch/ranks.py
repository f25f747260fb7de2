"""Which of the processes that share one piece of work this one is."""

from __future__ import annotations

import os


def rank() -> int:
    """Number of this process among those of a job; 0 writes the results."""
    return int(os.environ.get("RANK", "0"))

"""Hours of closed loop on the real clock, to see whether a machine keeps up: deadlines, jitter and memory."""

from __future__ import annotations

import os
from collections import Counter
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from wbm.deploy.bundle import Bundle
from wbm.deploy.log import RunLog
from wbm.deploy.loop import run_loop, timing_summary
from wbm.deploy.probe import Probe
from wbm.deploy.realtime import realtime
from wbm.deploy.runtime import PolicyRuntime

EPISODE_S = 20.0
MAX_GROWTH_MB = 2.0  # resident memory after the first tenth of the time; a run's own figures take 16 bytes a step


def resident_mb() -> float:
    """Resident memory of this process, MB (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def soak(bundle: Bundle, minutes: float, log: Path | None = None, instruction: str = "") -> dict[str, Any]:
    """Run a bundle at its own rate against `Probe`, episode after episode, and measure.

    Args:
        bundle: the policy.
        minutes: how long.
        log: where to log as on a robot (MCAP), if at all.
        instruction: what to pick up; default: the first cached sentence.

    Returns:
        `ok` (no deadline missed, memory flat), `minutes`, `periods`, `commands`, `refusals` by name, `missed`,
        `p50_ms`, `p99_ms`, `max_ms` of the computation, `jitter_ms` and `jitter_max_ms` of the period, `rss_mb` (an
        entry an episode), `rss_growth_mb` (after the first tenth), `priority`, `load` (the machine's, over a minute).
    """
    probe = Probe(bundle.contract, real_time=True)
    runtime = PolicyRuntime(bundle, instruction or next(iter(bundle.instructions.sentences), ""))
    periods = max(1, round(minutes * 60.0 / bundle.contract.dt))
    length = round(EPISODE_S / bundle.contract.dt)
    done = commands = missed = 0
    refusals: Counter[str] = Counter()
    compute, period, memory = [], [], []
    with realtime() as priority, RunLog(log) if log else nullcontext() as writer:
        while done < periods:
            probe.home()
            report = run_loop(probe, runtime, min(length, periods - done), writer)
            done += report.steps + report.refusals.total()
            commands, missed, refusals = commands + report.steps, missed + report.missed, refusals + report.refusals
            compute.append(np.array(report.compute_s))
            period.append(np.diff(report.start_s))
            memory.append(round(resident_mb(), 2))
    growth = memory[-1] - memory[len(memory) // 10]
    timing = timing_summary(np.concatenate(compute), np.concatenate(period))
    return {
        "ok": missed == 0 and growth <= MAX_GROWTH_MB,
        "minutes": minutes,
        "periods": periods,
        "commands": commands,
        "refusals": dict(refusals),
        "missed": missed,
        **{f"{name.removesuffix('_s')}_ms": round(1e3 * value, 3) for name, value in timing.items()},
        "rss_mb": memory,
        "rss_growth_mb": round(growth, 2),
        "priority": priority,
        "load": round(os.getloadavg()[0], 2),
    }

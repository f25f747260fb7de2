"""The closed loop around a driver, and its timing."""

from __future__ import annotations

import time
from array import array
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from wbm.deploy.driver import Driver, check_driver
from wbm.deploy.faults import Refused
from wbm.deploy.log import RunLog
from wbm.deploy.runtime import PolicyRuntime


@dataclass
class LoopReport:
    """What happened in a run.

    Attributes:
        steps: commands sent.
        refusals: number of refusals by name.
        missed: deadlines missed: steps whose computation took longer than one policy period, and periods that passed
            without a step.
        compute_s: computing time of each step that ended in a command, s.
        start_s: when each reading came, s (monotonic clock).
        stopped_by: name of the refusal that ended the run, or an empty string.
    """

    steps: int = 0
    refusals: Counter[str] = field(default_factory=Counter)
    missed: int = 0
    compute_s: array[float] = field(default_factory=lambda: array("d"))
    start_s: array[float] = field(default_factory=lambda: array("d"))
    stopped_by: str = ""

    def timing(self) -> dict[str, float]:
        """See `timing_summary`."""
        return timing_summary(np.array(self.compute_s), np.diff(self.start_s))


def timing_summary(compute_s: np.ndarray, period_s: np.ndarray) -> dict[str, float]:
    """Percentiles of computing times, and how unevenly readings came.

    Args:
        compute_s: computing time of each step, s.
        period_s: time between one reading and the next, s.

    Returns:
        `p50_s`, `p99_s`, `max_s` of the computing times, `jitter_s` (standard deviation of the period) and
        `jitter_max_s` (its largest distance from the median); zeros where there is nothing to measure.
    """
    compute, period = (values if len(values) else np.zeros(1) for values in (compute_s, period_s))
    return {
        "p50_s": float(np.percentile(compute, 50)),
        "p99_s": float(np.percentile(compute, 99)),
        "max_s": float(compute.max()),
        "jitter_s": float(period.std()),
        "jitter_max_s": float(np.abs(period - np.median(period)).max()),
    }


def run_loop(
    driver: Driver, runtime: PolicyRuntime, steps: int, log: RunLog | None = None, max_refusals: int = 25
) -> LoopReport:
    """Run the policy in closed loop.

    A refusal never reaches the driver as a command: the driver holds, and the loop goes on with the next reading.

    Args:
        driver: robot or simulator.
        runtime: the policy; it is reset first.
        steps: number of periods.
        log: where to log, if at all.
        max_refusals: this many refusals in a row end the run.

    Raises:
        Refused: `DRIVER_MISMATCH` before anything moves.
    """
    check_driver(driver.info, runtime.contract)
    runtime.reset()
    report, in_a_row, dt = LoopReport(), 0, runtime.contract.dt
    before: float | None = None
    for _ in range(steps):
        try:
            reading = driver.read()
            begin = time.monotonic()
            report.start_s.append(begin)
            now = driver.now()
            report.missed += max(0, round((now - before) / dt) - 1) if before is not None else 0
            before = now
            command = runtime.step(reading, now)
            spent = time.monotonic() - begin
            driver.command(command)
        except Refused as refused:
            driver.hold(refused.fault.value)
            runtime.recover()
            report.refusals[refused.fault.value] += 1
            in_a_row += 1
            if log is not None:
                log.refusal(driver.now(), refused)
            if in_a_row >= max_refusals:
                report.stopped_by = refused.fault.value
                break
            continue
        in_a_row = 0
        report.steps += 1
        report.compute_s.append(spent)
        report.missed += spent > dt
        if log is not None:
            log.reading(reading)
            log.command(command, runtime.observation)
    driver.hold("end of run")
    return report


def measure_latency(runtime: PolicyRuntime, driver: Driver, steps: int = 1000, warmup: int = 50) -> dict[str, float]:
    """Process time and wall time of `PolicyRuntime.step` on readings of a driver, without waiting between them.

    Wall time is what the robot sees; process time is what the computation costs on a busy machine.

    Returns:
        `cpu_p50_s`, `cpu_p99_s`, `wall_p50_s`, `wall_p99_s`, `jitter_s` (standard deviation of the wall time), `steps`.
    """
    runtime.reset()
    cpu, wall = np.zeros(steps), np.zeros(steps)
    for i in range(warmup + steps):
        reading = driver.read()
        now = driver.now()
        c0, w0 = time.process_time(), time.perf_counter()
        try:
            driver.command(runtime.step(reading, now))
        except (
            Refused
        ) as refused:  # a robot without a plan may leave its workspace; that step was computed all the same
            driver.hold(refused.fault.value)
            runtime.recover()
        if i >= warmup:
            cpu[i - warmup], wall[i - warmup] = time.process_time() - c0, time.perf_counter() - w0
    return {
        "steps": steps,
        "cpu_p50_s": float(np.percentile(cpu, 50)),
        "cpu_p99_s": float(np.percentile(cpu, 99)),
        "wall_p50_s": float(np.percentile(wall, 50)),
        "wall_p99_s": float(np.percentile(wall, 99)),
        "jitter_s": float(wall.std()),
    }

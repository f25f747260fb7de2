"""Hands the tasks of a submission to Slurm through submitit, asks for their state, and cancels them."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import time
from collections.abc import Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

from wbm.launch.config import LauncherConfig
from wbm.launch.job import Job, crash_file
from wbm.launch.submission import Resources, Submission, Task, read_result, write_json

_LIVE = (
    "BOOT_FAIL,COMPLETING,CONFIGURING,PENDING,PREEMPTED,REQUEUED,REQUEUE_FED,REQUEUE_HOLD,RESIZING,RUNNING,SUSPENDED"
)
_UNLIMITED = 1_000_000  # submitit counts jobs of up to ten minutes as timed out whatever happened to them


class LaunchError(Exception):
    """Slurm refused, or is not there; the message says what to do."""


@dataclass(frozen=True)
class TaskState:
    """Where a task is.

    Attributes:
        state: `done`, `failed`, `cancelled`, `lost`, or Slurm's own word in lower case, such as `running`.
        job: Slurm's name of the job, such as `12` or `13_4`.
        message: the error, Slurm's reason for waiting, or the artifact.
        node: where it runs.
    """

    task: str
    job: str
    state: str
    message: str = ""
    node: str = ""

    @property
    def over(self) -> bool:
        """Whether nothing more will happen."""
        return self.state in ("done", "failed", "cancelled", "lost")


def require_slurm() -> None:
    """Make sure that jobs can be submitted from this machine.

    Raises:
        LaunchError: submitit or Slurm is missing.
    """
    try:
        import submitit  # noqa: F401  # pyright: ignore[reportUnusedImport]
    except ModuleNotFoundError:
        raise LaunchError("--launcher slurm needs submitit: pip install 'wbm[slurm]'") from None
    if not shutil.which("sbatch"):
        raise LaunchError("no sbatch on this machine: log in to the cluster's login node")


def submit(submission: Submission, place: Path, cfg: LauncherConfig) -> dict[str, str]:
    """Submit every group, as an array where it has several tasks, after the groups that it waits for.

    Returns:
        Slurm's job id of each group.

    Raises:
        LaunchError: Slurm refused; what was submitted before is cancelled.
    """
    import submitit
    from submitit.core.utils import FailedJobError, FailedSubmissionError

    ids: dict[str, str] = {}
    for group, tasks in submission.groups.items():
        executor = submitit.SlurmExecutor(place / "log", max_num_timeout=_UNLIMITED, python=cfg.python or None)
        needed = [ids[other] for other in tasks[0].after]
        executor.update_parameters(**_parameters(cfg, group, tasks[0].resources, needed, place))
        try:
            with redirect_stderr(StringIO()), executor.batch():  # submitit repeats what sbatch says; the error holds it
                jobs = [executor.submit(Job(place, t.name, _patience(cfg), cfg.retries)) for t in tasks]
        except (FailedJobError, FailedSubmissionError, subprocess.CalledProcessError) as error:
            _scancel(list(ids.values()))
            detail = " ".join(str(error).replace("sbatch: error:", "").split())
            raise LaunchError(f"sbatch refused {group}: {detail}") from error
        ids[group] = jobs[0].job_id.partition("_")[0]
        write_json(place / "jobs.json", ids)
    return ids


def _patience(cfg: LauncherConfig) -> float:
    """Seconds in which a safe point must come, with time left to queue again."""
    return max(cfg.grace / 2, cfg.grace - 30.0)


def _parameters(cfg: LauncherConfig, group: str, r: Resources, needed: Sequence[str], place: Path) -> dict[str, Any]:
    values: dict[str, Any] = {
        "job_name": f"wbm-{group}",
        "time": cfg.time,
        "nodes": r.nodes,
        "ntasks_per_node": r.processes,
        "cpus_per_task": cfg.cpus,
        "signal_delay_s": cfg.grace,
        "array_parallelism": cfg.parallel,
        "stderr_to_stdout": True,
        "srun_args": ["--kill-on-bad-exit=1"],  # a job must not wait for a process that is gone
        "setup": list(cfg.setup),
        "teardown": _teardown(crash_file(place, "$SLURM_JOB_ID"), cfg.retries),
        "additional_parameters": {"requeue": True, "kill-on-invalid-dep": "yes", **cfg.extra},
    }
    if needed:
        values["dependency"] = "afterok:" + ":".join(needed)
    if r.gpus:
        values["gpus_per_node"] = r.gpus
    if cfg.mem:
        values["mem"] = f"{round(cfg.mem * 1024)}M"
    for name in ("partition", "account", "qos", "constraint"):
        if getattr(cfg, name):
            values[name] = getattr(cfg, name)
    return values


def _teardown(crashes: Path, retries: int) -> list[str]:
    """Shell lines that queue a job again whose process was killed, for its memory most of the time."""
    quoted = shlex.quote(str(crashes)).replace("$SLURM_JOB_ID", "'$SLURM_JOB_ID'")
    return [
        "code=$?",
        "if [ $code -ge 134 ] && [ $code -le 139 ]; then",
        f"  echo crash >> {quoted}",
        f"  [ $(wc -l < {quoted}) -le {retries} ] && scontrol requeue $SLURM_JOB_ID",
        "fi",
        "exit $code",
    ]


def states(submission: Submission, place: Path, ids: dict[str, str]) -> list[TaskState]:
    """Where every task is: by its result, else by the queue.

    Raises:
        LaunchError: the controller does not answer.
    """
    queue: dict[str, tuple[str, str, str]] | None = None
    found = []
    for group, tasks in submission.groups.items():
        for number, task in enumerate(tasks):
            job = f"{ids[group]}_{number}" if len(tasks) > 1 else ids[group]
            result = read_result(place, task.name)
            if result:
                found.append(TaskState(task.name, job, result["state"], result.get("message", "")))
                continue
            queue = _queue(list(ids.values())) if queue is None else queue
            if job in queue:
                state, reason, node = queue[job]
                found.append(TaskState(task.name, job, state, reason, node))
            else:
                found.append(_gone(task, job, place))
    return found


def _gone(task: Task, job: str, place: Path) -> TaskState:
    result = read_result(place, task.name)  # it may have ended since
    if result:
        return TaskState(task.name, job, result["state"], result.get("message", ""))
    if (place / "cancelled").exists():
        return TaskState(task.name, job, "cancelled")
    why = "a job that it waited for failed" if task.after else "see its log"
    return TaskState(task.name, job, "lost", f"it left the queue without a result: {why}")


def _queue(ids: Sequence[str]) -> dict[str, tuple[str, str, str]]:
    """Jobs in the queue: name -> state, reason, node."""
    command = ["squeue", "-h", "-r", "-t", _LIVE, "-j", ",".join(ids), "-o", "%i|%T|%r|%N"]
    for attempt in range(6):  # a controller that restarts comes back
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode == 0 or "Invalid job id" in done.stderr:
            break
        time.sleep(2.0 * (attempt + 1))
    else:
        raise LaunchError(f"squeue: {' '.join(done.stderr.split()[-12:])}")
    rows = (line.split("|") for line in done.stdout.splitlines() if line.count("|") == 3)
    return {job: (state.lower(), "" if reason == "None" else reason, node) for job, state, reason, node in rows}


def cancel(place: Path, ids: dict[str, str]) -> None:
    """Cancel all jobs of a submission.

    Raises:
        LaunchError: the controller refuses.
    """
    (place / "cancelled").touch()  # first: a job that is told to stop must not queue itself again
    _scancel(list(ids.values()))


def _scancel(ids: list[str]) -> None:
    if ids:
        done = subprocess.run(["scancel", *ids], capture_output=True, text=True)
        if done.returncode and "Invalid job id" not in done.stderr:
            raise LaunchError(f"scancel: {' '.join(done.stderr.split())}")

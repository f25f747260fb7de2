"""`wbm jobs`: what was submitted to the cluster, its logs, and its end."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from stages.commands import composer, emit
from stages.tables import table
from wbm.launch import jobs
from wbm.launch.slurm import cancel as cancel_jobs
from wbm.launch.slurm import states


def _folder(overrides: Sequence[str]) -> Path:
    return Path(composer(overrides).launcher.folder).absolute()


def ls(overrides: Sequence[str], as_json: bool) -> None:
    """One line a submission; a line a task of the newest."""
    found = [(s, place, states(s, place, jobs.job_ids(place))) for s, place in jobs.submissions(_folder(overrides))]
    if as_json:
        emit(
            [
                {"submission": s.id, "created": s.created, "command": s.command, "folder": str(place),
                 "tasks": [asdict(t) for t in tasks]}
                for s, place, tasks in found
            ]
        )  # fmt: skip
        return
    if not found:
        sys.stdout.write("nothing submitted from here yet\n")
        return
    rows = []
    for submission, _, tasks in found:
        counts = Counter(t.state for t in tasks)
        rows.append(
            [submission.id, ", ".join(f"{k} {v}" for k, v in sorted(counts.items())), _short(submission.command)]
        )
    sys.stdout.write(table(["submission", "tasks", "command"], rows) + "\n")
    newest = [[t.task, t.job, t.state, t.node, t.message] for t in found[-1][2]]
    sys.stdout.write(table(["task", "job", "state", "node", ""], newest))


def _short(command: str) -> str:
    return command if len(command) <= 60 else command[:57] + "..."


def logs(number: str, overrides: Sequence[str], task: str, lines: int) -> None:
    """Print the end of each log."""
    submission, place = jobs.find(_folder(overrides), number)
    for state, paths in jobs.logs(place, states(submission, place, jobs.job_ids(place))):
        if task and state.task != task:
            continue
        sys.stdout.write(f"== {state.task} (job {state.job}): {state.state} {state.message}".rstrip() + "\n")
        for path in paths:
            tail = path.read_text(encoding="utf-8", errors="replace").splitlines()[-lines:]
            sys.stdout.write(f"-- {path}\n" + "".join(f"{line}\n" for line in tail))


def cancel(number: str, overrides: Sequence[str]) -> None:
    """Cancel; finished tasks keep their results, and what was made so far is continued by the next run."""
    submission, place = jobs.find(_folder(overrides), number)
    cancel_jobs(place, jobs.job_ids(place))
    sys.stdout.write(f"cancelled {submission.id}\n")

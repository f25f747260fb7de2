"""What was submitted from here: the list, the logs."""

from __future__ import annotations

import json
from pathlib import Path

from wbm.launch.slurm import LaunchError, TaskState
from wbm.launch.submission import Submission, read


def job_ids(place: Path) -> dict[str, str]:
    """Slurm's job id of each group that was submitted."""
    path = place / "jobs.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def submissions(folder: Path) -> list[tuple[Submission, Path]]:
    """All submissions below `folder`, the oldest first."""
    places = sorted(path.parent for path in folder.glob("*/submission.json"))
    return [(read(place), place) for place in places if job_ids(place)]


def find(folder: Path, number: str) -> tuple[Submission, Path]:
    """The submission whose id is, or begins with, `number`; `latest` is the newest.

    Raises:
        LaunchError: none, or several.
    """
    known = submissions(folder)
    known = known[-1:] if number == "latest" else [k for k in known if k[0].id.startswith(number)]
    if len(known) != 1:
        raise LaunchError(f"{number}: {'ambiguous' if known else 'no such submission'} in {folder}; see `wbm jobs ls`")
    return known[0]


def logs(place: Path, states: list[TaskState]) -> list[tuple[TaskState, list[Path]]]:
    """Log files of each task, one a process."""
    return [(s, sorted((place / "log").glob(f"{s.job}_[0-9]*_log.out"))) for s in states]

"""A submission: what was decided when the user pressed enter, on disk, for jobs that run hours later.

<folder>/<id>/submission.json    the tasks, frozen
              jobs.json          group -> Slurm job id
              results/TASK.json  what became of a task, written by its job
              log/               submitit's scripts and logs
              cancelled          there once the user cancelled it
"""

from __future__ import annotations

import json
import os
import secrets
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

VERSION = 1


@dataclass(frozen=True)
class Resources:
    """What a task takes: `processes` on each of `nodes`, `gpus` a node."""

    nodes: int = 1
    processes: int = 1
    gpus: int = 0


@dataclass(frozen=True)
class Task:
    """One unit of work, run by one job or by one element of a job array.

    Attributes:
        name: unique within the submission.
        group: tasks of one group are one job array, in this order.
        after: groups that must have succeeded before.
        work: what is to be done, for the entry point.
        resources: the same for all tasks of a group.
    """

    name: str
    group: str
    after: tuple[str, ...]
    work: dict[str, Any]
    resources: Resources = field(default_factory=Resources)


@dataclass(frozen=True)
class Submission:
    """Tasks that were submitted together; `entry` is the function `module:name` that a job calls."""

    id: str
    created: str
    command: str
    entry: str
    tasks: tuple[Task, ...]

    @property
    def groups(self) -> dict[str, list[Task]]:
        """Tasks by group, in order of submission."""
        found: dict[str, list[Task]] = {}
        for task in self.tasks:
            found.setdefault(task.group, []).append(task)
        return found

    def task(self, name: str) -> Task:
        """The task of this name.

        Raises:
            KeyError: there is none.
        """
        return next(task for task in self.tasks if task.name == name)


def create(folder: Path, command: str, entry: str, tasks: list[Task]) -> tuple[Submission, Path]:
    """Write a new submission below `folder`; returns it with its own folder."""
    number = time.strftime("%y%m%d-%H%M%S-") + secrets.token_hex(2)
    submission = Submission(number, time.strftime("%Y-%m-%dT%H:%M:%S%z"), command, entry, tuple(tasks))
    place = folder / number
    (place / "results").mkdir(parents=True)
    (place / "log").mkdir()
    write_json(place / "submission.json", {"version": VERSION, **asdict(submission)})
    return submission, place


def read(place: Path) -> Submission:
    """Read a submission.

    Raises:
        ValueError: written by another version.
        OSError: none there.
    """
    raw = json.loads((place / "submission.json").read_text(encoding="utf-8"))
    if raw.pop("version", None) != VERSION:
        raise ValueError(f"{place}: written by another version of wbm; submit again")
    tasks = (
        Task(t["name"], t["group"], tuple(t["after"]), t["work"], Resources(**t["resources"])) for t in raw["tasks"]
    )
    return Submission(**{**raw, "tasks": tuple(tasks)})


def write_result(place: Path, task: str, result: dict[str, Any]) -> None:
    """Say what became of a task: `state` and, by state, `artifact`, `message`, ..."""
    write_json(place / "results" / f"{task}.json", result)


def read_result(place: Path, task: str) -> dict[str, Any] | None:
    """What became of a task; None while it is not known."""
    path = place / "results" / f"{task}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None


def write_json(path: Path, value: Any) -> None:
    """Replace a file in one step."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    with open(partial, "w", encoding="utf-8") as stream:
        json.dump(value, stream, indent=1)
        stream.write("\n")
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(partial, path)

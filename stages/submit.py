"""`--launcher slurm`: freezes a plan into tasks, hands them to Slurm, and waits for them or not."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from stages.config import Config
from stages.pipeline import Outcome, StageError
from stages.plan import Node
from stages.progress import Progress
from stages.provenance import command_line, git_state
from wbm.artifacts.digest import digest_value, plain
from wbm.artifacts.store import Store
from wbm.launch.config import LauncherConfig
from wbm.launch.jobs import job_ids
from wbm.launch.slurm import TaskState, require_slurm, states, submit
from wbm.launch.submission import Resources, Submission, Task, create, read_result

ENTRY = "stages.job:main"
SHARDS = "-shards"


Made = tuple[Submission, Path]


def submit_nodes(runs: Sequence[Sequence[Node]], cfg: LauncherConfig, store: Store, *, force: bool) -> Made | None:
    """Submit what is not up to date.

    Args:
        runs: for each run, nodes in pipeline order that have been looked up.
        cfg: how.
        store: where the jobs will publish.
        force: run everything anew.

    Returns:
        The submission and its folder, or None when everything is up to date.

    Raises:
        StageError: an input is missing, or the artifacts are where jobs cannot share them.
        LaunchError: Slurm is not there or refused.
    """
    require_slurm()
    tasks = freeze(runs, cfg, force=force)
    if not tasks:
        return None
    if force:
        for task in tasks:
            if task.work["key"]:
                store.forget(task.work["artifact"])
    submission, place = create(Path(cfg.folder).absolute(), command_line(), ENTRY, tasks)
    submit(submission, place, cfg)
    return submission, place


def freeze(runs: Sequence[Sequence[Node]], cfg: LauncherConfig, *, force: bool = False) -> list[Task]:
    """The tasks of a plan, each with everything that was decided: settings, code, inputs, key.

    A stage whose work can be split becomes an array of parts and a task that joins them. An input that is still to be
    made is named by the task that makes it.
    """
    tasks: list[Task] = []
    by_identity: dict[str, str] = {}
    for nodes in runs:
        names: dict[int, str] = {}
        for node in nodes:
            if node.done and not force:
                continue
            work = _work(node, names, force)
            identity = digest_value([node.ref, work["config_digest"], work["inputs"]])
            if identity not in by_identity:
                number = sum(name.startswith(f"{node.stage.name}.") for name in by_identity.values())
                by_identity[identity] = f"{node.stage.name}.{number}"
                tasks += _tasks(by_identity[identity], node, work, cfg, {t.name: t.group for t in tasks})
            names[id(node)] = by_identity[identity]
    return tasks


def _tasks(name: str, node: Node, work: dict[str, Any], cfg: LauncherConfig, groups: dict[str, str]) -> list[Task]:
    group = node.stage.name
    after = tuple(sorted({groups[i["task"]] for i in work["inputs"].values() if "task" in i}))
    parts = node.stage.parts(node.view) if node.stage.parts else 1
    jobs = -(-parts // cfg.shards)
    made = []
    if jobs > 1:
        for j in range(jobs):
            numbers = list(range(j * cfg.shards, min(parts, (j + 1) * cfg.shards)))
            made.append(
                Task(f"{name}{SHARDS}-{j}", group + SHARDS, after, {**work, "parts": numbers}, _gpus(node, cfg))
            )
        after = (group + SHARDS,)
    return [*made, Task(name, group, after, work, _resources(node, cfg))]


def _gpus(node: Node, cfg: LauncherConfig) -> Resources:
    return Resources(gpus=min(cfg.gpus, 1) if node.stage.uses_gpu(node.view) else 0)


def _resources(node: Node, cfg: LauncherConfig) -> Resources:
    if not node.stage.ranked:
        return _gpus(node, cfg)
    gpus = cfg.gpus if node.stage.uses_gpu(node.view) else 0
    return Resources(cfg.nodes, cfg.processes_per_node(gpus), gpus)


def _work(node: Node, names: dict[int, str], force: bool) -> dict[str, Any]:
    inputs: dict[str, dict[str, str]] = {}
    for slot, manifest in node.inputs.items():
        upstream = node.upstream.get(slot)
        if upstream is not None and id(upstream) in names:
            inputs[slot] = {"task": names[id(upstream)]}
        elif manifest is None:
            needed = upstream.ref if upstream else slot
            raise StageError(f"{node.stage.name}: input {needed} does not exist; run `wbm run`, or its stage first")
        else:
            inputs[slot] = {"artifact": manifest.ref, "digest": manifest.content_digest}
    settled = node.key is not None and not any("task" in i for i in inputs.values())
    config = plain(_absolute(node.config))
    return {
        "stage": node.stage.name,
        "artifact": f"{node.ref}/{node.key[:12]}" if node.key and settled else node.ref,
        "key": node.key if settled else None,
        "config": config,
        "config_digest": digest_value(node.sections),
        "overrides": list(node.overrides),
        "code": node.code.files,
        "versions": node.code.versions,
        "inputs": inputs,
        "force": force,
        "command": command_line(),
        "git": git_state(),
    }


def _absolute(config: Config) -> Config:
    root = config.artifacts.root
    if "://" in root and not root.startswith("file://"):
        return config
    place = str(Path(root.removeprefix("file://")).expanduser().absolute())
    return replace(config, artifacts=replace(config.artifacts, root=place))


def wait(submission: Submission, place: Path, cfg: LauncherConfig, progress: Progress) -> list[TaskState]:
    """Wait until every task is over; says when one changes.

    Raises:
        StageError: a task failed or was lost.
    """
    ids, seen = job_ids(place), {}
    with progress, progress.task("jobs", total=len(submission.tasks)) as bar:
        while True:
            found = states(submission, place, ids)
            for item in found:
                if seen.get(item.task) != item.state:
                    where = f" on {item.node}" if item.node else ""
                    progress.message(f"{item.task} (job {item.job}): {item.state}{where} {item.message}".rstrip())
                    bar.update(item.over)
                    seen[item.task] = item.state
            if all(item.over for item in found):
                break
            time.sleep(cfg.poll)
    bad = [item for item in found if item.state != "done"]
    if bad:
        first = f"{bad[0].task}: {bad[0].state} {bad[0].message}".rstrip()
        raise StageError(f"{len(bad)} of {len(found)} tasks failed, {first}; `wbm jobs logs {submission.id}`")
    return found


def outcomes(runs: Sequence[Sequence[Node]], submitted: Made | None, store: Store) -> list[Outcome]:
    """What became of the nodes, as a local run would say."""
    made = {}
    for task in submitted[0].tasks if submitted else ():
        result = read_result(submitted[1], task.name) if submitted else None
        if result and "artifact" in result:
            made[digest_value([task.work["artifact"].split("/")[:2], task.work["config_digest"]])] = result
    out = []
    for node in (node for nodes in runs for node in nodes):
        result = made.get(digest_value([node.ref.split("/"), digest_value(node.sections)]))
        artifact = store.resolve(result["artifact"] if result else node.done.ref if node.done else node.ref)
        state, seconds = ("ran", result["seconds"]) if result else ("up to date", 0.0)
        out.append(Outcome(node, state, seconds, artifact.manifest, artifact.path))
    return out


def say_detached(submission: Submission, place: Path) -> None:
    """Name the submission and what to do with it."""
    sys.stderr.write(f"submitted {submission.id}: {len(submission.tasks)} tasks, in {place}\n")
    sys.stderr.write(f"`wbm jobs ls`, `wbm jobs logs {submission.id}`, `wbm jobs cancel {submission.id}`\n")

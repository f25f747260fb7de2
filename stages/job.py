"""What a Slurm job does: the task as it was frozen at submission, or nothing when the code has changed since."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from stages import registry
from stages.code import code_of
from stages.commands import open_store
from stages.config import Config
from stages.convert import convert
from stages.pipeline import StageError, follow_node, run_node
from stages.plan import Node, bare_node, compute_key
from stages.progress import Progress
from wbm.artifacts.digest import KEY_LENGTH
from wbm.artifacts.lease import TERM_S
from wbm.artifacts.manifest import Manifest
from wbm.artifacts.shards import claim_shard
from wbm.artifacts.store import Store
from wbm.launch.ranks import rank
from wbm.launch.stop import StopSignal
from wbm.launch.submission import Task, read_result, write_result


def main(place: Path, task: Task, stop: StopSignal) -> None:
    """Run a task and write its result.

    Raises:
        StageError: the code or an input has changed since, or the stage failed.
        Stopped: Slurm asked the job to stop.
    """
    began = time.monotonic()
    try:
        config: Config = convert(Config, task.work["config"])
        store = open_store(config)
        node = thaw(task.work, config, store, place)
        progress = Progress(enabled=rank() == 0)
        progress.stopping = stop.asked
        if "parts" in task.work:
            message = _make_parts(node, store, task.work["parts"], progress)
            result: dict[str, Any] = {"state": "done", "message": message}
        elif rank() > 0:
            follow_node(node, store, progress, force=task.work["force"])
            return
        else:
            outcome = run_node(node, store, progress, force=task.work["force"], stop=stop)
            ref = outcome.manifest.ref
            result = {"state": "done", "message": ref, "artifact": ref, "seconds": time.monotonic() - began}
    except Exception as error:
        if rank() == 0 and not stop.requested:
            write_result(place, task.name, {"state": "failed", "message": " ".join(str(error).split())})
        raise
    write_result(place, task.name, result)


def thaw(work: dict[str, Any], config: Config, store: Store, place: Path) -> Node:
    """The node that was frozen, its inputs found.

    Raises:
        StageError: the code, the versions or an input are not those of the submission.
    """
    stage = registry.load(work["stage"])
    code = code_of(stage.module)
    changed = _changed(work["code"], code.files) + _changed(work["versions"], code.versions)
    if changed:
        more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
        raise StageError(f"{stage.name}: {changed[0]}{more} changed since this was submitted; submit again")
    node = bare_node(stage, config, tuple(work["overrides"]), code)
    node.fixed = {slot: _input(slot, entry, store, place) for slot, entry in work["inputs"].items()}
    node.inputs = dict(node.fixed)
    node.key = compute_key(node)
    if work["key"] and work["key"] != node.key:
        raise StageError(f"{stage.name}: this is not what was submitted (key {node.key[:12]}); submit again")
    node.done = store.find(node.kind, node.name, node.key)
    node.reasons = ["it was submitted"]
    return node


def _changed(old: dict[str, str], new: dict[str, str]) -> list[str]:
    return [name for name in sorted(old.keys() | new.keys()) if old.get(name) != new.get(name)]


def _input(slot: str, entry: dict[str, str], store: Store, place: Path) -> Manifest:
    if "task" not in entry:
        manifest = store.manifest(entry["artifact"])
        if manifest.content_digest != entry["digest"]:
            raise StageError(f"input {slot}: {entry['artifact']} is not what it was at submission; submit again")
        return manifest
    result = read_result(place, entry["task"])
    if not result or "artifact" not in result:
        raise StageError(f"input {slot}: task {entry['task']} made nothing; see `wbm jobs logs {place.name}`")
    return store.manifest(result["artifact"])


def _make_parts(node: Node, store: Store, numbers: list[int], progress: Progress) -> str:
    """Make the parts that are missing, each claimed by this job alone; the joining task publishes them."""
    assert node.key is not None and node.stage.make_parts is not None
    ref = f"{node.ref}/{node.key[:KEY_LENGTH]}"
    inputs = {slot: store.resolve(manifest.ref) for slot, manifest in node.inputs.items() if manifest}
    folder = store.staging(ref) / registry.PARTS
    if node.done:
        return f"{ref} is published"
    with ExitStack() as stack:
        claims = {
            n: stack.enter_context(claim_shard(store, ref, folder, f"{n:05d}", wait_s=2 * TERM_S)) for n in numbers
        }
        places = {n: claim.path for n, claim in claims.items() if claim}
        for number in node.stage.make_parts(node.view, inputs, places, node.config.launcher.cpus):
            claim = claims[number]
            assert claim is not None
            claim.commit()
            progress.message(f"{ref}: part {number} done")
            progress.safe_point()
    return f"{ref} parts {numbers[0]} to {numbers[-1]}"

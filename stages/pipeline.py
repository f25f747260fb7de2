"""Runs a plan: each stage once, skipped when up to date, resumed when interrupted, published whole or not at all."""

from __future__ import annotations

import errno
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from stages.plan import Node, look_up
from stages.progress import Progress
from stages.provenance import command_line, environment, git_state
from stages.reasons import because
from wbm.artifacts.errors import ArtifactError
from wbm.artifacts.lease import TERM_S
from wbm.artifacts.manifest import Manifest
from wbm.artifacts.store import Artifact, Draft, Store, scratch_of
from wbm.launch.stop import Stopped, StopSignal


class StageError(Exception):
    """A stage failed; the message says which, why, and where its output is."""


class Interrupted(Stopped):
    """The user or the scheduler asked the run to stop; what is finished is kept."""


@dataclass(frozen=True)
class Outcome:
    """What became of a node: `up to date` or `ran`; `folder` holds the artifact's files."""

    node: Node
    state: str
    seconds: float
    manifest: Manifest
    folder: Path


@contextmanager
def stop_on_signals() -> Iterator[None]:
    """Turn SIGTERM and SIGINT into `Interrupted`; a second one ends the process."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, _: Any) -> None:
        signal.signal(number, signal.SIG_DFL)
        raise Interrupted(signal.Signals(number).name)

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run_nodes(
    nodes: Sequence[Node],
    store: Store,
    progress: Progress,
    *,
    force: bool = False,
    on_done: Callable[[Outcome], None] = lambda _: None,
) -> list[Outcome]:
    """Run the nodes in order, skipping those whose artifact is published.

    Args:
        nodes: from `plan.build`, in pipeline order.
        store: where to publish.
        progress: bars for the stages.
        force: run all of them, from the beginning.
        on_done: called after each node.

    Raises:
        StageError: a stage failed.
        Interrupted: Ctrl-C or SIGTERM.
        ArtifactError: the store is in the way.
    """
    outcomes = []
    for node in nodes:
        look_up(node, store)
        outcomes.append(run_node(node, store, progress, force=force))
        on_done(outcomes[-1])
    return outcomes


def run_node(
    node: Node, store: Store, progress: Progress, *, force: bool = False, stop: StopSignal | None = None
) -> Outcome:
    """Run one node that has been looked up; arguments and errors as `run_nodes`.

    With `stop`, a job's signals are heard there, and an interrupted attempt is continued even with `force`.
    """
    if node.done and not force:
        store.set_latest(node.kind, node.name, node.done.key)
        progress.message(f"{node.stage.name} {node.done.ref}: up to date")
        return Outcome(node, "up to date", 0.0, node.done, store.backend.work / node.done.ref)
    missing = [slot for slot, manifest in node.inputs.items() if manifest is None]
    if missing:
        needed = ", ".join(node.upstream[slot].ref for slot in missing)
        raise StageError(f"{node.stage.name}: input {needed} does not exist; run `wbm run`, or its stage first")
    began = time.monotonic()
    reasons = node.reasons or ["it was forced"]
    progress.message(f"{node.stage.name} {node.ref}: running {because(reasons)}")
    artifact = _execute(node, store, progress, force, stop)
    if node.done and node.done.content_digest != artifact.manifest.content_digest:
        change = _first_change(node.done, artifact.manifest)
        progress.message(f"WARNING {artifact.ref}: the forced run gave other bytes than before: {change}")
    node.done, node.reasons = artifact.manifest, []
    return Outcome(node, "ran", time.monotonic() - began, artifact.manifest, artifact.path)


def _first_change(old: Manifest, new: Manifest) -> str:
    before = {e.path: e.content or e.digest for e in old.files}
    after = {e.path: e.content or e.digest for e in new.files}
    changed = [path for path in sorted(before.keys() | after.keys()) if before.get(path) != after.get(path)]
    return f"{len(changed)} of {len(after)} files differ, the first is {changed[0]}" if changed else "same files"


def follow_node(node: Node, store: Store, progress: Progress, *, force: bool = False) -> None:
    """Take part in a node's work as one of several processes; rank 0 runs `run_node` and writes."""
    if node.done and not force:
        return
    with tempfile.TemporaryDirectory() as folder:
        draft = Follower(Path(folder), scratch_of(store.staging(node.manifest().ref)))
        node.stage.run(node.view, _inputs(node, store), draft, progress)


@dataclass
class Follower:
    """The draft of a process that writes nothing that lasts: what it may read is where rank 0 writes it."""

    path: Path
    scratch: Path
    metrics: dict[str, Any] = field(default_factory=dict)
    seeds: dict[str, int] = field(default_factory=dict)


def _inputs(node: Node, store: Store) -> dict[str, Artifact]:
    return {slot: store.resolve(manifest.ref) for slot, manifest in node.inputs.items() if manifest}


def _execute(node: Node, store: Store, progress: Progress, force: bool, stop: StopSignal | None) -> Artifact:
    inputs = _inputs(node, store)
    manifest = replace(node.manifest(), command=command_line(), git=git_state(), environment=environment())
    wait_s = node.config.artifacts.wait if stop is None else max(node.config.artifacts.wait, 2 * TERM_S)
    draft = store.begin(manifest, force=force, resume=stop is not None, wait_s=wait_s)
    try:
        with stop_on_signals() if stop is None else nullcontext():
            with progress:
                node.stage.run(node.view, inputs, draft, progress)
            draft.manifest = replace(draft.manifest, environment=environment())
            return draft.publish()
    except (Stopped, KeyboardInterrupt) as reason:
        draft.keep()
        raise Interrupted(f"{node.stage.name}: interrupted; run the same command again to continue") from reason
    except Exception as error:
        if stop is not None and stop.requested:  # processes that heard the signal themselves are gone
            draft.keep()
            raise Interrupted(f"{node.stage.name}: {_text(error)} while stopping") from error
        if stop is not None and isinstance(error, BrokenExecutor):
            draft.keep()
            raise
        raise _failure(node, draft, error) from error


def _failure(node: Node, draft: Draft, error: Exception) -> Exception:
    """Keep what a retry can use, quarantine what it cannot, and say what happened in one line."""
    cause = _root_cause(error)
    if isinstance(cause, OSError) and cause.errno in (errno.ENOSPC, errno.EDQUOT):
        draft.keep()
        return StageError(f"{node.stage.name}: no disk space left at {draft.path}; free some and run again to continue")
    if isinstance(error, FileNotFoundError):  # a setting that names no file: trying again would not help
        draft.keep()
        return StageError(f"{node.stage.name}: {_text(error)}")
    if isinstance(error, (OSError, MemoryError, BrokenExecutor)):
        draft.keep()
        return StageError(f"{node.stage.name}: {_text(error)}; finished parts are kept, run again to continue")
    if isinstance(error, ArtifactError):
        draft.keep()
        return error
    try:
        place = f"; its output is in {draft.discard()}"
    except OSError:
        place = ""
    return StageError(f"{node.stage.name}: {_text(error)}{place}")


def _root_cause(error: BaseException) -> BaseException:
    while error.__cause__ or error.__context__:
        error = error.__cause__ or error.__context__  # pyright: ignore[reportAssignmentType]
    return error


def _text(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return text if isinstance(error, (ValueError, OSError)) and text else f"{type(error).__name__}: {text}"

"""The commands behind `wbm run`, the stages and `wbm plan`."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from typer import Exit

from stages import plan as planning
from stages import registry
from stages.compose import Composed, compose, defaults_list, expand, swept_keys, to_yaml
from stages.config import Config
from stages.convert import ConfigError
from stages.pipeline import Outcome, StageError, run_node, run_nodes
from stages.progress import Progress
from stages.reasons import because
from stages.tables import results_table, sweep_table
from wbm.artifacts.digest import plain
from wbm.artifacts.errors import ArtifactError
from wbm.artifacts.reference import WORD
from wbm.artifacts.store import Store

LAUNCHERS = ("local", "slurm")


@dataclass(frozen=True)
class Options:
    """Options of `wbm run` and the stages; `stage` is None for all of them, `until` the last one to run."""

    stage: str | None
    overrides: tuple[str, ...]
    cfg: bool = False
    info: bool = False
    multirun: bool = False
    launcher: str = "local"
    detach: bool = False
    force: bool = False
    as_json: bool = False
    until: str | None = None
    source: str | None = None  # `reference`: its results stand in for the long stages


def composer(overrides: Sequence[str]) -> Config:
    """Typed configuration for override lines."""
    return compose(overrides).config


def open_store(config: Config) -> Store:
    """The store of a configuration, with the reference results."""
    return Store.open(config.artifacts.root, reference_dir(config))


def reference_dir(config: Config) -> Path:
    """Folder of the reference results: what the settings name, else beside `stages/` or, in a wheel, inside it."""
    if config.artifacts.reference:
        return Path(config.artifacts.reference).expanduser().absolute()
    here = Path(__file__).resolve().parent
    return here / "reference" if (here / "reference").is_dir() else here.parent / "artifacts" / "reference"


def emit(document: Any) -> None:
    """Write one JSON document on standard output."""
    sys.stdout.write(json.dumps(document, indent=2, default=str) + "\n")


def run_command(options: Options) -> None:
    """Run one stage or the pipeline, once or for each point of a sweep.

    Raises:
        ConfigError: bad settings or options.
        StageError: a stage failed.
    """
    if options.launcher not in LAUNCHERS:
        raise ConfigError(f"--launcher {options.launcher}: choose {' or '.join(LAUNCHERS)}")
    if options.detach and options.launcher == "local":
        raise ConfigError("--detach needs --launcher slurm")
    _known_stage(options.until)
    _known_source(options.source)
    if options.info:
        sys.stdout.write(defaults_list(options.overrides) + "\n")
        return
    runs = expand(options.overrides) if options.multirun else [list(options.overrides)]
    composed = [compose(lines) for lines in runs]
    if options.cfg:
        _print_config(options, composed)
    elif options.launcher == "slurm":
        _submit(options, composed)
    elif options.multirun:
        _sweep(options, composed)
    else:
        outcomes = run_once(options, runs[0])
        if options.as_json:
            # An evaluation's numbers are what a script asks for: they stand at the top.
            numbers = outcomes[-1].manifest.metrics if options.stage == "evaluate" else {}
            emit({**numbers, **_document(outcomes)})
        else:
            sys.stdout.write(results_table(outcomes))


def _known_stage(name: str | None) -> None:
    if name is not None and name not in registry.MODULES:
        raise ConfigError(f"--until {name}: no such stage; there are {', '.join(registry.MODULES)}")


def _known_source(name: str | None) -> None:
    if name not in (None, WORD):
        raise ConfigError(f"--from {name}: only '{WORD}' is known; name other artifacts with +inputs.SLOT=KIND/NAME")


def _print_config(options: Options, composed: Sequence[Composed]) -> None:
    values = [plain(item.config) for item in composed]
    if options.stage is not None:
        sections = registry.load(options.stage).sections
        values = [{name: value[name] for name in ("artifacts", *sections)} for value in values]
    if options.as_json:
        emit(values[0] if len(values) == 1 else values)
    else:
        sys.stdout.write("---\n".join(to_yaml(value) for value in values))


def run_once(options: Options, overrides: Sequence[str]) -> list[Outcome]:
    """Run one stage, or the pipeline, under one configuration."""
    store = open_store(composer(overrides))
    progress = Progress()
    if options.stage is None:
        nodes = _pipeline(options, overrides, store, progress)
        return run_nodes(nodes, store, progress, force=options.force)
    return [run_node(_single(options, overrides, store, progress), store, progress, force=options.force)]


def _pipeline(options: Options, overrides: Sequence[str], store: Store, progress: Progress) -> list[planning.Node]:
    stages = registry.load_until(options.until) if options.until else registry.load_all()
    nodes = planning.build(stages, overrides, composer, store, reference=options.source == WORD)
    _announce(nodes, store, progress)
    return nodes


def _single(options: Options, overrides: Sequence[str], store: Store, progress: Progress) -> planning.Node:
    """The node of one stage, looked up with the newest inputs there are."""
    assert options.stage is not None
    stages = registry.load_until(options.stage)
    nodes = planning.single(stages[-1], stages, overrides, composer, store, reference=options.source == WORD)
    _announce(nodes[-1:], store, progress)
    for node in nodes:
        planning.look_up(node, store, use_latest=node is nodes[-1])
    for upstream in nodes[:-1]:
        if upstream.kind == "assets" and options.stage == "evaluate" and _other_world(upstream, store):
            run_node(upstream, store, progress)
            planning.look_up(nodes[-1], store, use_latest=True)
    for upstream in nodes[:-1]:
        if upstream.stale and store.latest(upstream.kind, upstream.name):
            reasons = because(upstream.reasons)
            progress.message(f"note: input {upstream.ref} is not up to date ({reasons}); using the newest")
    return nodes[-1]


def _submit(options: Options, composed: Sequence[Composed]) -> None:
    """Submit every point to Slurm in one submission; a stage that has a suite runs all of it unless one is named."""
    from stages import submit

    progress, config = Progress(), composed[0].config
    store = open_store(config)
    runs = []
    for item in composed:
        if options.stage is None:
            runs.append(planning.plan(_pipeline(options, item.overrides, store, progress), store))
            continue
        each = registry.load(options.stage).each
        named = each is None or any(line.lstrip("+").split("=")[0] == each[0] for line in item.overrides)
        entries = [()] if named or each is None else [(f"{each[0]}={e}",) for e in getattr(item.config, each[1])]
        runs.append([_single(options, (*item.overrides, *extra), store, progress) for extra in entries])
    made = submit.submit_nodes(runs, config.launcher, store, force=options.force)
    if made and options.detach:
        submit.say_detached(*made)
        if options.as_json:
            emit({"submission": made[0].id, "folder": str(made[1]), "tasks": [task.name for task in made[0].tasks]})
        return
    if made:
        submit.say_detached(*made)
        submit.wait(*made, config.launcher, progress)
    done = submit.outcomes(runs, made, store)
    if options.as_json:
        emit(_document(done))
    else:
        sys.stdout.write(results_table(done))


def _announce(nodes: Sequence[planning.Node], store: Store, progress: Progress) -> None:
    """Say which inputs are reference results."""
    used = {m.ref for node in nodes for m in node.fixed.values()}
    for text in store.references.names():
        if (ref := store.references.get(text).ref) in used:
            progress.message(f"{text} is used as {ref}")


def _other_world(assets: planning.Node, store: Store) -> bool:
    """Whether the assets that are asked for differ in their settings from the newest: those would not do in place."""
    newest = store.latest(assets.kind, assets.name)
    return assets.stale and (newest is None or newest.config != assets.sections)


def _sweep(options: Options, composed: Sequence[Composed]) -> None:
    """Run every point; a failed one does not stop the others. One table at the end."""
    swept = swept_keys(options.overrides)
    rows = []
    failed = 0
    for number, item in enumerate(composed, 1):
        point = [line for line in item.overrides if line.lstrip("+~").split("=")[0] in swept]
        Progress().message(f"run {number} of {len(composed)}: {' '.join(point)}")
        try:
            rows.append((point, run_once(options, item.overrides), None))
        except (StageError, ArtifactError) as error:
            failed += 1
            rows.append((point, [], str(error)))
            Progress().message(f"wbm: {error}")
    if options.as_json:
        emit([{"overrides": point, "error": error, **_document(outcomes)} for point, outcomes, error in rows])
    else:
        sys.stdout.write(sweep_table(rows))
    if failed:
        raise StageError(f"{failed} of {len(composed)} runs failed")


def _document(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    return {
        "stages": [
            {
                "stage": o.node.stage.name,
                "artifact": o.manifest.ref,
                "state": o.state,
                "seconds": round(o.seconds, 3),
                "wall_time_s": o.manifest.wall_time_s,
                "content_digest": o.manifest.content_digest,
                "metrics": o.manifest.metrics,
            }
            for o in outcomes
        ]
    }


def plan_command(
    overrides: Sequence[str], check: bool, as_json: bool, until: str | None = None, source: str | None = None
) -> None:
    """Print which stages would run and why; with `check`, exit with 3 when there are any."""
    _known_stage(until)
    _known_source(source)
    store = open_store(composer(overrides))
    stages = registry.load_until(until) if until else registry.load_all()
    nodes = planning.build(stages, overrides, composer, store, reference=source == WORD)
    planning.plan(nodes, store)
    if as_json:
        emit({"stale": any(node.stale for node in nodes), "stages": [_plan_entry(node) for node in nodes]})
    else:
        for node in nodes:
            state = f"would run {because(node.reasons)}" if node.stale else "up to date"
            sys.stdout.write(f"{node.stage.name:18} {node.ref:24} {state}\n")
    if check and any(node.stale for node in nodes):
        raise Exit(3)


def _plan_entry(node: planning.Node) -> dict[str, Any]:
    return {
        "stage": node.stage.name,
        "artifact": node.done.ref if node.done else node.ref,
        "state": "up to date" if node.done else "would run",
        "key": node.key,
        "reasons": node.reasons,
    }

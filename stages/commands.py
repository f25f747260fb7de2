"""The commands behind `wbm run`, the stages and `wbm plan`."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from typer import Exit

from stages import plan as planning
from stages import registry
from stages.compose import Composed, compose, defaults_list, expand, to_yaml
from stages.config import Config
from stages.convert import ConfigError
from stages.pipeline import Outcome, run_node, run_nodes
from stages.progress import Progress
from wbm.artifacts.digest import plain
from wbm.artifacts.store import Store


def composer(overrides: Sequence[str]) -> Config:
    """Typed configuration for override lines."""
    return compose(overrides).config


def open_store(config: Config) -> Store:
    """The store of a configuration, with the committed reference results of the checkout."""
    reference = Path(__file__).resolve().parent.parent / "artifacts" / "reference"
    return Store.open(config.artifacts.root, reference if reference.is_dir() else None)


def emit(document: Any) -> None:
    """Write one JSON document on standard output."""
    sys.stdout.write(json.dumps(document, indent=2, default=str) + "\n")


def run_command(
    stage: str | None,
    overrides: list[str],
    cfg: bool,
    info: bool,
    multirun: bool,
    launcher: str,
    detach: bool,
    force: bool,
    as_json: bool,
) -> None:
    """Run one stage, or all of them when `stage` is None."""
    if launcher not in ("local", "slurm"):
        raise ConfigError(f"--launcher {launcher}: choose local or slurm")
    if detach and launcher == "local":
        raise ConfigError("--detach needs --launcher slurm")
    if info:
        sys.stdout.write(defaults_list(overrides) + "\n")
        return
    runs = expand(overrides) if multirun else [overrides]
    composed = [compose(lines) for lines in runs]
    if cfg:
        _print_config(stage, composed, as_json)
        return
    results = [_run_one(stage, list(item.overrides), Progress(), force) for item in composed]
    if as_json:
        emit(_document(results[0]) if not multirun else [_document(r) for r in results])
    else:
        from stages.tables import results_table

        for result in results:
            sys.stdout.write(results_table(result))


def _print_config(stage: str | None, composed: list[Composed], as_json: bool) -> None:
    values = [plain(item.config) for item in composed]
    if stage is not None:
        sections = registry.load(stage).sections
        values = [{name: value[name] for name in ("artifacts", *sections)} for value in values]
    if as_json:
        emit(values[0] if len(values) == 1 else values)
    else:
        sys.stdout.write("---\n".join(to_yaml(value) for value in values))


def _run_one(stage: str | None, overrides: list[str], progress: Progress, force: bool) -> list[Outcome]:
    store = open_store(composer(overrides))
    stages = registry.load_all() if stage is None else registry.load_until(stage)
    if stage is None:
        return run_nodes(planning.build(stages, overrides, composer, store), store, progress, force=force)
    nodes = planning.single(stages[-1], stages, overrides, composer, store)
    for node in nodes:
        planning.look_up(node, store, use_latest=node is nodes[-1])
    for upstream in nodes[:-1]:
        if upstream.stale and store.latest(upstream.kind, upstream.name):
            progress.message(
                f"note: input {upstream.ref} is not up to date ({planning.because(upstream.reasons)}); using the newest"
            )
    return [run_node(nodes[-1], store, progress, force=force)]


def _document(outcomes: list[Outcome]) -> dict[str, Any]:
    return {
        "stages": [
            {
                "stage": o.node.stage.name,
                "artifact": o.manifest.ref,
                "state": o.state,
                "seconds": round(o.seconds, 3),
                "content_digest": o.manifest.content_digest,
                "metrics": o.manifest.metrics,
            }
            for o in outcomes
        ]
    }


def plan_command(overrides: list[str], check: bool, as_json: bool) -> None:
    """Print which stages would run and why; with `check`, exit with 3 when there are any."""
    store = open_store(composer(overrides))
    nodes = planning.plan(planning.build(registry.load_all(), overrides, composer, store), store)
    if as_json:
        emit(
            {
                "stale": any(node.stale for node in nodes),
                "stages": [
                    {
                        "stage": node.stage.name,
                        "artifact": node.done.ref if node.done else node.ref,
                        "state": "up to date" if node.done else "would run",
                        "key": node.key,
                        "reasons": node.reasons,
                    }
                    for node in nodes
                ],
            }
        )
    else:
        for node in nodes:
            state = f"would run {planning.because(node.reasons)}" if node.stale else "up to date"
            sys.stdout.write(f"{node.stage.name:18} {node.ref:24} {state}\n")
    if check and any(node.stale for node in nodes):
        raise Exit(3)

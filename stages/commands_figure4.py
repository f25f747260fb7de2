"""The commands behind `--figure4`: the runs of the ablation as a plan of their own, resumable and shareable."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from typer import Exit

from stages import plan as planning
from stages import registry
from stages.commands import composer, emit, open_store
from stages.convert import ConfigError
from stages.pipeline import StageError, run_node
from stages.plan import Node, bare_node
from stages.progress import Progress
from stages.reasons import because
from stages.tables import seconds, table
from wbm.artifacts.errors import ArtifactError, Conflict
from wbm.artifacts.store import Store

_SELDOM = 0.05
_SET_HERE = ("env", "policy", "figure4.arm", "figure4.seed")


@dataclass
class Sweep:
    """Nodes in the order in which they run; `runs` are those that the figure is made of, by the figure's slot."""

    nodes: list[Node] = field(default_factory=list)
    runs: dict[str, Node] = field(default_factory=dict)

    @property
    def figure(self) -> Node:
        """The figure itself."""
        return self.nodes[-1]


def build(overrides: Sequence[str], store: Store) -> Sweep:
    """Everything that the figure needs under these settings.

    Raises:
        ConfigError: bad settings, or one that the sweep sets itself.
    """
    for line in overrides:
        if line.lstrip("+").split("=")[0] in _SET_HERE:
            raise ConfigError(f"{line}: --figure4 sets this for each run; leave it out")
    figure = composer(overrides).figure4
    sweep = Sweep()
    if figure.reading in ("student", "both"):
        sweep.nodes += planning.build(registry.load_until("evaluate"), [*overrides, "env=full"], composer, store)
    else:
        sweep.nodes += planning.build(registry.load_until("prepare-assets"), overrides, composer, store)
    if figure.reading in ("rl", "both"):
        for seed in range(figure.seeds):  # a seed of every arm first, so that an early look is a fair one
            for arm in figure.arms:
                sweep.runs[f"rl/{arm}/{seed}"] = _rl_run(sweep, arm, seed, overrides)
    if figure.reading in ("student", "both"):
        for arm in figure.arms:
            sweep.runs[f"student/{arm}"] = _student(sweep, arm, overrides, store)
    node = bare_node(registry.load("figure4"), composer(overrides), overrides)
    node.upstream = dict(sweep.runs)
    sweep.nodes.append(node)
    return sweep


def _find(sweep: Sweep, ref: str) -> Node | None:
    return next((node for node in sweep.nodes if node.ref == ref), None)


def _of_kind(sweep: Sweep, kind: str) -> Node:
    return next(node for node in sweep.nodes if node.kind == kind)


def _rl_run(sweep: Sweep, arm: str, seed: int, overrides: Sequence[str]) -> Node:
    """The node of an RL run, added unless it is there."""
    lines = [*overrides, f"env={arm}", f"figure4.arm={arm}", f"figure4.seed={seed}"]
    node = bare_node(registry.load("figure4-run"), composer(lines), lines)
    known = _find(sweep, node.ref)
    if known:
        return known
    node.upstream = {"assets": _of_kind(sweep, "assets")}
    sweep.nodes.append(node)
    return node


def _student(sweep: Sweep, arm: str, overrides: Sequence[str], store: Store) -> Node:
    """The evaluation of an arm's student, with the nodes it needs.

    The full arm is the pipeline's own student. Without active vision the same teachers (they know the target's pose
    anyway) act while the neck stays at home. In joint space there is no controller to lead an episode, so that the
    RL run's policy makes the trajectories.
    """
    if arm == "full":
        return _of_kind(sweep, "evaluation")
    assets = _of_kind(sweep, "assets")
    lines = [*overrides, f"env={arm}"]
    if arm == "joint_space":
        policy = _rl_run(sweep, arm, 0, overrides)
        planning.plan([assets, policy], store)
        rate = policy.done.metrics["success_rate"] if policy.done else 0.0
        # Of a policy that hardly ever succeeds the student imitates all trajectories: the successes are too few.
        rolled = [*lines, "env.observe=seen", *(["rollouts.keep=all"] if rate < _SELDOM else [])]
        made_by = [policy]
    else:
        made_by, rolled = [node for node in sweep.nodes if node.stage.name == "train-teacher"], lines
    rollouts = bare_node(registry.load("generate-rollouts"), composer(rolled), rolled, name=arm)
    rollouts.upstream = {"assets": assets, **{node.ref: node for node in made_by}}
    student = bare_node(registry.load("distill"), composer(lines), lines, name=arm)
    student.upstream = {"rollouts": rollouts}
    evaluation = bare_node(registry.load("evaluate"), composer(lines), lines, name=arm)
    evaluation.upstream = {"assets": assets, "policy": student}
    sweep.nodes += [rollouts, student, evaluation]
    return evaluation


def figure4_command(overrides: Sequence[str], force: bool = False, as_json: bool = False) -> None:
    """Run what is missing, then make the figure.

    A run that another process is making is left to it, so that the command may be started several times at once.

    Raises:
        ConfigError: bad settings.
        StageError: runs failed, or are still being made elsewhere.
    """
    store, progress = open_store(composer(overrides)), Progress()
    sweep, report = build(overrides, store), Report()
    learned = [node for node in sweep.nodes if node.stage.name in ("prepare-assets", "figure4-run")]
    _work(learned, store, progress, force, report)
    if composer(overrides).figure4.reading != "rl":
        sweep = build(overrides, store)  # how a student is made depends on how its arm's policy came out
        planning.plan(sweep.nodes, store)
    refs = {node.ref for node in learned}
    _work([node for node in sweep.nodes if node.ref not in refs], store, progress, force, report)
    figure = sweep.figure.done
    if figure is None:
        parts = [f"{len(report.failed)} failed ({', '.join(report.failed)})"] if report.failed else []
        parts += [f"{len(report.elsewhere)} are being made by another process"] if report.elsewhere else []
        raise StageError(f"figure4: {' and '.join(parts)}; run the same command again to continue")
    folder = store.resolve(figure.ref).path
    if as_json:
        emit({"artifact": figure.ref, **json.loads((folder / "figure4.json").read_text())})
    else:
        _print(json.loads((folder / "figure4.json").read_text()), folder)


@dataclass
class Report:
    """Artifacts that failed, and those that another process is making."""

    failed: list[str] = field(default_factory=list)
    elsewhere: list[str] = field(default_factory=list)


def _work(nodes: Sequence[Node], store: Store, progress: Progress, force: bool, report: Report) -> None:
    """Run the nodes in order; one that fails does not stop the others."""
    for node in nodes:
        planning.look_up(node, store)
        if any(manifest is None for manifest in node.inputs.values()):
            continue  # what it needs failed or is being made elsewhere
        try:
            run_node(node, store, progress, force=force and node.stage.name in registry.FIGURE4)
        except Conflict:
            report.elsewhere.append(node.ref)
        except (StageError, ArtifactError) as error:
            report.failed.append(node.ref)
            progress.message(f"wbm: {error}")


def _print(figure: dict[str, Any], folder: Path) -> None:
    rows = []
    for reading in figure["readings"]:
        for arm in reading["arms"]:
            low, high = arm["success_ci95"]
            seen = "" if arm["target_visible"] is None else f"{arm['target_visible']:.2f}"
            success = f"{arm['success_rate']:.3f} ({low:.3f} to {high:.3f})"
            rows.append([reading["key"], arm["key"], str(arm["episodes"]), success, f"{arm['paper']:.1f}", seen])
    sys.stdout.write("\n" + table(["reading", "arm", "episodes", "success", "paper", "target in view"], rows))
    sys.stdout.write(f"report  {folder / 'report.html'}\n")


def figure4_plan(overrides: Sequence[str], check: bool = False, as_json: bool = False) -> None:
    """Print what is done and what is left; with `check`, exit with 3 when anything is."""
    store = open_store(composer(overrides))
    sweep = build(overrides, store)
    planning.plan(sweep.nodes, store)
    entries = [_entry(node, store) for node in sweep.nodes]
    left = sum(entry["state"] != "done" for entry in entries)
    if as_json:
        emit({"left": left, "of": len(entries), "runs": entries})
    else:
        sys.stdout.write(
            table(["artifact", "state", "success"], [[e["artifact"], _state(e), _success(e)] for e in entries])
        )
        sys.stdout.write(f"{left} of {len(entries)} left\n")
    if check and left:
        raise Exit(3)


def _entry(node: Node, store: Store) -> dict[str, Any]:
    entry: dict[str, Any] = {"stage": node.stage.name, "artifact": node.done.ref if node.done else node.ref}
    if node.done:
        metrics = node.done.metrics
        return entry | {"state": "done", "success_rate": metrics.get("success_rate"), "seconds": node.done.wall_time_s}
    started = _progress(node, store)
    if started:
        return entry | {"state": "started", **started}
    return entry | {"state": "to do", "reasons": node.reasons}


def _progress(node: Node, store: Store) -> dict[str, Any]:
    """How far an interrupted or running attempt at exactly this run has come."""
    if node.key is None:
        return {}
    scratch = store.backend.work / ".staging" / f"{node.manifest().ref}.scratch"
    try:
        return json.loads((scratch / "progress.json").read_text())
    except (OSError, ValueError):
        return {}


def _state(entry: dict[str, Any]) -> str:
    if entry["state"] == "done":
        return f"done in {seconds(entry['seconds'])}"
    if entry["state"] == "started":
        return f"iteration {entry['iteration']} of {entry['iterations']}"
    return f"to do {because(entry['reasons'])}"


def _success(entry: dict[str, Any]) -> str:
    value = entry.get("success_rate", entry.get("success"))
    return "" if value is None or value != value else f"{value:.2f}"

"""Figure 4 of the paper from the runs of the ablation: gathered numbers, pictures and a page."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wbm.report.page import render
from wbm.report.plots import curves_figure, figure4, figure4_panels, to_png, to_svg
from wbm.report.stats import ARM_LABELS, PAPER_SUCCESS, percent, rate, summarise, verdict

READINGS = {
    "rl": (
        "RL stage",
        "One policy a run, trained by PPO on the whole-body episode. It knows the target's pose only while the camera "
        "sees it; otherwise the last seen pose and its age. Curves: mean over seeds of the reward a step, band from "
        "the smallest to the largest seed. Bars: lifting success of the last policies on held-out objects in fine "
        "physics, episodes of all seeds together, with Wilson 95 % intervals.",
    ),
    "student": (
        "Distilled student",
        "One student an arm, distilled from trajectories made in the arm's environment; it sees point clouds alone. "
        "Bars: lifting success on held-out objects in fine physics with Wilson 95 % intervals.",
    ),
}
_POINTS = 80
_TEMPLATE = Path(__file__).with_name("figure4.html.j2")


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes:
        reading: `rl` or `student`.
        arm: `full`, `no_active_vision` or `joint_space`.
        seed: of the run.
        records: one dictionary an episode of its evaluation, as `summarise` takes them.
        curve: lists an iteration, `env_steps`, `reward` and `success` among them; None for students.
    """

    reading: str
    arm: str
    seed: int
    records: list[dict[str, Any]]
    curve: dict[str, list[float | None]] | None = None


def gather(runs: Sequence[Run]) -> dict[str, Any]:
    """Numbers of the figure, JSON-ready: `readings`, each with `arms`, `verdict` and the paper's values beside."""
    readings = []
    for key, (name, note) in READINGS.items():
        mine = [run for run in runs if run.reading == key]
        arms = [
            _arm(arm, [r for r in mine if r.arm == arm]) for arm in PAPER_SUCCESS if any(r.arm == arm for r in mine)
        ]
        if arms:
            said = [*verdict(name, arms), *_seen(arms)]
            readings.append({"key": key, "name": name, "note": note, "arms": arms, "verdict": said})
    return {"readings": readings}


def _arm(arm: str, runs: list[Run]) -> dict[str, Any]:
    records = [record for run in runs for record in run.records]
    summary = summarise(records)
    keys = (
        "episodes",
        "success_rate",
        "success_ci95",
        "collision_rate",
        "target_visible",
        "time_to_grasp_s",
        "failures",
    )
    out = {"key": arm, "label": ARM_LABELS[arm], "paper": PAPER_SUCCESS[arm], **{key: summary[key] for key in keys}}
    out["lift_rate"] = rate(r.get("time_to_grasp_s") is not None for r in records)["success_rate"]
    out["runs"] = [_run_row(run) for run in sorted(runs, key=lambda r: r.seed)]
    curves = [run.curve for run in sorted(runs, key=lambda r: r.seed) if run.curve]
    for quantity, name in (("reward", "curve"), ("success", "success_curve")):
        if curves:
            out[name] = _thin(curves, quantity)
    return out


def _run_row(run: Run) -> dict[str, Any]:
    summary = summarise(run.records)
    row = {"seed": run.seed, **{k: summary[k] for k in ("episodes", "success_rate", "success_ci95", "target_visible")}}
    if run.curve:
        tail = [v for v in run.curve["reward"][-max(1, len(run.curve["reward"]) // 20) :] if v is not None]
        row |= {"env_steps": run.curve["env_steps"][-1], "final_reward": float(np.mean(tail))}
    return row


def _thin(curves: list[dict[str, Any]], quantity: str) -> dict[str, Any]:
    """Means over blocks of iterations: the same steps for every seed, at most `_POINTS` of them."""
    length = min(len(c[quantity]) for c in curves)
    size = -(-length // _POINTS)
    steps = curves[0]["env_steps"]
    blocks = [slice(k, min(k + size, length)) for k in range(0, length, size)]
    values = []
    for curve in curves:
        row = np.array([np.nan if v is None else v for v in curve[quantity][:length]], dtype=float)
        values.append([_mean(row[b]) for b in blocks])
    filled = [_hold(row) for row in values]
    return {"steps": [steps[b.stop - 1] for b in blocks], "values": filled}


def _mean(values: np.ndarray) -> float | None:
    kept = values[~np.isnan(values)]
    return float(kept.mean()) if len(kept) else None


def _hold(values: list[float | None]) -> list[float]:
    """Blocks in which no episode ended keep the value before them (0 at the start)."""
    last, out = 0.0, []
    for value in values:
        last = last if value is None else round(value, 6)
        out.append(last)
    return out


def _seen(arms: Sequence[dict[str, Any]]) -> list[str]:
    """How often each arm had its target in view, in words."""
    shares = {a["key"]: a["target_visible"] for a in arms if a["target_visible"] is not None}
    if not {"full", "no_active_vision"} <= set(shares):
        return []
    text = ", ".join(f"{ARM_LABELS[key].lower()} {percent(share)}" for key, share in shares.items())
    gap = shares["full"] - shares["no_active_vision"]
    if gap >= 0.05:
        return [f"Steps with the target in view: {text}. Looking at it keeps it in view more of the time."]
    return [f"Steps with the target in view: {text}. Looking at it makes little difference to what is seen here."]


def write_figure4(folder: Path, figure: dict[str, Any], config: dict[str, Any], provenance: dict[str, str]) -> None:
    """Write `figure4.json`, `figure4[-student].svg`, `figure4[-student].png` and `report.html` into `folder`.

    Args:
        figure: from `gather`.
        config: settings of the sweep.
        provenance: artifact of each run.
    """
    text = json.dumps({**figure, "config": config, "runs": provenance}, indent=1, sort_keys=True)
    (folder / "figure4.json").write_text(text + "\n", encoding="utf-8")
    shown = []
    for number, reading in enumerate(figure["readings"]):
        stem = "figure4" if number == 0 else f"figure4-{reading['key']}"
        picture = figure4(reading["arms"], reading["name"])
        svg = to_svg(picture, f"Figure 4, {reading['name']}", standalone=True)
        (folder / f"{stem}.svg").write_text(svg, encoding="utf-8")
        to_png(picture, folder / f"{stem}.png")
        panels = [to_svg(p, f"{reading['name']} {i}") for i, p in enumerate(_panels(reading)) if p is not None]
        shown.append({**reading, "svgs": panels})
    render(
        _TEMPLATE,
        folder / "report.html",
        readings=shown,
        config=json.dumps(config, indent=2, sort_keys=True),
        provenance=provenance,
    )


def _panels(reading: dict[str, Any]) -> list[Any]:
    panels = list(figure4_panels(reading["arms"]))
    if all(a.get("success_curve") for a in reading["arms"]):
        curves = {a["key"]: a["success_curve"] for a in reading["arms"]}
        panels.append(curves_figure(curves, "success of training episodes", "environment steps"))
    return panels

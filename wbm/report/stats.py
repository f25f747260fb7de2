"""Statistics of an evaluation: rates with intervals, failures by reason, breakdowns."""

from __future__ import annotations

import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

Z95 = 1.959963984540054  # 97.5 % quantile of the normal distribution
PAPER_SUCCESS = {"full": 1.00, "no_active_vision": 0.80, "joint_space": 0.20}
"""Lifting success that the paper's Figure 4(b) shows ("nearly 100 %", "roughly 80 %", "about 20 %")."""
ARM_LABELS = {"full": "Full system", "no_active_vision": "No active vision", "joint_space": "Joint space"}


def wilson(successes: int, trials: int, z: float = Z95) -> tuple[float, float]:
    """Wilson score interval of a proportion (Wilson 1927).

    centre = (p + z^2 / 2n) / (1 + z^2 / n), half width = z sqrt(p (1 - p) / n + z^2 / 4n^2) / (1 + z^2 / n).

    Returns:
        Lower and upper bound; (0, 1) without trials.

    Raises:
        ValueError: more successes than trials, or a negative count.
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"{successes} successes of {trials} trials is impossible")
    if trials == 0:
        return 0.0, 1.0
    p, shrink = successes / trials, 1.0 + z * z / trials
    centre = (p + z * z / (2 * trials)) / shrink
    half = z * math.sqrt(p * (1 - p) / trials + z * z / (4 * trials * trials)) / shrink
    # At the ends the bound is exactly 0 or 1; rounding would leave 1e-17.
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == trials else min(1.0, centre + half)
    return low, high


def rate(flags: Iterable[bool]) -> dict[str, Any]:
    """Count, rate and interval of a sequence of outcomes."""
    values = [bool(f) for f in flags]
    low, high = wilson(sum(values), len(values))
    return {
        "episodes": len(values),
        "successes": sum(values),
        "success_rate": sum(values) / len(values) if values else 0.0,
        "success_ci95": [low, high],
    }


def summarise(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Numbers of an evaluation, JSON-ready.

    Args:
        records: one dictionary an episode: `success`, `reason` (empty on success), `object`, `scene`; optional
            `collision`, `wrong_object` (bool), `target_visible` (share of steps), `time_to_grasp_s` (None on failure).

    Returns:
        `episodes`, `success_rate`, `success_ci95`, `collision_rate`, `wrong_object_rate`, `target_visible`,
        `time_to_grasp_s`, `failures` (by reason, most frequent first), `by_object`, `by_scene`.
    """
    overall = rate(r["success"] for r in records)
    times = [r["time_to_grasp_s"] for r in records if r["success"] and r.get("time_to_grasp_s") is not None]
    seen = [r["target_visible"] for r in records if r.get("target_visible") is not None]
    failures = Counter(str(r["reason"]) for r in records if not r["success"])
    return {
        "episodes": overall["episodes"],
        "success_rate": overall["success_rate"],
        "success_ci95": overall["success_ci95"],
        "collision_rate": _share(r.get("collision", False) for r in records),
        "wrong_object_rate": _share(r.get("wrong_object", False) for r in records),
        "target_visible": float(np.mean(seen)) if seen else None,
        "time_to_grasp_s": float(np.median(times)) if times else None,
        "failures": dict(sorted(failures.items(), key=lambda kv: (-kv[1], kv[0]))),
        "by_object": breakdown(records, "object"),
        "by_scene": breakdown(records, "scene"),
    }


def breakdown(records: Sequence[dict[str, Any]], key: str) -> dict[str, dict[str, Any]]:
    """`rate` for each value of `key`, in alphabetical order."""
    groups: dict[str, list[bool]] = defaultdict(list)
    for record in records:
        groups[str(record[key])].append(record["success"])
    return {name: rate(groups[name]) for name in sorted(groups)}


def _share(flags: Iterable[bool]) -> float:
    values = [bool(f) for f in flags]
    return sum(values) / len(values) if values else 0.0


def overlap(a: Sequence[float], b: Sequence[float]) -> bool:
    """Whether two intervals have a point in common."""
    return a[0] <= b[1] and b[0] <= a[1]


def percent(value: float | None) -> str:
    """A share as text: whole per cents, one digit near the ends, a dash for None."""
    if value is None:
        return "–"
    digits = 1 if 0 < value < 0.02 or 0.98 < value < 1 else 0
    return f"{100 * value:.{digits}f}\u00a0%"


def verdict(name: str, arms: Sequence[dict[str, Any]]) -> list[str]:
    """What the intervals say about the paper's order, in words: one sentence, or none where an arm is missing.

    Args:
        name: what is compared.
        arms: dictionaries with `key`, `label`, `success_rate`, `success_ci95`.
    """
    by_key = {a["key"]: a for a in arms}
    if not {"full", "no_active_vision", "joint_space"} <= set(by_key):
        return []
    ranked = sorted(arms, key=lambda a: -a["success_rate"])
    order = ", ".join(f"{a['label'].lower()} {percent(a['success_rate'])}" for a in ranked)
    rates = [by_key[key]["success_rate"] for key in PAPER_SUCCESS]
    expected = all(better > worse for better, worse in itertools.pairwise(rates))
    apart = not any(overlap(a["success_ci95"], b["success_ci95"]) for a, b in itertools.pairwise(ranked))
    lead = f"{name}: {order}." if name else f"{order.capitalize()}."
    if expected and apart:
        return [f"{lead} The order is the paper's and the intervals are apart."]
    if expected:
        return [f"{lead} The order is the paper's, but some intervals overlap, so it is not settled by these episodes."]
    return [f"{lead} This is not the order that the paper reports."]

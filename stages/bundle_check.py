"""Whether a bundle does what its student does: the same episodes, and the same numbers in every step of one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np


def compare_records(student: Path, bundle: Path) -> dict[str, Any]:
    """Outcomes of two evaluations of the same episodes.

    Args:
        student, bundle: folders of the two evaluations.

    Returns:
        `student` and `bundle` (`episodes`, `successes`, `success_rate`, Wilson's `success_ci95`), `intervals_overlap`,
        `only_student` and `only_bundle` (episodes that one of them alone solved), `refusals` by name.

    Raises:
        ValueError: the evaluations did not play the same episodes.
    """
    from wbm.report.stats import overlap, rate

    ours, theirs = (_by_episode(folder) for folder in (student, bundle))
    scenes = lambda records: {number: r["scene_row"] for number, r in records.items()}
    if scenes(ours) != scenes(theirs):
        raise ValueError(f"{student} and {bundle} did not play the same episodes; evaluate both with the same settings")
    won, won_too = ({n for n, r in records.items() if r["success"]} for records in (ours, theirs))
    rates = {"student": rate(n in won for n in ours), "bundle": rate(n in won_too for n in theirs)}
    return {
        **rates,
        "intervals_overlap": overlap(rates["student"]["success_ci95"], rates["bundle"]["success_ci95"]),
        "only_student": sorted(won - won_too),
        "only_bundle": sorted(won_too - won),
        "refusals": json.loads((bundle / "summary.json").read_text())["refusals"],
    }


def parity_per_step(student: Path, bundle: Path, evaluation: Path) -> dict[str, Any]:
    """Difference between torch and ONNX in each step of a recorded episode, replayed one step at a time.

    Args:
        student: folder of the student.
        bundle: file of the bundle.
        evaluation: folder of an evaluation that recorded an episode (`evaluation.record_episodes`).

    Returns:
        `parity_max`, `parity_tolerance` (the contract's) and `parity_steps` (largest difference in each step).

    Raises:
        ValueError: the evaluation recorded no episode.
    """
    from stages.deploy_golden import rollout_parity
    from wbm.deploy.bundle import Bundle
    from wbm.learning.student import load_student

    opened = Bundle.open(bundle)
    gaps = rollout_parity(load_student(student), opened.policy(), evaluation)
    if gaps is None:
        raise ValueError(f"{evaluation} recorded no episode to replay; evaluate with evaluation.record_episodes=1")
    tolerance = opened.contract.data["parity_tolerance"]
    return {"parity_max": float(np.max(gaps)), "parity_tolerance": tolerance, "parity_steps": gaps.tolist()}


def _by_episode(folder: Path) -> dict[int, dict[str, Any]]:
    return {record["episode"]: record for record in json.loads((folder / "records.json").read_text())}

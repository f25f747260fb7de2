"""Teachers and rollouts on a real Slurm of three nodes: arrays, preemption, a lost node, a controller that restarts."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from chaos_slurm import ONE, Storm, run
from slurm_cluster import SlurmCluster, unavailable
from slurm_support import Lab

pytestmark = [
    pytest.mark.slurm,
    pytest.mark.slow,
    pytest.mark.skipif(bool(unavailable()), reason=unavailable() or "a Slurm can be started"),
]


@pytest.fixture(scope="module")
def cluster() -> Iterator[SlurmCluster]:
    with SlurmCluster() as running:
        yield running


def until(condition, limit_s: float = 240.0) -> None:
    end = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.5)


def test_the_storm_changes_nothing(tmp_path: Path) -> None:
    """One blow of each kind over a teacher and an array of shards; `WBM_FULL=1` strikes 38 times."""
    blows = ["preempt", "kill_node", "kill_controller"]
    size = (20, 2)
    if os.environ.get("WBM_FULL"):
        blows, size = ["preempt"] * 30 + ["kill_node"] * 5 + ["kill_controller"] * 3, (400, 8)
    figures = run(tmp_path, blows, *size)
    assert not figures.problems
    assert figures.iterations_lost == 0 and figures.starts > 4


def test_a_suite_is_one_array_and_can_be_watched_and_cancelled(cluster: SlurmCluster, tmp_path: Path) -> None:
    settings = tuple(line for line in ONE if not line.startswith("teachers="))
    lab = Lab(tmp_path, cluster, settings)
    lab.wbm("prepare-assets")
    # The second teacher finds no scene; the first would take hours.
    submission = lab.submit("train-teacher", "teachers=[top_down,side]", "teacher.iterations=100000")
    until(lambda: lab.tasks(submission)["train-teacher.1"]["state"] == "failed")
    until(lambda: lab.iteration("top_down") > 0)
    tasks = lab.tasks(submission)
    first = tasks["train-teacher.0"]["job"].removesuffix("_0")
    assert [t["job"] for t in tasks.values()] == [f"{first}_0", f"{first}_1"]
    assert "no train scene" in tasks["train-teacher.1"]["message"]
    assert "going" not in lab.wbm("jobs", "logs", submission[:6], settings=False)
    assert "teacher top_down" in lab.wbm("jobs", "logs", "--task", "train-teacher.0", settings=False)
    lab.wbm("jobs", "cancel", submission, settings=False)
    until(lambda: Storm(cluster, lab, []).over())
    assert lab.tasks(submission)["train-teacher.0"]["state"] == "cancelled"
    assert lab.iteration("top_down") > 0  # the next run goes on from there


def test_what_slurm_refuses_is_said_in_a_line(cluster: SlurmCluster, tmp_path: Path) -> None:
    lab = Lab(tmp_path, cluster, ONE)
    error = lab.wbm("prepare-assets", "--launcher", "slurm", "launcher.partition=moon", code=1)
    assert "sbatch refused prepare-assets" in error and len(error.strip().splitlines()) <= 2
    assert not cluster.run("squeue", "-h", "-o", "%i").split()

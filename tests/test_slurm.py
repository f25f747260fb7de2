"""Teachers and rollouts on a real Slurm of three nodes: arrays, preemption, a lost node, a controller that restarts."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from chaos_slurm import ONE, run
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


def test_the_storm_changes_nothing(tmp_path: Path) -> None:
    """One blow of each kind over a teacher and an array of shards; `WBM_FULL=1` strikes 38 times."""
    blows = ["preempt", "kill_node", "kill_controller"]
    size = (20, 2)
    if os.environ.get("WBM_FULL"):
        blows, size = ["preempt"] * 30 + ["kill_node"] * 5 + ["kill_controller"] * 3, (400, 8)
    figures = run(tmp_path, blows, *size)
    assert not figures.problems
    assert figures.iterations_lost == 0 and figures.starts > 4


def test_what_slurm_refuses_is_said_in_a_line(cluster: SlurmCluster, tmp_path: Path) -> None:
    lab = Lab(tmp_path, cluster, ONE)
    error = lab.wbm("prepare-assets", "--launcher", "slurm", "launcher.partition=moon", code=1)
    assert "sbatch refused prepare-assets" in error and len(error.strip().splitlines()) <= 2
    assert not cluster.run("squeue", "-h", "-o", "%i").split()

"""Paths shared by all tests, and one small run of the whole pipeline that several of them look at."""

import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

ROOT = Path(__file__).parents[1]
SMALL = [
    "profile=smoke",
    "objects.count=16",
    "scenes.count=4",
    "scenes.test_count=2",
    "teachers=[top_down]",
    "teacher.iterations=2",
    "teacher.eval_every=2",
    "teacher.num_envs=16",
    "rollouts.episodes=4",
    "rollouts.num_envs=4",
    "distill.iterations=20",
    "distill.dagger_rounds=1",
    "distill.dagger_episodes=2",
    "distill.dagger_iterations=5",
    "evaluation.episodes=2",
    "evaluation.videos=1",
    "evaluation.filmstrips=0",
]


@pytest.fixture(scope="session")
def small_store(tmp_path_factory) -> Path:
    """A store in which `wbm run` with the settings `SMALL` has published; made once for all worker processes."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if os.environ.get("PYTEST_XDIST_WORKER") else base
    store = shared / "small_store"
    with open(shared / "small_store.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = subprocess.run(
            [sys.executable, "-m", "stages.cli", "run", *SMALL, f"artifacts.root={store}"],
            capture_output=True,
            text=True,
            timeout=400,
            cwd=ROOT,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
    assert done.returncode == 0, done.stderr[-2000:]
    return store

"""Two processes with N environments each train as one process with 2 N does.

Tolerance 2e-5 on weights after two iterations: the sums of gradients are added in another order, and Adam divides by
their root mean square.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from env_world import make
from rsl_rl.modules import EmpiricalNormalization
from torch import distributed as dist

from wbm.envs.config import EnvConfig
from wbm.learning.config import PpoConfig, TeacherConfig
from wbm.learning.teacher import train_teacher
from wbm.learning.team import Team

ENVS = 4
CFG = TeacherConfig(num_envs=ENVS, iterations=2, eval_every=1, eval_episodes=2, eval_envs=2, patience=0)
# Minibatches of 16 of 48 samples fall on the ranks unevenly; short episodes end and are numbered in between.
PPO = PpoConfig(steps=12, epochs=2, minibatches=3, hidden=(16, 8), schedule="adaptive")


def environment(num_envs: int):
    return make(num_envs, replace(EnvConfig(), episode_s=0.3, success_hold_s=0.2))


def train(folder: Path, team: Team, iterations: int = CFG.iterations) -> None:
    """Train this rank's share; the leader writes to `folder`, the others beside it."""
    own = folder / ("out" if team.leads else f"rank{team.rank}")
    cfg = replace(CFG, iterations=iterations)
    env = environment(team.share(ENVS))
    train_teacher(env, make(2, seed=1), cfg, PPO, own, folder / "scratch", 5, None, team)


def state(folder: Path) -> dict:
    return torch.load(folder / "scratch" / "checkpoint.pt", weights_only=True)


def start(folder: Path, what: str) -> list[subprocess.Popen]:
    """This file, run by two ranks."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    root = Path(__file__).parents[1]
    shared = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "OMP_NUM_THREADS": "1"}
    path = os.pathsep.join([str(root), str(root / "tests")])
    return [
        subprocess.Popen(
            [sys.executable, __file__, what, str(folder)],
            env={**os.environ, **shared, "PYTHONPATH": path, "RANK": str(rank)},
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(2)
    ]


def finish(processes: list[subprocess.Popen]) -> None:
    for process in processes:
        _, err = process.communicate(timeout=300)
        assert process.returncode == 0, err[-2000:]


def assert_same(a: dict, b: dict) -> None:
    for part in ("actor_state_dict", "critic_state_dict"):
        for name, value in a[part].items():
            torch.testing.assert_close(value, b[part][name], atol=2e-5, rtol=1e-4, msg=lambda m, n=name: f"{n}: {m}")
    for name in ("episode", "scene", "elapsed"):
        assert torch.equal(a["env"]["live"][name], b["env"]["live"][name]), name
    assert a["env"]["next_episode"] == b["env"]["next_episode"] > 2 * ENVS
    assert torch.equal(a["rng"], b["rng"])
    assert a["learning_rate"] == pytest.approx(b["learning_rate"])
    for name in ("reward", "success", "loss/value", "loss/surrogate", "evaluation", "outcome/timeout"):
        assert a["curve"][name] == pytest.approx(b["curve"][name], rel=1e-3, abs=1e-5, nan_ok=True), name


def test_two_ranks_train_as_one_with_all_environments(tmp_path: Path) -> None:
    processes = start(tmp_path / "two", "train")
    torch.set_num_threads(1)
    train(tmp_path / "one", Team())
    finish(processes)
    assert_same(state(tmp_path / "two"), state(tmp_path / "one"))
    assert (tmp_path / "two" / "out" / "policy.safetensors").exists()
    assert not (tmp_path / "two" / "rank1" / "policy.safetensors").exists()  # one writer

    # What one process saved, two ranks go on with
    train(tmp_path / "half-one", Team(), iterations=1)
    finish(start(tmp_path / "half-one", "train"))
    assert_same(state(tmp_path / "half-one"), state(tmp_path / "one"))


def test_the_normaliser_of_observations_sees_all_ranks(tmp_path: Path) -> None:
    tmp_path.joinpath("n").mkdir()
    finish(start(tmp_path / "n", "normalise"))
    whole = EmpiricalNormalization(3)
    whole.update(samples())
    for rank in range(2):
        found = torch.load(tmp_path / "n" / f"{rank}.pt", weights_only=True)
        torch.testing.assert_close(found["_mean"], whole.state_dict()["_mean"])
        torch.testing.assert_close(found["_var"], whole.state_dict()["_var"])


def test_environments_that_cannot_be_divided_are_refused() -> None:
    with pytest.raises(ValueError, match=r"teacher\.num_envs=5 cannot be divided among 2"):
        Team(0, 2).share(5)


def samples() -> torch.Tensor:
    return torch.randn(10, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 5.0, 0.1]) + 2


def normalise(folder: Path, team: Team) -> None:
    part = samples()[:3] if team.leads else samples()[3:]  # uneven on purpose
    normaliser = EmpiricalNormalization(3)
    normaliser.update(part)
    torch.save(normaliser.state_dict(), folder / f"{team.rank}.pt")


if __name__ == "__main__":
    torch.set_num_threads(1)
    team = Team.join("cpu")
    {"train": train, "normalise": normalise}[sys.argv[1]](Path(sys.argv[2]), team)
    dist.barrier()
    team.leave()

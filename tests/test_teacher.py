"""Training: exact resume after an interruption, the policy as files, and the watchdog."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.env_world import make
from wbm.learning.config import PpoConfig, TeacherConfig
from wbm.learning.teacher import make_ppo, teacher_spec, train_teacher
from wbm.learning.teacher_policy import SPEC, WEIGHTS, load_teacher, save_teacher

CFG = TeacherConfig(num_envs=4, iterations=3, eval_every=2, eval_episodes=3, eval_envs=2, patience=0)
PPO = PpoConfig(steps=6, epochs=2, minibatches=2, hidden=(16, 8))


class Killed(Exception):
    pass


def train(folder: Path, stop_after: int = 99) -> dict[str, float]:
    def report(progress) -> None:
        if progress.iteration == stop_after:
            raise Killed

    return train_teacher(make(4), make(2, seed=1), CFG, PPO, folder / "out", folder / "scratch", 5, report)


def digest(folder: Path) -> dict[str, str]:
    files = [folder / "scratch" / "latest" / WEIGHTS, *(folder / "out" / n for n in (WEIGHTS, SPEC, "curve.json"))]
    return {f.name + f.parent.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in files}


def test_interrupted_and_resumed_ends_with_the_same_bytes(tmp_path: Path) -> None:
    torch.set_num_threads(1)
    whole = train(tmp_path / "whole")
    for stop in (1, 2):
        with pytest.raises(Killed):
            train(tmp_path / f"cut{stop}", stop_after=stop)
        torch.rand(100)  # whatever else drew random numbers meanwhile
        resumed = train(tmp_path / f"cut{stop}")
        assert digest(tmp_path / f"cut{stop}") == digest(tmp_path / "whole")
        assert resumed["success"] == whole["success"]
    assert whole["iterations"] == 3 and whole["env_steps"] == 3 * 6 * 4
    curve = json.loads((tmp_path / "whole" / "out" / "curve.json").read_text())
    assert curve["env_steps"] == [24, 48, 72] and None not in curve["reward"]
    assert [v is not None for v in curve["eval/success"]] == [False, True, True]
    for term in ("reach", "contact", "grasp", "lift", "stable", "col", "act", "smooth"):
        assert len(curve[f"term/{term}"]) == 3


def test_saved_policy_is_the_actor_and_needs_no_rsl_rl(tmp_path: Path) -> None:
    env = make(2)
    env.reset()
    alg = make_ppo(env, PPO)
    save_teacher(tmp_path, teacher_spec(env, CFG, PPO), alg.actor.state_dict())
    policy = load_teacher(tmp_path)
    obs = torch.randn(7, len(policy.spec.obs_labels))
    from tensordict import TensorDict

    expected = alg.actor(TensorDict({"teacher": obs}, batch_size=[7])).detach()
    torch.testing.assert_close(policy(obs), expected, atol=1e-6, rtol=1e-5)
    assert policy.spec.obs_labels == env.observe.labels and policy.spec.action_labels == env.action.labels
    spec = json.loads((tmp_path / SPEC).read_text())
    (tmp_path / SPEC).write_text(json.dumps(spec | {"hidden": [9, 8]}))
    with pytest.raises(ValueError, match="weights do not match"):
        load_teacher(tmp_path)
    (tmp_path / SPEC).write_text(json.dumps(spec | {"version": 99}))
    with pytest.raises(ValueError, match="format 99"):
        load_teacher(tmp_path)
    with pytest.raises(FileNotFoundError, match="no teacher"):
        load_teacher(tmp_path / "nowhere")


def test_watchdog_stops_and_dumps(tmp_path: Path) -> None:
    env = make(4)
    step = env.step

    def poisoned(action):
        obs, reward, done, info = step(action)
        reward[2] = float("nan")
        return obs, reward, done, info

    env.step = poisoned
    with pytest.raises(FloatingPointError, match="reward is not finite in iteration 0"):
        train_teacher(env, make(2), CFG, PPO, tmp_path / "out", tmp_path / "scratch")
    dump = np.load(tmp_path / "scratch" / "nan_dump.npz")
    assert dump["rows"].tolist() == [2] and dump["qpos"].shape == env.sim.qpos.shape


def test_settings_are_checked() -> None:
    for bad in ({"grasp": "pinch"}, {"num_envs": 0}, {"patience": -1}):
        with pytest.raises(ValueError, match=r"^teacher\."):
            TeacherConfig(**bad)
    for bad in ({"schedule": "cosine"}, {"gamma": 0.0}, {"lr": -1.0}):
        with pytest.raises(ValueError, match=r"^ppo\."):
            PpoConfig(**bad)

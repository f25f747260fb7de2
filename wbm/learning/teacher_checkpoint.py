"""Checkpoints of a training: networks, optimiser, random state and environments, so that resuming is exact."""

from __future__ import annotations

import io
import os
from pathlib import Path

import torch
from rsl_rl.algorithms import PPO

from wbm.envs.grasp_env import GraspEnv
from wbm.learning.curriculum import Curriculum
from wbm.learning.team import Team


def save_checkpoint(
    path: Path,
    alg: PPO,
    env: GraspEnv,
    curriculum: Curriculum,
    curve: dict[str, list[float]],
    iteration: int,
    best: float,
    stale: float,
    team: Team,
) -> None:
    """Write everything that the next iteration depends on, atomically; every rank calls, the leader writes."""
    environments = team.save_env(env)
    if environments is None:
        return
    state = {
        **alg.save(),
        "learning_rate": alg.learning_rate,
        "rng": torch.get_rng_state(),
        "cuda_rng": torch.cuda.get_rng_state(env.device) if torch.device(env.device).type == "cuda" else None,
        "env": environments,
        "curriculum": curriculum.success,
        "curve": curve,
        "iteration": iteration,
        "best": best,
        "stale": stale,
    }
    buffer = io.BytesIO()
    torch.save(state, buffer)
    partial = path.with_name(path.name + ".partial")
    with open(partial, "wb") as stream:
        stream.write(buffer.getbuffer())
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(partial, path)


def load_checkpoint(
    path: Path, alg: PPO, env: GraspEnv, curriculum: Curriculum, curve: dict[str, list[float]], team: Team
) -> tuple[int, float, float]:
    """Restore a checkpoint where there is one; fills `curve`.

    Returns:
        The iteration to go on with, the best evaluation so far (-1 before the first), evaluations since then.
    """
    if not path.is_file():
        return 0, -1.0, 0
    state = torch.load(path, weights_only=True, map_location=env.device)
    alg.load(state, None, strict=True)
    alg.learning_rate = state["learning_rate"]
    team.load_env(env, state["env"])
    curriculum.success.copy_(state["curriculum"])
    torch.set_rng_state(state["rng"].cpu())
    if state["cuda_rng"] is not None:
        torch.cuda.set_rng_state(state["cuda_rng"].cpu(), env.device)
    curve.update(state["curve"])
    return state["iteration"], state["best"], state["stale"]

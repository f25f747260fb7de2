"""Deterministic evaluation of a grasp policy over a fixed list of episodes."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from wbm.envs.grasp_env import GraspEnv
from wbm.envs.outcome import REASONS, RUNNING


def evaluate_teacher(
    env: GraspEnv, policy: Callable[[Tensor], Tensor], episodes: int, first_episode: int = 0
) -> dict[str, float]:
    """Run episodes `first_episode ... + episodes - 1` to their ends.

    Every episode counts once, so that short (failed) ones are not over-represented.

    Returns:
        `success` and the share of every failure reason, `collision` (share of episodes with a forbidden contact),
        `reward` (mean sum of an episode), `grip_force` (mean finger force while holding, N).
    """
    obs = env.reset(first_episode)
    total = torch.zeros(env.num_envs, device=env.device)
    counts, finished, returns, grip, held_steps = torch.zeros(len(REASONS)), 0, 0.0, 0.0, 0.0
    while finished < episodes:
        with torch.no_grad():
            obs, reward, done, info = env.step(policy(obs))
        total += reward
        holding = env.state.holding
        grip += float((env.state.finger_force.amax(1) * holding).sum())
        held_steps += float(holding.sum())
        counted = done & (info["episode"] < first_episode + episodes)
        if bool(counted.any()):
            counts += torch.bincount(info["outcome"][counted].long(), minlength=len(REASONS)).cpu()
            returns += float(total[counted].sum())
            finished = int(counts[RUNNING + 1 :].sum())
        total[done] = 0.0
    result = {name: float(counts[i]) / episodes for i, name in enumerate(REASONS) if i != RUNNING}
    return {**result, "reward": returns / episodes, "grip_force": grip / max(held_steps, 1.0)}

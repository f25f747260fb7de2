"""A run of the ablation sweep: PPO on the whole-body episode under partial observability, then its evaluation."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from wbm.envs.episodes import SETTLING_S, EpisodeRunner, Record, TeacherDriver
from wbm.envs.grasp_env import GraspEnv
from wbm.envs.seen_env import SeenEnv
from wbm.envs.world import WorldConfig, make_env, scene_rows, with_start
from wbm.learning.config import PpoConfig, TeacherConfig
from wbm.learning.figure4_config import Figure4Config
from wbm.learning.teacher import Progress, train_teacher
from wbm.learning.teacher_policy import SPEC, WEIGHTS, load_teacher
from wbm.robot.schema import PolicySchema
from wbm.scenes.assets import Assets
from wbm.scenes.config import KINDS
from wbm.sim.config import evaluation_physics

EVALUATION_SEED = 20_000
"""Added to a run's seed, so that its evaluation never repeats episodes of its training."""


def run_world(world: WorldConfig, cfg: Figure4Config) -> WorldConfig:
    """The arm's world: whole-body episodes whose policy knows the target's pose only while the camera sees it."""
    env = replace(world.env, observe="seen", reward=replace(world.env.reward, reach_far=cfg.reach_far))
    return with_start(replace(world, env=env), "whole_body")


def train_run(
    assets: Assets,
    world: WorldConfig,
    cfg: Figure4Config,
    ppo: PpoConfig,
    directory: Path,
    scratch: Path,
    seed: int,
    report: Callable[[Progress], None] | None = None,
    device: str = "cpu",
) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """Train one arm with one seed to the end of its budget and evaluate the last policy.

    Interrupted, it continues from the last iteration when called again with the same arguments.

    Args:
        assets: objects and scenes.
        world: the arm's world, from `run_world`.
        directory: receives `policy.*`, `curve.json`, `curve.png`, `records.json`.
        scratch: holds the checkpoint.
        seed: of the network, the exploration and the episodes.
        report: called after each iteration.

    Returns:
        One record an episode of the final evaluation on held-out objects, and what `train_teacher` returns.
    """
    bank = assets.scenes
    rows = scene_rows(bank, "train", cfg.supports, cfg.grasps)
    env = make_env(assets, world, rows, cfg.num_envs, seed, device)
    model, count = env.binding.scene_model, min(cfg.eval_envs, cfg.eval_episodes)
    watch = make_env(assets, world, rows, count, seed + 1, device, model)
    trained = train_teacher(env, watch, run_settings(cfg, ppo), ppo, directory, scratch, seed, report)
    # The policy at the end of the budget is judged, whichever evaluation along the way was the best.
    for name in (WEIGHTS, SPEC):
        shutil.copyfile(scratch / "latest" / name, directory / name)

    judge = replace(world, sim=evaluation_physics(world.sim))
    held_out = scene_rows(bank, "test", cfg.supports, cfg.grasps)
    count = min(cfg.eval_envs, cfg.episodes)
    test = make_env(assets, judge, held_out, count, seed + EVALUATION_SEED, device, model)
    assert isinstance(test, SeenEnv)
    records = evaluate_run(test, load_teacher(directory, device), assets, cfg.episodes)
    text = json.dumps(records, indent=1, sort_keys=True)
    (directory / "records.json").write_text(text + "\n", encoding="utf-8")
    return records, trained


def run_settings(cfg: Figure4Config, ppo: PpoConfig) -> TeacherConfig:
    """The budget in the trainer's terms: no early stop, and a checkpoint after every iteration."""
    iterations = -(-cfg.env_steps // (cfg.num_envs * ppo.steps))
    return TeacherConfig(
        name=f"figure4_{cfg.arm}_{cfg.seed}",
        grasp=cfg.grasps[0],
        supports=cfg.supports,
        num_envs=cfg.num_envs,
        iterations=iterations,
        eval_every=max(1, -(-iterations // cfg.evaluations)),
        eval_episodes=cfg.eval_episodes,
        eval_envs=cfg.eval_envs,
        patience=0,
    )


class _Watch(TeacherDriver):
    """Acts, and counts how often the target was in view, by environment."""

    def __init__(self, policy: Callable[[Tensor], Tensor], env: SeenEnv) -> None:
        super().__init__(policy)
        self.looked = torch.zeros(env.num_envs, device=env.device)
        self.seen = torch.zeros_like(self.looked)

    def step(self, env: GraspEnv, sight: Any) -> tuple[Tensor, Tensor, Tensor, dict]:
        """Count, then act."""
        assert isinstance(env, SeenEnv)
        late = (env.elapsed * env.period >= SETTLING_S).float()
        self.looked += late
        self.seen += late * env.belief.seen
        return super().step(env, sight)

    def share(self, e: int) -> float | None:
        """Share of steps in view of the episode that ended in environment `e`, counted from anew."""
        looked, seen = float(self.looked[e]), float(self.seen[e])
        self.looked[e] = self.seen[e] = 0.0
        return seen / looked if looked > 0 else None


def evaluate_run(
    env: SeenEnv, policy: Callable[[Tensor], Tensor], assets: Assets, episodes: int
) -> list[dict[str, Any]]:
    """Deterministic episodes 0 to `episodes - 1`, one record each as `summarise` takes them."""
    bank = assets.scenes.select(env.binding.scenes)
    runner = EpisodeRunner(env, PolicySchema(), bank.kind, bank.object[:, 0])
    driver, visible = _Watch(policy, env), {}

    def on_end(e: int, record: Record) -> None:
        visible[record.episode] = driver.share(e)

    records = runner.run(driver, 0, episodes, on_end=on_end)
    return [
        {
            **record.to_dict(),
            "seed": record.episode,
            "object": str(assets.objects.family[record.object_index]),
            "object_name": str(assets.objects.name[record.object_index]),
            "scene": KINDS[record.kind],
            "target_visible": visible[record.episode],
            "reason": "" if record.success else record.reason,
        }
        for record in records
    ]

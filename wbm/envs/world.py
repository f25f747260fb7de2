"""Makes environments from assets: one compiled model, the scenes of a split, and pre-grasps for each of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from wbm.control.config import WbcConfig
from wbm.envs.binding import SceneBinding
from wbm.envs.config import EnvConfig
from wbm.envs.grasp_env import GraspEnv
from wbm.envs.pregrasp import StartBank, solve_starts
from wbm.envs.seen_env import SeenEnv
from wbm.envs.whole_body import WholeBodyEnv
from wbm.robot.config import MjcfOptions
from wbm.robot.joints import NUM_JOINTS
from wbm.robot.model import load_robot
from wbm.scenes.assets import Assets
from wbm.scenes.bank import SceneBank
from wbm.scenes.config import KINDS
from wbm.scenes.model import SceneModel, SceneModelConfig
from wbm.sim.config import SimConfig

GRASPS = ("top_down", "side")


@dataclass(frozen=True)
class WorldConfig:
    """The sections of the configuration that make an environment."""

    robot: MjcfOptions
    sim: SimConfig
    wbc: WbcConfig
    env: EnvConfig


def scene_rows(bank: SceneBank, split: str, supports: tuple[str, ...], grasps: tuple[str, ...]) -> np.ndarray:
    """Rows of the bank in a split, on some kinds of support, whose hint is among `grasps`.

    Raises:
        ValueError: none is left.
    """
    rows = bank.where(None if split == "all" else split, tuple(KINDS.index(s) for s in supports))
    rows = rows[np.isin(bank.approach[rows], [GRASPS.index(g) for g in grasps])]
    if len(rows) == 0:
        raise ValueError(
            f"the assets hold no {split} scene on {', '.join(supports)} for {' or '.join(grasps)}; prepare more scenes"
        )
    return rows


def make_env(
    assets: Assets,
    cfg: WorldConfig,
    rows: np.ndarray,
    num_envs: int,
    seed: int,
    device: str = "cpu",
    scene_model: SceneModel | None = None,
) -> GraspEnv:
    """An environment over the scenes `rows`; local or whole-body as `cfg.env.start` says.

    Scenes without a reachable pre-grasp are left out, whatever teacher their hint asks for.

    Raises:
        ValueError: no scene has a reachable pre-grasp.
    """
    robot, bank = load_robot(), assets.scenes
    model = scene_model or SceneModel(assets.objects, SceneModelConfig(num_distractors=bank.num_distractors), cfg.robot)
    starts = find_starts(SceneBinding(model, bank, rows, device), cfg, seed, device)
    usable = starts.usable.cpu().numpy()
    binding = SceneBinding(model, bank, rows[usable], device)
    kept = StartBank(starts.q[starts.usable], starts.count[starts.usable])
    env = cfg.env
    kind = WholeBodyEnv if env.start == "whole_body" else GraspEnv
    if env.observe == "seen":
        kind, env = SeenEnv, env if env.start == "whole_body" else replace(env, pregrasp_share=1.0)
    return kind(binding, kept, robot, env, cfg.sim, cfg.wbc, num_envs, seed, device)


def find_starts(binding: SceneBinding, cfg: WorldConfig, seed: int, device: str) -> StartBank:
    """Pre-grasps of every scene, each by the approach that its record hints at."""
    robot, approach = load_robot(), binding.bank.approach[binding.scenes]
    q = torch.zeros(len(approach), cfg.env.starts_per_scene, NUM_JOINTS, device=device)
    count = torch.zeros(len(approach), dtype=torch.int64, device=device)
    for code, grasp in enumerate(GRASPS):
        part = np.flatnonzero(approach == code)
        if len(part) == 0:
            continue
        some = SceneBinding(binding.scene_model, binding.bank, binding.scenes[part], device)
        try:
            found = solve_starts(some.table, robot, cfg.wbc, cfg.env, grasp, seed, device)
        except ValueError:
            continue
        q[part], count[part] = found.q, found.count
    if int(count.sum()) == 0:
        raise ValueError("no scene has a reachable pre-grasp; check the supports' heights and env.standoff")
    return StartBank(q, count)


def with_start(cfg: WorldConfig, start: str, pregrasp_share: float = 0.0) -> WorldConfig:
    """The same world with another way of starting episodes."""
    return replace(cfg, env=replace(cfg.env, start=start, pregrasp_share=pregrasp_share))

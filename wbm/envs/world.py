"""Makes environments from assets: one compiled model, the scenes of a split, and pre-grasps for each of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from wbm.control.config import WbcConfig
from wbm.control.planner import AMPLE, GRASPS, PREFERENCE, choose_grasp, fits
from wbm.envs.binding import SceneBinding
from wbm.envs.config import EnvConfig
from wbm.envs.grasp_env import GraspEnv
from wbm.envs.pregrasp import StartBank, scatter_starts, solve_starts, target_of
from wbm.envs.seen_env import SeenEnv
from wbm.envs.whole_body import WholeBodyEnv
from wbm.robot.config import MjcfOptions
from wbm.robot.joints import NUM_JOINTS
from wbm.scenes.assets import Assets
from wbm.scenes.bank import SceneBank
from wbm.scenes.config import KINDS
from wbm.scenes.model import SceneModel, SceneModelConfig
from wbm.sim.config import SimConfig


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
    grasps: tuple[str, ...] = (),
) -> GraspEnv:
    """An environment over the scenes `rows`; local or whole-body as `cfg.env.start` says.

    Scenes without a reachable pre-grasp are left out. With `grasps`, the kinds that there is a policy for, a scene's
    hint is only a preference: `env.binding.bank.approach` holds what the planner chose instead.

    Raises:
        ValueError: no scene has a reachable pre-grasp.
    """
    bank = assets.scenes
    # MuJoCo Warp has one geometry type and one set of collision bits for all environments.
    template = SceneModelConfig(bank.num_distractors, "mesh" if cfg.sim.engine == "mujoco_warp" else "native")
    model = scene_model or SceneModel(assets.objects, template, cfg.robot, assets.robot)
    tried = SceneBinding(model, bank, rows, device)
    starts, approach = find_starts(tried, cfg, seed, device, grasps)
    usable = starts.usable.cpu().numpy()
    bank = replace(bank, approach=bank.approach.copy())
    bank.approach[rows] = approach
    binding = SceneBinding(model, bank, rows[usable], device)
    kept = StartBank(starts.q[starts.usable], starts.count[starts.usable])
    env = cfg.env
    if env.scatter_share > 0:
        kept.scattered = scatter_starts(binding.table, model.robot, cfg.wbc, env.scatter, kept.q[:, 0], seed, device)
    kind = WholeBodyEnv if env.start == "whole_body" else GraspEnv
    if env.observe == "seen":
        kind, env = SeenEnv, env if env.start == "whole_body" else replace(env, pregrasp_share=1.0)
    return kind(binding, kept, model.robot, env, cfg.sim, cfg.wbc, num_envs, seed, device)


def find_starts(
    binding: SceneBinding, cfg: WorldConfig, seed: int, device: str, grasps: tuple[str, ...] = ()
) -> tuple[StartBank, np.ndarray]:
    """Pre-grasps of every scene, and the kind of grasp [S] that each is for.

    The kind is the one that the scene's record hints at. Where its pre-grasps are out of reach or short of room, the
    planner also looks at the others of `grasps`.

    Raises:
        ValueError: no scene has a reachable pre-grasp.
    """
    hint = np.asarray(binding.bank.approach[binding.scenes])
    keep, count = cfg.env.starts_per_scene, len(hint)
    q = torch.zeros(len(GRASPS), count, keep, NUM_JOINTS, device=device)
    found = torch.zeros(len(GRASPS), count, dtype=torch.int64, device=device)
    room = torch.full((len(GRASPS), count), -torch.inf, device=device)
    target = target_of(binding.table, torch.arange(count, device=device))
    for other in (False, True):
        wanting = room.amax(0).cpu().numpy() < (1.0 - PREFERENCE) * AMPLE  # else the hint wins in any case
        for code, grasp in enumerate(GRASPS):
            part = np.flatnonzero(hint == code)
            if other:
                room_for = fits(target, grasp, cfg.env.standoff).cpu().numpy()
                part = np.flatnonzero((hint != code) & wanting & room_for & (grasp in grasps))
            if len(part) == 0:
                continue
            some = SceneBinding(binding.scene_model, binding.bank, binding.scenes[part], device)
            try:
                bank = solve_starts(some.table, binding.scene_model.robot, cfg.wbc, cfg.env, grasp, seed, device)
            except ValueError:
                continue
            q[code, part], found[code, part], room[code, part] = bank.q, bank.count, bank.clearance
    if int(found.sum()) == 0:
        raise ValueError("no scene has a reachable pre-grasp; check the supports' heights and env.standoff")
    chosen = choose_grasp(room, torch.as_tensor(hint, device=device)).clamp_min(0)
    scenes = torch.arange(count, device=device)
    return StartBank(q[chosen, scenes], found[chosen, scenes], room[chosen, scenes]), chosen.cpu().numpy()


def with_start(cfg: WorldConfig, start: str, pregrasp_share: float = 0.0, scatter_share: float = 0.0) -> WorldConfig:
    """The same world with another way of starting episodes."""
    env = replace(cfg.env, start=start, pregrasp_share=pregrasp_share, scatter_share=scatter_share)
    return replace(cfg, env=env)

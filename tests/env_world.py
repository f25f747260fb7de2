"""A small world that the tests of the environment share: a dozen objects, a few settled table scenes."""

from __future__ import annotations

import functools
from dataclasses import replace

from wbm.control.config import WbcConfig
from wbm.envs.binding import SceneBinding
from wbm.envs.config import EnvConfig
from wbm.envs.grasp_env import GraspEnv
from wbm.envs.pregrasp import StartBank, solve_starts
from wbm.robot.model import load_robot
from wbm.scenes.bank import SceneBank
from wbm.scenes.config import ObjectsConfig, ScenesConfig
from wbm.scenes.generate import generate_scenes
from wbm.scenes.model import SceneModel, SceneModelConfig
from wbm.scenes.objects import stack_objects
from wbm.scenes.procedural import draw_objects
from wbm.sim.config import SimConfig

DISTRACTORS = 1


@functools.cache
def scenes() -> tuple[SceneModel, SceneBank]:
    """A compiled model and its settled scenes, all of them on tables and of the training split."""
    cfg = ObjectsConfig(count=8, families=("box", "can"), held_out=(), test_share=0.0, val_share=0.0)
    objects = stack_objects(draw_objects(cfg, 0))
    model = SceneModel(objects, SceneModelConfig(num_distractors=DISTRACTORS))
    layout = ScenesConfig(
        count=4, test_count=0, kinds=("table",), num_distractors=DISTRACTORS, distractors=(0, DISTRACTORS)
    )
    return model, generate_scenes(model, layout, 0)


@functools.cache
def world() -> tuple[SceneBinding, StartBank]:
    """The scenes with a reachable top-down pre-grasp, and those pre-grasps."""
    model, bank = scenes()
    rows = bank.where("train")
    binding = SceneBinding(model, bank, rows)
    cfg = replace(EnvConfig(), starts_per_scene=2)
    starts = solve_starts(binding.table, load_robot(), WbcConfig(), cfg, "top_down", batch=16)
    usable = starts.usable
    return SceneBinding(model, bank, rows[usable.numpy()]), StartBank(starts.q[usable], starts.count[usable])


def make(num_envs: int = 4, cfg: EnvConfig | None = None, seed: int = 0, sim: SimConfig | None = None, kind=GraspEnv):
    """An environment on the small world."""
    binding, starts = world()
    return kind(binding, starts, load_robot(), cfg or EnvConfig(), sim or SimConfig(), WbcConfig(), num_envs, seed)

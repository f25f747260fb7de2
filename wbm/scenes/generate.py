"""Draws scenes in rounds and keeps those that stay where they are when simulated."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import fields, replace

import mjbatch
import mujoco
import numpy as np

from wbm.robot.rotations import quat_angle
from wbm.scenes.bank import SceneBank, stack_scenes
from wbm.scenes.cache import array_digest, code_digest, load_arrays, store_arrays
from wbm.scenes.config import ScenesConfig
from wbm.scenes.model import SceneModel
from wbm.scenes.objects import SPLITS, ObjectSet
from wbm.scenes.placement import draw_scene, fits

Track = Callable[[Iterable], Iterable]
STEP = 0.004
MAX_ROUNDS = 8
MAX_TILT = 0.15  # rad that settling may turn an object
MAX_SHIFT = 0.015  # m that settling may move it


def wanted(cfg: ScenesConfig, objects: ObjectSet) -> dict[str, int]:
    """Scenes of every kind by split; val and test get none where they have no objects.

    Raises:
        ValueError: there are no objects for training.
    """
    if not (objects.split == "train").any():
        raise ValueError(f"scenes: none of the {len(objects)} objects is for training; add objects or change the seed")
    count = {"train": cfg.count, "val": max(1, cfg.count // 5), "test": cfg.test_count}
    return {s: count[s] for s in SPLITS if count[s] > 0 and (objects.split == s).any()}


def generate_scenes(model: SceneModel, cfg: ScenesConfig, seed: int, track: Track = iter) -> SceneBank:
    """A bank with the wanted number of settled scenes of every kind and split, of the model's objects.

    Args:
        track: wraps the list of (split, kind, count) with a progress bar.

    Raises:
        ValueError: a kind and split could not be filled, named with the counts.
    """
    objects = model.objects
    jobs = [(split, kind, n) for split, n in wanted(cfg, objects).items() for kind in cfg.kinds]
    jobs = [job for job in jobs if job[0] != "val" or (fits(job[1], objects) & (objects.split == "val")).any()]
    options = replace(model.robot_options, facts="")  # what stands in that file counts, not where it lies
    arrays = (getattr(objects, f.name) for f in fields(ObjectSet))
    content = array_digest(code_digest(), mujoco.__version__, model.robot.facts, options, *arrays)
    banks = []
    for split, kind, count in track(jobs):
        key = array_digest(content, replace(cfg, count=1, test_count=0, encoder=""), seed, split, kind, count)
        kept = load_arrays("scenes", key)
        if kept is None:
            bank = _fill(model, kind, split, count, cfg, seed)
            store_arrays("scenes", key, **{f.name: getattr(bank, f.name) for f in fields(SceneBank)})
        else:
            bank = SceneBank(**kept)
        banks.append(bank)
    return concatenate(banks)


def _fill(model: SceneModel, kind: str, split: str, count: int, cfg: ScenesConfig, seed: int) -> SceneBank:
    """`count` settled scenes; round r draws from the generator (seed, kind, split, r) alone."""
    pool = np.flatnonzero(model.objects.split == split)
    kept: list[SceneBank] = []
    have = 0
    for attempt in range(MAX_ROUNDS):
        rng = np.random.default_rng([seed, cfg.kinds.index(kind), SPLITS.index(split), attempt, 0x5CE])
        rows = []
        for _ in range(4 * (count - have) + 8):
            row = draw_scene(kind, pool, split, model.objects, model.robot, cfg, rng)
            rows += [row] if row is not None else []
            if len(rows) >= int(1.15 * (count - have)) + 2:
                break
        if rows:
            settled = settle(model, stack_scenes(rows), cfg)
            kept.append(settled)
            have += len(settled)
        if have >= count:
            return concatenate(kept).select(np.arange(count))
    raise ValueError(
        f"scenes: only {have} of {count} {kind} scenes of the {split} split settled; loosen scenes.* or add objects"
    )


def settle(model: SceneModel, bank: SceneBank, cfg: ScenesConfig) -> SceneBank:
    """Let every scene come to rest, keep those that then stay at rest, with their settled poses and a quiet start."""
    used = bank.object >= 0
    before = bank
    bank = _with_poses(bank, *simulate(model, bank, cfg.settle_time)[:2])
    shift = np.linalg.norm(bank.object_pos - before.object_pos, axis=2)
    tilt = quat_angle(bank.object_quat, before.object_quat)
    fine = (((shift < MAX_SHIFT) & (tilt < MAX_TILT)) | ~used).all(axis=1)
    bank = bank.select(np.flatnonzero(fine))
    if len(bank) == 0:
        return bank
    pos, _, contact = simulate(model, bank, cfg.settle_time)
    moved = np.linalg.norm(pos - bank.object_pos, axis=2)
    still = ((moved <= cfg.settle_tolerance / 2) | (bank.object < 0)).all(axis=1) & ~contact
    return bank.select(np.flatnonzero(still))


def simulate(model: SceneModel, bank: SceneBank, seconds: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses [K,1+D,3], [K,1+D,4] of the objects after `seconds` with the robot held, and [K] whether it touched."""
    physics = model.model
    options = (physics.opt.timestep, physics.opt.integrator, physics.opt.cone, physics.opt.ls_iterations)
    physics.opt.timestep, physics.opt.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    physics.opt.cone, physics.opt.ls_iterations = mujoco.mjtCone.mjCONE_ELLIPTIC, 50
    batch = mjbatch.Batch(physics, len(bank), 0)
    physics.opt.timestep, physics.opt.integrator, physics.opt.cone, physics.opt.ls_iterations = options
    qpos, ctrl = batch.bind("qpos"), batch.bind("ctrl")
    expanded = {name: batch.expand(name) for name in model.fields}
    model.load_scene(expanded.__getitem__, qpos, np.arange(len(bank)), bank, np.arange(len(bank)))
    ctrl[:] = bank.q_start
    sensors = [batch.sensor(name)[:, 0] for name in model.sensors if name.startswith("robot_")]
    touched = np.zeros(len(bank), dtype=bool)
    steps = round(seconds / STEP)
    for _ in range(10):
        batch.step(nstep=max(1, steps // 10))
        touched |= np.any([s > 0 for s in sensors], axis=0)
    width = 1 + bank.num_distractors
    poses = qpos[:, model.object_qpos].reshape(len(bank), width, 7)
    return poses[..., :3].copy(), poses[..., 3:].copy(), touched


def concatenate(banks: list[SceneBank]) -> SceneBank:
    """Banks one after the other."""
    return SceneBank(**{f.name: np.concatenate([getattr(b, f.name) for b in banks]) for f in fields(SceneBank)})


def _with_poses(bank: SceneBank, pos: np.ndarray, quat: np.ndarray) -> SceneBank:
    absent = (bank.object < 0)[..., None]
    return replace(
        bank,
        object_pos=np.where(absent, bank.object_pos, pos),
        object_quat=np.where(absent, bank.object_quat, quat),
    )

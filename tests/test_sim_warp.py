"""MuJoCo Warp on its CPU device against MuJoCo C: the same scenes, the same integrator, fields by environment.

Tolerances: MuJoCo Warp computes in float32 and MuJoCo C in float64. Over ten steps of settled contact, positions agree
to 2e-4 m or rad and net contact forces to 3 % of the object's weight or 0.3 N, whichever is larger.
"""

from __future__ import annotations

import copy
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from scenes_small import small_bank, small_model
from test_sim import model as toy_model

from wbm.sim.config import EVALUATE
from wbm.sim.simulation import Simulation, apply_options, make_simulation

pytest.importorskip("mujoco_warp", reason="MuJoCo Warp is not installed (pip install 'wbm[gpu]')")

CFG = replace(EVALUATE, engine="mujoco_warp", iterations=50, tolerance=1e-8)
SCENES = (0, 9)
FRICTION, MASS = (0.5, 1.1), (0.8, 1.3)


def loaded() -> tuple[Simulation, list[tuple[mujoco.MjModel, mujoco.MjData]]]:
    """Two scenes of the small bank in one simulation, and each by itself in MuJoCo C."""
    scenes, bank = small_model("mesh"), small_bank()
    sim = make_simulation(copy.copy(scenes.model), len(SCENES), CFG)
    rows = np.array(SCENES)
    scenes.load_scene(sim.field, sim.qpos, np.arange(2), bank, rows, np.array(MASS), np.array(FRICTION))
    sim.ctrl[:] = torch.as_tensor(bank.q_start[rows], dtype=torch.float32)
    sim.forward(torch.arange(2))
    alone = []
    for scene, mass, friction in zip(SCENES, MASS, FRICTION, strict=True):
        model = copy.copy(scenes.model)
        apply_options(model, CFG)
        data = mujoco.MjData(model)
        qpos = data.qpos[None].copy()
        fields = {name: getattr(model, name)[None] for name in scenes.fields}
        one = (np.array([0]), bank, np.array([scene]), np.array([mass]), np.array([friction]))
        scenes.load_scene(fields.__getitem__, qpos, *one)
        data.qpos[:], data.ctrl[:] = qpos[0], bank.q_start[scene]
        mujoco.mj_forward(model, data)
        alone.append((model, data))
    return sim, alone


@pytest.mark.slow
@pytest.mark.timeout(1200)  # the first time, Warp compiles the collision kernels
def test_scenes_step_and_touch_as_in_mujoco_c() -> None:
    sim, alone = loaded()
    touching = 0
    for steps in (0, 10):
        sim.step(steps)
        sim.forward(torch.arange(2))
        for i, (model, data) in enumerate(alone):
            mujoco.mj_step(model, data, steps) if steps else None
            mujoco.mj_forward(model, data)
            np.testing.assert_allclose(sim.qpos[i].numpy(), data.qpos, atol=2e-4)
            weight = 9.81 * float(model.body("target").mass[0])
            for name in small_model("mesh").sensors:
                columns = sim.sensor_slice(name)
                ours, theirs = sim.sensordata[i, columns].numpy(), data.sensordata[columns]
                np.testing.assert_allclose(ours[1:], theirs[1:], atol=max(0.3, 0.03 * weight), err_msg=name)
                assert (ours[0] > 0) == (theirs[0] > 0), name
                touching += theirs[0] > 0
    assert touching >= 4  # the targets lie on something, before and after


def test_fields_are_by_environment_and_nothing_is_copied() -> None:
    sim = make_simulation(toy_model(), 3, CFG)
    cube, dof = sim.model.body("cube").id, int(sim.model.joint("free").dofadr[0])
    mass = sim.field("body_mass")
    assert mass.data_ptr() == sim.field("body_mass").data_ptr()
    before = sim.field("body_invweight0")[:, cube].clone()
    mass[1, cube] *= 4
    sim.field("body_inertia")[1, cube] *= 4
    sim.field("dof_invweight0")
    qpos = sim.qpos.clone()
    sim.set_const(torch.tensor([1]))
    after = sim.field("body_invweight0")[:, cube]
    torch.testing.assert_close(after[1, 0], before[1, 0] / 4)
    torch.testing.assert_close(after[[0, 2]], before[[0, 2]])
    torch.testing.assert_close(sim.field("dof_invweight0")[1, dof], before[1, 0] / 4)
    assert torch.equal(sim.qpos, qpos)
    with pytest.raises(ValueError, match="one value of geom_type for all"):
        sim.field("geom_type")
    with pytest.raises(ValueError, match="no array field 'geom_colour'"):
        sim.field("geom_colour")


def test_reset_and_forward_leave_the_others_alone_and_a_state_continues() -> None:
    sim = make_simulation(toy_model(), 3, CFG)
    sim.ctrl[:, 0] = torch.tensor([0.1, -0.2, 0.3])
    sim.step(5)
    moved, felt = sim.qpos.clone(), sim.sensordata.clone()
    sim.reset(torch.tensor([1]))
    sim.forward(torch.tensor([1]))
    torch.testing.assert_close(sim.qpos[1].double(), torch.from_numpy(sim.model.qpos0), atol=1e-6, rtol=0)
    assert torch.equal(sim.qpos[[0, 2]], moved[[0, 2]])
    assert torch.equal(sim.sensordata[[0, 2]], felt[[0, 2]])
    saved = sim.save_state()
    sim.step(7)
    first = sim.save_state()
    other = make_simulation(toy_model(), 3, CFG)
    other.load_state(saved)
    other.step(7)
    for name, value in other.save_state().items():
        torch.testing.assert_close(value, first[name], atol=1e-6, rtol=1e-6, msg=lambda m, n=name: f"{n}: {m}")

"""The batched engine against MuJoCo C, and exact saving and restoring of state.

Tolerance 1e-6: the tensors are float32 views of float64 state, and positions here stay below 1 m.
"""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch

from wbm.sim.config import EVALUATE, TRAIN, SimConfig, evaluation_physics
from wbm.sim.simulation import apply_options, make_simulation

XML = """
<mujoco><option gravity="0 0 -9.81"/><worldbody><geom name="floor" type="plane" size="0 0 1"/>
<body name="slider" pos="0 0 0.5"><joint name="s" type="slide" axis="1 0 0" damping="0.5"/>
 <geom name="rod" type="capsule" size="0.02 0.1" mass="0.3"/></body>
<body name="cube" pos="0 0 0.15"><freejoint name="free"/>
 <geom name="cube" type="box" size="0.05 0.04 0.03" mass="0.2"/></body>
</worldbody><actuator><position name="a" joint="s" kp="20" kv="2"/></actuator>
<sensor><contact name="touch" body1="cube" body2="world" data="found force" reduce="netforce" num="1"/></sensor>
</mujoco>
"""


def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


@pytest.mark.parametrize("cfg", [TRAIN, EVALUATE], ids=["train", "evaluate"])
def test_step_equals_mujoco_c(cfg: SimConfig) -> None:
    sim = make_simulation(model(), 3, cfg)
    oracle_model = model()
    apply_options(oracle_model, cfg)
    for i, command in enumerate((-0.2, 0.0, 0.3)):
        sim.ctrl[i] = command
    sim.step(40)
    for i, command in enumerate((-0.2, 0.0, 0.3)):
        data = mujoco.MjData(oracle_model)
        data.ctrl[:] = np.float32(command)
        mujoco.mj_step(oracle_model, data, 40)
        np.testing.assert_allclose(sim.qpos[i].numpy(), data.qpos, atol=1e-6)
        np.testing.assert_allclose(sim.sensordata[i].numpy(), data.sensordata, rtol=1e-5, atol=1e-5)
    assert sim.sensordata[0, sim.sensor_slice("touch")][0] >= 1


def test_fields_vary_per_environment_and_constants_follow() -> None:
    sim = make_simulation(model(), 2, TRAIN)
    cube, dof = sim.model.body("cube").id, int(sim.model.joint("free").dofadr[0])
    before = sim.field("body_invweight0")[:, cube].clone()
    sim.field("body_mass")[1, cube] *= 4
    sim.set_const(torch.tensor([1]))
    after = sim.field("body_invweight0")[:, cube]
    torch.testing.assert_close(after[0], before[0])
    torch.testing.assert_close(after[1, 0], before[1, 0] / 4)
    torch.testing.assert_close(sim.field("dof_invweight0")[1, dof], before[1, 0] / 4)


def test_reset_leaves_the_others_alone() -> None:
    sim = make_simulation(model(), 3, TRAIN)
    sim.step(5)
    moved = sim.qpos.clone()
    sim.reset(torch.tensor([1]))
    torch.testing.assert_close(sim.qpos[1].double(), torch.from_numpy(sim.model.qpos0), atol=1e-6, rtol=0)
    assert torch.equal(sim.qpos[[0, 2]], moved[[0, 2]])


def test_restored_state_continues_bit_for_bit() -> None:
    sim = make_simulation(model(), 2, TRAIN)
    sim.ctrl[:] = torch.tensor([[0.1], [-0.3]])
    sim.step(17)
    saved = sim.save_state()
    sim.step(23)
    first = sim.save_state()
    other = make_simulation(model(), 2, TRAIN)
    other.qpos[:] = 0.7  # a write that waits must not survive
    other.load_state(saved)
    assert torch.equal(other.ctrl, sim.ctrl)
    other.step(23)
    for name, value in other.save_state().items():
        assert torch.equal(value, first[name]), name


def test_unknown_fields_and_settings_are_refused() -> None:
    sim = make_simulation(model(), 1, TRAIN)
    with pytest.raises(ValueError, match="no array field 'geom_colour'"):
        sim.field("geom_colour")
    with pytest.raises(KeyError):
        sim.sensor_slice("nothing")
    with pytest.raises(ValueError, match="CPU"):
        make_simulation(model(), 1, TRAIN, device="cuda")
    for bad in (
        {"integrator": "implicitfast"},
        {"engine": "mujoco_warp"},
        {"dt": 0.0},
        {"cone": "round"},
        {"threads": -1},
        {"decimation": 0},
    ):
        with pytest.raises(ValueError, match=r"^sim\."):
            SimConfig(**bad)


def test_evaluation_physics_keeps_engine_and_threads() -> None:
    cfg = evaluation_physics(SimConfig(threads=2))
    assert (cfg.threads, cfg.dt, cfg.integrator) == (2, 0.004, "implicitfast")
    assert cfg.period == pytest.approx(SimConfig().period)

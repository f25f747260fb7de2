"""What controller and teachers say to another policy's steps: bounded, and right enough to arrive by."""

import torch

from tests.env_world import make
from wbm.envs.config import EnvConfig
from wbm.envs.perception import Sight
from wbm.envs.relabel import RelabelDriver
from wbm.envs.whole_body import CONTACT, FREE, WholeBodyEnv
from wbm.robot import joints
from wbm.robot.schema import PolicySchema

LEAD_S = 0.3
"""A command that starts from the measured joints leads them by a step and the actuators' delay; and some room."""


def whole_body(n: int) -> WholeBodyEnv:
    env = make(n, EnvConfig(start="whole_body"), kind=WholeBodyEnv)
    env.reset()
    return env


def nothing(env: WholeBodyEnv) -> torch.Tensor:
    return torch.zeros(env.num_envs, env.num_actions)


def test_an_expert_that_is_not_obeyed_does_not_run_ahead():
    env = whole_body(2)
    idle = RelabelDriver(lambda obs: torch.zeros(2, 32), lambda obs: nothing(env), env, PolicySchema())
    sight = Sight({}, torch.zeros(2), torch.zeros(2, 3))
    start = env.state.q.clone()
    limit = torch.as_tensor(env.robot.qd_max) * LEAD_S
    for _ in range(30):
        before = env.state.q.clone()
        _, _, _, info = idle.step(env, sight)
        lead = (info["ctrl"] - before).abs()
        assert bool((lead[:, joints.WBC] <= limit[joints.WBC]).all())
        torch.testing.assert_close(info["executed"].float(), before.float(), atol=1e-6, rtol=0)
    assert float((env.state.q - start)[:, :10].abs().max()) < 0.02, "the student stood still, and so did the robot"
    assert env.override is None and bool((lead[:, :2].norm(dim=-1) > 0.01).all()), "it still asks to go on"


def test_an_expert_whose_memory_is_rebuilt_at_every_step_arrives():
    env = whole_body(2)
    arrived = torch.zeros(2, dtype=torch.bool)
    for _ in range(round(6.0 / env.period)):
        env.resume(env.phase == FREE)
        env.step(nothing(env))
        arrived |= env.phase == CONTACT
    assert bool(arrived.all())


def test_the_phase_follows_from_where_the_hand_is():
    env = whole_body(2)
    env.find_phase()
    assert env.phase.tolist() == [FREE, FREE]
    env.sim.qpos[:, : joints.NUM_JOINTS] = env._goal_q.to(env.sim.qpos)
    ids = torch.arange(2)
    env.sim.forward(ids)
    env._refresh()
    env.find_phase()
    assert env.phase.tolist() == [CONTACT, CONTACT]
    env.sim.qpos[0, 0] -= 0.3
    env.sim.forward(ids)
    env._refresh()
    env.find_phase()
    assert env.phase.tolist() == [FREE, CONTACT]

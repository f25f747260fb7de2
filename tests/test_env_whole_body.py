"""The approach: where the hand's target goes, how an episode starts, and what is left when another has acted."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.env_world import make, world
from wbm.control.config import WbcConfig
from wbm.envs.config import EnvConfig
from wbm.envs.grasp_env import AT_PREGRASP, FULL, SCATTERED
from wbm.envs.pregrasp import StartBank
from wbm.envs.whole_body import ASIDE, CONTACT, FREE, LINE, SEEN_FROM, WholeBodyEnv, _along_heading
from wbm.robot import joints
from wbm.robot.model import frame_poses, load_robot
from wbm.sim.config import SimConfig

SEEDS = st.integers(0, 2**32 - 1)
DOWN = Rotation.from_euler("x", np.pi)


def quat(turn: Rotation) -> torch.Tensor:
    """[K,4] (w x y z)."""
    return torch.as_tensor(np.roll(np.atleast_2d(turn.as_quat()), 1, axis=1), dtype=torch.float32)


def rotation(q: torch.Tensor) -> Rotation:
    return Rotation.from_quat(np.roll(q.double().numpy(), -1, axis=-1))


def whole_body(n: int = 2, **changes) -> WholeBodyEnv:
    env = make(n, EnvConfig(start="whole_body", **changes), kind=WholeBodyEnv)
    env.reset()
    return env


@settings(max_examples=30, deadline=None)
@given(SEEDS)
def test_from_afar_a_hand_from_above_closes_along_the_heading_and_any_other_is_as_it_was(seed):
    rng = np.random.default_rng(seed)
    tilt = Rotation.from_rotvec(rng.uniform(-0.4, 0.4, (4, 3)) * [1, 1, 0])
    down = tilt * Rotation.from_euler("z", rng.uniform(-3, 3, (4, 1))) * DOWN
    side = tilt * Rotation.from_euler("zy", np.column_stack([rng.uniform(-3, 3, 4), np.full(4, np.pi / 2)]))
    heading = rng.uniform(-np.pi, np.pi, 4)
    turned = rotation(_along_heading(quat(down), torch.as_tensor(heading, dtype=torch.float32)))
    x = turned.as_matrix()[:, :, 0]
    np.testing.assert_allclose(np.cos(np.arctan2(x[:, 1], x[:, 0]) - heading), 1.0, atol=1e-5)
    change = (turned * down.inv()).as_rotvec()
    np.testing.assert_allclose(change[:, :2], 0.0, atol=1e-5)  # about the vertical only
    kept = rotation(_along_heading(quat(side), torch.as_tensor(heading, dtype=torch.float32)))
    np.testing.assert_allclose((kept * side.inv()).magnitude(), 0.0, atol=1e-5)


def test_the_way_leads_over_a_point_behind_while_the_hand_is_off_the_line():
    env = whole_body(1)
    goal, axes = env._goal_pos[0].double().numpy(), rotation(env._goal_quat[0])
    for aside, before, angle in ((0.0, 0.2, 0.0), (0.009, 0.0, 0.04), (0.03, 0.1, 0.0), (0.0, 0.0, 0.3), (0.5, 0.3, 1)):
        shift = axes.apply([0.6 * aside, 0.8 * aside, -before])
        env.action.pos[0] = torch.as_tensor(goal + shift, dtype=torch.float32)
        env.action.quat[0] = quat(axes * Rotation.from_rotvec([0.0, angle, 0.0]))[0]
        back = ASIDE[0] * max(aside - LINE[0], 0.0) + ASIDE[1] * max(angle - LINE[1], 0.0)
        expected = goal + axes.apply([0.0, 0.0, -min(back, env.cfg.approach_back)])
        np.testing.assert_allclose(env._waypoint()[0].numpy(), expected, atol=2e-5)


@pytest.mark.parametrize(("distance", "sees"), [(SEEN_FROM + 0.05, False), (SEEN_FROM - 0.05, True)])
def test_the_hand_turns_to_how_the_object_lies_only_where_that_is_seen(distance, sees):
    env = whole_body(2)
    s, small = env.state, Rotation.from_rotvec([[0.2, 0.0, 0.0], [0.0, 0.25, 0.0]])
    hand = rotation(s.ee_quat)
    env._goal_pos.copy_(s.ee_pos_w + distance * torch.tensor([0.0, 0.6, 0.8]))
    env._goal_quat.copy_(quat(hand * small))
    env._far_quat.copy_(quat(hand * small.inv()))
    before = env.action.pos.clone()
    env._approach(torch.tensor([True, False]))
    wanted = (env._goal_quat if sees else env._far_quat)[0]
    assert (rotation(env.action.quat[0]) * rotation(wanted).inv()).magnitude() < 1e-3
    assert (rotation(env.action.quat[1]) * hand[1].inv()).magnitude() < 1e-3, "a hand at work is left alone"
    moved = (env.action.pos - before).norm(dim=-1)
    assert float(moved[1]) == 0.0
    assert float(moved[0]) == pytest.approx(env.cfg.approach_speed * env.period, rel=1e-3)


def test_episodes_start_by_share():
    binding, starts = world()
    rng = np.random.default_rng(0)
    scattered = torch.as_tensor(rng.normal(size=(len(starts.count), 3, 32)), dtype=torch.float32)
    bank = StartBank(starts.q, starts.count, scattered=scattered)
    cfg = EnvConfig(start="whole_body", pregrasp_share=0.25, scatter_share=0.5)
    env = WholeBodyEnv(binding, bank, load_robot(), cfg, SimConfig(), WbcConfig(), 4)
    ids, scenes = torch.arange(4), torch.tensor([1, 0, 1, 0])
    u = torch.zeros(4, env.columns.count)
    u[:, env._near] = torch.tensor([[0.24], [0.26], [0.74], [0.76]])
    u[:, env._scatter] = torch.tensor([[0.9], [0.0], [0.99], [0.5]])
    u[:, env._start] = 0.9
    q = env._start_joints(ids, scenes, u)
    assert env.started.tolist() == [AT_PREGRASP, SCATTERED, SCATTERED, FULL]
    assert env.phase.tolist() == [CONTACT, FREE, FREE, FREE]
    body = torch.as_tensor(joints.WBC)
    assert torch.equal(q[0], starts.q[1, starts.count[1] - 1])
    assert torch.equal(q[1:3, body], torch.stack([scattered[0, 0], scattered[1, 2]])[:, body])
    assert torch.equal(q[3, body], binding.table.q_start[0, body])
    # However it starts away from the pre-grasp, an episode leads to the planner's own, with the hand as there.
    assert torch.equal(env._goal_q[1:], starts.q[scenes[1:], 0]) and torch.equal(env._goal_q[0], q[0])
    assert torch.equal(q[1:, joints.HAND], starts.q[scenes[1:], 0][:, joints.HAND])


def test_shares_are_checked():
    for shares in ({"pregrasp_share": 0.6, "scatter_share": 0.5}, {"scatter_share": -0.1}):
        with pytest.raises(ValueError, match=r"env.pregrasp_share and env.scatter_share"):
            EnvConfig(**shares)
    for name in ("approach_rate", "approach_speed", "approach_turn", "approach_leash", "approach_s"):
        with pytest.raises(ValueError, match=f"env.{name} must be positive"):
            replace(EnvConfig(), **{name: 0.0})
    with pytest.raises(ValueError, match=r"env.approach_back must not be negative"):
        EnvConfig(approach_back=-0.1)


def test_resuming_takes_up_what_was_executed_and_only_where_it_is_asked_to():
    env = whole_body(2)
    rng = np.random.default_rng(1)
    for _ in range(3):
        noise = rng.uniform(-0.05, 0.05, (2, 32)) * (rng.random(32) < 0.9)
        env.noise = torch.as_tensor(noise, dtype=torch.float32)
        env.step(torch.zeros(2, env.num_actions))
    env.noise = None

    def memory() -> list[torch.Tensor]:
        c, term = env._controller_state, env.action
        return [c["q_target"], c["qd"], term.pos, term.quat, term.hand.target, env.ctrl]

    before = [m.clone() for m in memory()]
    state, obs = env.state.q.clone(), env.state.ee_pos_w.clone()
    env.resume(torch.zeros(2, dtype=torch.bool))
    assert all(torch.equal(a, b) for a, b in zip(before, memory(), strict=True))
    env.resume(torch.tensor([False, True]))
    assert all(torch.equal(a[0], b[0]) for a, b in zip(before, memory(), strict=True))
    assert torch.equal(env.state.q, state) and torch.equal(env.state.ee_pos_w, obs), "the state is nobody's memory"
    body, executed = torch.as_tensor(joints.WBC), env.sim.ctrl[1, :32].double().numpy()
    q, qd = env.state.q[1, body].float(), env.state.qd[1, body].float()
    target, speed, pos, turn, hand, ctrl = (m[1] for m in memory())
    torch.testing.assert_close(target, q - env.controller.cfg.dt * qd, atol=1e-6, rtol=0)
    torch.testing.assert_close(speed, qd, atol=1e-6, rtol=0)
    R, p = frame_poses(env.robot, executed)["ee"]
    np.testing.assert_allclose(pos.numpy(), p, atol=1e-5)
    assert (rotation(turn) * Rotation.from_matrix(R).inv()).magnitude() < 1e-4
    np.testing.assert_allclose(hand.numpy(), executed[joints.HAND], atol=1e-6)
    np.testing.assert_allclose(ctrl[joints.HAND].numpy(), executed[joints.HAND], atol=1e-6)
    assert float((before[4][1] - hand).abs().max()) > 1e-3, "the noise had moved the fingers' targets"


def test_who_has_lifted_the_object_is_not_lost():
    env = whole_body(2)
    env.phase[:] = CONTACT
    env.state.lifted[0] = 1
    env.find_phase()  # both are far from their pre-grasps
    assert env.phase.tolist() == [CONTACT, FREE]

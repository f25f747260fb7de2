"""Reward terms, geometry and quaternions against float64 NumPy and SciPy. Tolerance 1e-5: float32 arithmetic."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from wbm.envs import rewards
from wbm.envs.config import RewardConfig
from wbm.envs.rotations import quat_conj, quat_exp, quat_log, quat_mul, quat_to_mat, rotate
from wbm.envs.state import GraspState, box_gap, opposition, segment_gap

CFG = RewardConfig()
PER_FINGER = ("tip_gap", "finger_contact", "finger_force")


def state(n: int = 1, **values) -> GraspState:
    """A state whose unnamed quantities are zero."""
    tensors = {f.name: torch.zeros(n, 4) if f.name in PER_FINGER else torch.zeros(n) for f in fields(GraspState)}
    return GraspState(**(tensors | {k: torch.as_tensor(v, dtype=torch.float32) for k, v in values.items()}))


def test_eight_terms_sum_up_with_their_weights() -> None:
    torch.manual_seed(0)
    flags = dict(held=torch.ones(5), lifted=torch.ones(5), forbidden=torch.ones(5))
    amounts = dict(height=torch.rand(5) * 0.2, opposition=torch.rand(5), obstacle_force=torch.rand(5) * 30)
    s = state(5, **{name: torch.rand(5, 4) for name in PER_FINGER}, **flags, **amounts)
    action, previous = torch.rand(5, 27), torch.rand(5, 27)
    value, parts = rewards.total(s, action, previous, CFG)
    assert parts.shape == (5, 8) and len(rewards.TERMS) == 8
    torch.testing.assert_close(value, parts.sum(1))
    for k, name in enumerate(rewards.TERMS):
        without, _ = rewards.total(s, action, previous, replace(CFG, **{name: 0.0}))
        torch.testing.assert_close(value - without, parts[:, k], msg=name)
        assert bool((parts[:, k].abs() > 0).all()), name


def test_terms_at_known_states() -> None:
    near, far = state(), state(tip_gap=[[0.1] * 4], centre_gap=[0.2])
    assert rewards.reach(near, CFG).item() == pytest.approx(1.5)
    assert rewards.reach(far, CFG).item() == pytest.approx(np.exp(-1) + 0.5 * np.exp(-2), rel=1e-5)
    touching = state(finger_contact=[[1.0, 0, 0, 1.0]], obstacle_force=[5.0])
    assert rewards.contact(touching, CFG).item() == pytest.approx(0.5 - 0.25)
    assert rewards.grasp(state(opposition=[1.0]), CFG).item() == pytest.approx(1.0)
    at_goal = state(height=[CFG.goal_height], opposition=[1.0])
    assert rewards.lift(at_goal, CFG).item() == pytest.approx(1.5)
    assert rewards.lift(state(height=[CFG.goal_height]), CFG).item() == pytest.approx(1.5 * CFG.lift_open)
    assert rewards.lift(state(height=[-0.05], opposition=[1.0]), CFG).item() == 0.0
    assert rewards.lift(state(height=[0.7], opposition=[1.0]), CFG).item() < 1e-3, "flinging must not pay"
    assert rewards.stable(state(lifted=[1.0]), CFG).item() == pytest.approx(-1.0), "contact lost after lift-off"
    assert rewards.stable(state(lifted=[1.0], held=[1.0], holding=[1.0]), CFG).item() == pytest.approx(1 + CFG.hold)
    assert rewards.col(state(forbidden=[1.0], finger_force=[[30.0, 15, 0, 0]]), CFG).item() == pytest.approx(1.25)
    assert rewards.act(torch.tensor([[3.0, 4.0]])).item() == 25
    assert rewards.smooth(torch.tensor([[3.0, 4.0]]), torch.tensor([[0.0, 4.0]])).item() == 9


@given(st.floats(0, 0.16), st.floats(0, 0.16), st.floats(0, 1))
def test_lift_pays_for_height_up_to_the_goal(a: float, b: float, opposed: float) -> None:
    low, high = sorted((a, b))
    value = rewards.lift(state(2, height=[low, high], opposition=[opposed] * 2), CFG)
    assert value[0] <= value[1] + 1e-6


@given(st.floats(0, 1), st.floats(0, 10))
def test_slip_and_spin_never_pay(slip: float, spin: float) -> None:
    calm = state(lifted=[1.0], held=[1.0])
    moving = state(lifted=[1.0], held=[1.0], slip=[slip], spin=[spin])
    assert rewards.stable(moving, CFG) <= rewards.stable(calm, CFG)


@given(st.floats(0, 1), st.floats(0, 3))
def test_only_holding_still_pays_in_full(speed: float, turn: float) -> None:
    held = {"lifted": [1.0], "held": [1.0], "holding": [1.0]}
    moving = state(**held, obj_lin_vel_w=[[speed, 0.0, 0.0]], obj_ang_vel_w=[[0.0, turn, 0.0]])
    value = rewards.stable(moving, CFG).item()
    assert value == pytest.approx(1 + CFG.hold * np.exp(-speed / CFG.hold_speed - turn / CFG.hold_turn), rel=1e-5)


@settings(max_examples=50)
@given(st.integers(0, 2**31))
def test_rotations_against_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = Rotation.random(2, rng)
    v = rng.normal(size=3)
    qa, qb = (torch.tensor(r.as_quat(scalar_first=True)) for r in (a, b))
    product = Rotation.from_quat(quat_mul(qa, qb).numpy(), scalar_first=True)
    assert (product * (a * b).inv()).magnitude() < 1e-7
    np.testing.assert_allclose(quat_to_mat(qa).numpy(), a.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotate(qa, torch.tensor(v)).numpy(), a.apply(v), atol=1e-12)
    np.testing.assert_allclose(quat_log(qa).numpy(), a.as_rotvec(), atol=1e-7)
    np.testing.assert_allclose(quat_to_mat(quat_exp(torch.tensor(a.as_rotvec()))).numpy(), a.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotate(quat_conj(qa), rotate(qa, torch.tensor(v))).numpy(), v, atol=1e-12)


def test_small_and_zero_rotations() -> None:
    for angle in (0.0, 1e-9, 1e-4):
        w = torch.tensor([angle, 0.0, 0.0], dtype=torch.float64)
        torch.testing.assert_close(quat_log(quat_exp(w)), w, atol=1e-12, rtol=1e-6)


@given(st.integers(0, 2**31))
@settings(max_examples=30)
def test_box_gap_finds_the_nearest_point(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn, centre, half = Rotation.random(rng=rng), rng.normal(size=3), rng.uniform(0.01, 0.3, 3)
    points = centre + rng.normal(size=(4, 3)) * 0.3
    gap = box_gap(*(torch.tensor(x)[None] for x in (points, centre, turn.as_matrix(), half)))[0].numpy()
    local = turn.inv().apply(points + gap - centre)
    assert (np.abs(local) <= half + 1e-9).all(), "the end lies in the box"
    samples = centre + turn.apply(rng.uniform(-half, half, (2000, 3)))
    nearest = np.linalg.norm(points[:, None] - samples, axis=-1).min(1)
    assert (np.linalg.norm(gap, axis=1) <= nearest + 1e-9).all(), "no point of the box is nearer"


def test_segment_gap_and_opposition() -> None:
    point = torch.tensor([[0.0, 1.0, 0.0]] * 3)
    ends = torch.tensor([[[-1.0, 0, 0], [1, 0, 0]], [[1.0, 0, 0], [3, 0, 0]], [[0.0] * 3] * 2])
    np.testing.assert_allclose(segment_gap(point, ends[:, 0], ends[:, 1]).numpy(), [1, np.sqrt(2), 1], rtol=1e-6)
    force = torch.zeros(4, 4, 3)
    force[0, 0], force[0, 3] = torch.tensor([5.0, 0, 0]), torch.tensor([-2.0, 0, 0])
    force[1, 0], force[1, 3] = torch.tensor([5.0, 0, 0]), torch.tensor([2.0, 0, 0])
    force[2, 0] = torch.tensor([5.0, 0, 0])
    force[3, 1], force[3, 3] = torch.tensor([1.0, 0, 0]), torch.tensor([-1.0, 1.0, 0])
    np.testing.assert_allclose(opposition(force).numpy(), [1, 0, 0, np.sqrt(0.5)], atol=1e-6)

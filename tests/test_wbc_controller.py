"""The controller against MuJoCo's kinematics, a float64 QP, and its own promises on limits and finiteness."""

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from wbm.control.config import WbcConfig
from wbm.control.program import program
from wbm.control.wbc import WholeBodyController
from wbm.robot.joints import WBC
from wbm.robot.mjcf import robot_spec
from wbm.robot.model import load_robot
from wbm.robot.spheres import sample_configurations

N = 16
FRAME_TOLERANCE = 2e-5  # float32 over a chain of 20 links
LIMIT_TOLERANCE = 1e-6


@pytest.fixture(scope="module")
def controller() -> WholeBodyController:
    return WholeBodyController(load_robot(), N, 4, WbcConfig())


def place(c: WholeBodyController, seed: int, spread: float = 0.4) -> None:
    """Home pose, targets in front, a slab below them and a ball among them."""
    robot, rng = load_robot(), np.random.default_rng(seed)
    c.q.numpy()[:] = robot.q_home
    c.q_posture.numpy()[:] = robot.q_home[WBC]
    target = np.array([0.9, 0.0, 0.6]) + rng.uniform(-spread, spread, (N, 3)) * [1, 1, 0.3]
    c.ee_pos.numpy()[:] = target
    c.ee_quat.numpy()[:] = [0, 1, 0, 0]
    c.gaze_point.numpy()[:] = target - [0, 0, 0.1]
    c.gaze_weight.numpy()[:] = 1.0
    c.obstacle_type.numpy()[:] = [6, 2, -1, -1]
    c.obstacle_size.numpy()[:, 0] = [0.4, 0.8, 0.025]
    c.obstacle_size.numpy()[:, 1] = 0.05
    c.obstacle_pos.numpy()[:, 0] = [1.2, 0, 0.3]
    c.obstacle_pos.numpy()[:, 1] = target + np.array([0.0, 0.25, 0.05])
    c.obstacle_quat.numpy()[:] = [1, 0, 0, 0]
    c.reset(None)


def test_frames_agree_with_mujoco(controller):
    model = robot_spec().compile()
    data = mujoco.MjData(model)
    q = sample_configurations(load_robot(), N, seed=1)
    controller.q.numpy()[:] = q
    controller.frame_pos.fill_(wp.vec3(np.inf, np.inf, np.inf))
    controller.forward_kinematics()
    for e in range(N):
        data.qpos[:] = q[e].astype(np.float32)
        mujoco.mj_kinematics(model, data)
        for k, name in enumerate(controller.frame_names):
            assert np.abs(controller.frame_pos.numpy()[e, k] - data.site(name).xpos).max() < FRAME_TOLERANCE


@pytest.mark.parametrize("seed", [0, 1])
def test_limits_hold_and_targets_are_reached(controller, seed):
    robot, c = load_robot(), controller
    place(c, seed)
    before = np.zeros((N, 16))
    for _ in range(200):
        c.step()
        qd, q = c.qd.numpy().astype(float), c.q_target.numpy().astype(float)
        assert np.isfinite(qd).all()
        assert (np.abs(qd) <= robot.qd_max[WBC] + LIMIT_TOLERANCE).all()
        assert (np.abs(qd - before) <= robot.qdd_max[WBC] * c.cfg.dt + LIMIT_TOLERANCE * 10).all()
        assert (q >= robot.q_min[WBC] - LIMIT_TOLERANCE).all() and (q <= robot.q_max[WBC] + LIMIT_TOLERANCE).all()
        before = qd
        c.q.numpy()[:, WBC] = c.q_target.numpy()
    c.forward_kinematics()
    ee = c.frame_pos.numpy()[:, c.frame_names.index("ee")]
    assert np.median(np.linalg.norm(ee - c.ee_pos.numpy(), axis=1)) < 2e-3
    assert c.min_distance.numpy().min() > -1e-3


def test_the_program_is_solved_as_a_float64_solver_solves_it(controller):
    pytest.importorskip("qpsolvers")
    place(controller, 3)
    worst = 0.0
    for step in range(30):
        controller.step()
        if step % 6 == 5:
            for e in (0, N // 2):
                exact = program(controller, e).solve()
                worst = max(worst, np.abs(exact - controller.qd.numpy()[e]).max())
        controller.q.numpy()[:, WBC] = controller.q_target.numpy()
    assert worst < 1e-3


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 10_000), st.floats(-1e6, 1e6), st.booleans())
def test_never_a_nan(controller, seed, far, coincident):
    robot, rng = load_robot(), np.random.default_rng(seed)
    place(controller, seed)
    controller.q.numpy()[:] = rng.uniform(robot.q_min - 0.5, robot.q_max + 0.5, (N, 32))
    controller.ee_pos.numpy()[:, 0] = far
    controller.ee_quat.numpy()[: N // 2] = 0.0
    if coincident:
        controller.forward_kinematics()
        camera = controller.frame_names.index("camera")
        controller.gaze_point.numpy()[:] = controller.frame_pos.numpy()[:, camera]
    controller.reset(None)
    for _ in range(3):
        controller.step()
        assert np.isfinite(controller.qd.numpy()).all() and np.isfinite(controller.ctrl.numpy()).all()


def test_joints_outside_their_range_return_monotonically(controller):
    robot, c = load_robot(), controller
    place(c, 0)
    j = 3  # arm_joint1
    c.q.numpy()[:, j] = robot.q_max[j] + 0.2
    c.reset(None)
    last = torch.full((N,), float(robot.q_max[j]) + 0.2 + 1e-5).numpy()
    for _ in range(60):
        c.step()
        now = c.q_target.numpy()[:, 3]
        outside = last > robot.q_max[j]
        assert (now[outside] <= last[outside] + LIMIT_TOLERANCE).all()
        last = now.copy()
        c.q.numpy()[:, WBC] = c.q_target.numpy()
    assert (last <= robot.q_max[j] + LIMIT_TOLERANCE).all()

"""Every objective's Jacobian against finite differences of MuJoCo's kinematics, and what starts badly ends well.

Tolerances: central differences of float64 kinematics with 1e-5 rad leave 1e-9; the rows are float32 over a chain of
20 links, levers up to 2 m.
"""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from wbm.control.config import WbcConfig
from wbm.control.wbc import YAW_LEVER, WholeBodyController
from wbm.kernels.wbc_objectives import CENTRING_BAND
from wbm.robot.joints import WBC
from wbm.robot.mjcf import robot_spec
from wbm.robot.model import load_robot
from wbm.robot.spheres import sample_configurations

N, STEP, TOLERANCE = 12, 1e-5, 2e-4
HELP_ANGLE = 0.8  # rad, gaze error from which the base's columns are zero
BOX = 6
ROW_GAZE, ROW_DISTANCE = 6, 8


@pytest.fixture(scope="module")
def posed():
    """A controller after one step at random joints with a point to look at, and MuJoCo with the same robot."""
    c = WholeBodyController(load_robot(), N, 1, WbcConfig())
    q = sample_configurations(c.robot, N, seed=4).astype(np.float32)
    rng = np.random.default_rng(4)
    q[:, :3] = rng.uniform(-1.0, 1.0, (N, 3))
    c.q.assign(q)
    c.forward_kinematics()
    camera = c.frame_names.index("camera")
    point = c.frame_pos.numpy()[:, camera] + rng.normal(size=(N, 3))
    c.gaze_point.assign(point.astype(np.float32))
    c.reset()
    c.step()
    model = robot_spec().compile()
    return c, q.astype(np.float64), point, model, mujoco.MjData(model)


def differences(model, data, q, value):
    """d value(data) / dq for the controlled joints [..., 16]."""
    columns = []
    for j in WBC:
        ends = []
        for sign in (1.0, -1.0):
            data.qpos[:] = q
            data.qpos[j] += sign * STEP
            mujoco.mj_kinematics(model, data)
            ends.append(np.array(value(data), dtype=np.float64))
        columns.append((ends[0] - ends[1]) / (2 * STEP))
    return np.stack(columns, axis=-1)


def test_the_hands_rows(posed):
    c, q, _, model, data = posed
    for e in range(N):
        jac = c._jac.numpy()[e]
        linear = differences(model, data, q[e], lambda d: d.site("ee").xpos.copy())
        assert np.abs(jac[:3] - linear).max() < TOLERANCE
        data.qpos[:] = q[e]
        mujoco.mj_kinematics(model, data)
        rot = data.site("ee").xmat.reshape(3, 3).copy()
        change = differences(model, data, q[e], lambda d: d.site("ee").xmat.reshape(3, 3).copy())
        for j in range(len(WBC)):
            skew = change[..., j] @ rot.T
            omega = [skew[2, 1], skew[0, 2], skew[1, 0]]
            assert np.abs(jac[3:6, j] - omega).max() < TOLERANCE


def test_the_rows_of_gaze_and_viewing_distance(posed):
    c, q, point, model, data = posed
    checked = 0
    for e in range(N):

        def sight(d, e=e):
            return point[e] - d.site("camera").xpos

        def angle(d, e=e):
            axis = d.site("camera").xmat.reshape(3, 3)[:, 2]
            return [np.arctan2(np.linalg.norm(np.cross(axis, sight(d, e))), axis @ sight(d, e))]

        data.qpos[:] = q[e]
        mujoco.mj_kinematics(model, data)
        theta = angle(data)[0]
        if not 0.05 < theta < 3.0:  # the angle itself has a kink at 0 and pi
            continue
        checked += 1
        row = c._jac.numpy()[e, ROW_GAZE]
        exact = differences(model, data, q[e], angle)[0]
        assert np.abs(row[3:] - exact[3:]).max() < 5 * TOLERANCE
        share = np.clip(1.0 - theta / HELP_ANGLE, 0.0, 1.0)  # of the base's columns
        assert np.abs(row[:3] - share * exact[:3]).max() < 5 * TOLERANCE
        distance = differences(model, data, q[e], lambda d: [np.linalg.norm(sight(d))])[0]
        assert np.abs(c._jac.numpy()[e, ROW_DISTANCE] - distance).max() < TOLERANCE
    assert checked > N // 2


def test_the_diagonal_terms_descend_their_potentials():
    """Posture, centring, damping and smoothness against central differences of what they minimise, in float64.

    With `f(qd) = sum_i h_i qd_i^2 - 2 g_i qd_i` g is minus the slope of the potentials.
    """
    weights = replace(WbcConfig().weights, posture=0.3, posture_base=0.2, centring=0.4, smoothness=0.1, face=0.0)
    cfg = WbcConfig(weights=weights)
    robot = load_robot()
    c = WholeBodyController(robot, N, 0, cfg)
    q = sample_configurations(robot, N, seed=9)
    low, high = robot.q_min[WBC], robot.q_max[WBC]
    inset = 0.001 * (high - low)[3:]  # from limit to limit, so that the outer bands are met, without their kinks
    q[:, WBC[3:]] = np.linspace(low[3:] + inset, high[3:] - inset, N)
    q[:, :3] = np.random.default_rng(9).uniform(-1.0, 1.0, (N, 3))
    goal = (q[:, WBC] + np.random.default_rng(8).uniform(-0.2, 0.2, (N, len(WBC)))).astype(np.float32)
    c.q.assign(q.astype(np.float32))
    c.q_posture.assign(goal)
    c.gaze_weight.fill_(0.0)  # its posture and its turn of the base have tests of their own
    c.reset()
    c.step()
    joints, w, k = q[:, WBC].astype(np.float32).astype(np.float64), cfg.weights, cfg.gains
    is_base = np.arange(len(WBC)) < 3
    posture = np.where(is_base, w.posture_base, w.posture)
    band = CENTRING_BAND * (high - low)

    def inward(x):
        return np.clip((low + band - x) / band, 0, 1) - np.clip((x - high + band) / band, 0, 1)

    def potential(x):
        centring = w.centring * k.centring * band * np.abs(inward(x)) ** 3 / 3
        return 0.5 * posture * k.posture * (x - goal) ** 2 + np.where(is_base, 0.0, centring)

    slope = (potential(joints + STEP) - potential(joints - STEP)) / (2 * STEP)
    assert np.abs(inward(joints)[:, 3:]).max() > 0.98 and np.abs(slope).max() > 0.05
    np.testing.assert_allclose(c._rhs.numpy(), -slope, atol=2e-5)
    lever = np.where(is_base, np.array([1.0, 1.0, YAW_LEVER] + [0.0] * (len(WBC) - 3)), 0.0)
    expected = w.damping + posture + lever**2 * (w.smoothness + w.base)
    expected = expected + np.where(is_base, 0.0, w.centring * np.abs(inward(joints)))
    np.testing.assert_allclose(c._diag.numpy(), expected, rtol=2e-5)


def test_a_robot_that_starts_inside_an_obstacle_leaves_it():
    c = WholeBodyController(load_robot(), 4, 1, WbcConfig())
    q = np.tile(c.robot.q_home, (4, 1))
    c.q.assign(q.astype(np.float32))
    c.forward_kinematics()
    ee = c.frame_pos.numpy()[:, c.frame_names.index("ee")]
    c.obstacle_type.fill_(BOX)
    c.obstacle_size.assign(np.full((4, 1, 3), 0.06, np.float32))
    c.obstacle_pos.assign((ee + np.array([0.03, 0.0, -0.05])).astype(np.float32)[:, None])
    c.ee_pos.assign(ee)
    c.ee_quat.assign(c.frame_quat.numpy()[:, c.frame_names.index("ee")])
    c.gaze_point.assign(ee)
    c.reset()
    c.step()
    assert (c.min_distance.numpy() < -0.01).all()
    for _ in range(150):
        q[:, WBC] = c.q_target.numpy()
        c.q.assign(q.astype(np.float32))
        c.step()
        assert np.isfinite(c.qd.numpy()).all()
    assert (c.min_distance.numpy() > 0.015).all()


def test_infinite_and_huge_inputs_leave_the_outputs_finite_and_inside():
    robot = load_robot()
    c = WholeBodyController(robot, 6, 2, WbcConfig())
    q = np.tile(robot.q_home, (6, 1)).astype(np.float32)
    q[0, 5], q[1, 0] = np.nan, np.inf
    c.q.assign(q)
    c.ee_pos.assign(np.array([[np.inf, 0, 0], [np.nan] * 3, [1e30] * 3, [0] * 3, [1] * 3, [-1e30, 0, 0]], np.float32))
    c.ee_quat.assign(
        np.array([[0] * 4, [np.nan] * 4, [np.inf, 0, 0, 0], [1e-30] * 4, [1e30] * 4, [1, 0, 0, 0]], np.float32)
    )
    c.gaze_point.assign(np.array([[np.inf] * 3, [1e30] * 3, [np.nan] * 3, [0] * 3, [1e-30] * 3, [1] * 3], np.float32))
    c.ee_lin_vel.assign(np.full((6, 3), 1e30, np.float32))
    c.obstacle_type.assign(np.array([[BOX, 3]] * 6, np.int32))
    c.obstacle_size.assign(np.zeros((6, 2, 3), np.float32))  # a box and a capsule without extent
    c.obstacle_pos.assign(np.zeros((6, 2, 3), np.float32))
    c.obstacle_quat.assign(np.zeros((6, 2, 4), np.float32))
    c.reset()
    for _ in range(5):
        c.step()
        qd = c.qd.numpy()
        assert np.isfinite(qd).all() and np.isfinite(c.ctrl.numpy()).all() and np.isfinite(c.q_target.numpy()).all()
        assert (np.abs(qd) <= robot.qd_max[WBC] + 1e-6).all()

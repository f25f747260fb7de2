"""The gaze from every starting direction, and the turn of the base that makes room for it."""

import numpy as np
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from wbm.control.config import WbcConfig
from wbm.control.wbc import WholeBodyController
from wbm.kernels import wbc_objectives as obj
from wbm.robot.joints import NECK, WBC
from wbm.robot.model import load_robot

N = 128
STEPS = 240
LARGEST = np.radians(2.0)
SECTOR = 1e-4  # rad, float32 angles of a few turns


def gaze_error(c: WholeBodyController) -> np.ndarray:
    """Angle [N] between the optical axis and the line of sight, rad."""
    camera = c.frame_names.index("camera")
    w, x, y, z = c.frame_quat.numpy()[:, camera].astype(float).T
    axis = np.c_[2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
    sight = c.gaze_point.numpy() - c.frame_pos.numpy()[:, camera]
    return np.arctan2(np.linalg.norm(np.cross(axis, sight), axis=1), (axis * sight).sum(axis=1))


def test_the_gaze_arrives_from_every_direction():
    """Hand and gaze on a target, base heading and neck uniformly random (the first starts with its back to it)."""
    robot, rng = load_robot(), np.random.default_rng(0)
    c = WholeBodyController(robot, N, 0, WbcConfig())
    q = np.tile(robot.q_home, (N, 1))
    q[:, 2] = np.linspace(-np.pi, np.pi, N, endpoint=False)
    free = np.arange(1, N)
    while len(free):
        q[free, NECK] = rng.uniform(robot.q_min[NECK], robot.q_max[NECK], (len(free), 6))
        c.q.assign(q.astype(np.float32))
        c.reset()
        c.step()
        free = np.flatnonzero(c.min_distance.numpy() < 0.0)
    c.ee_pos.fill_(wp.vec3(1.0, 0.0, 0.7))
    c.ee_quat.fill_(wp.vec4(0.0, 1.0, 0.0, 0.0))
    c.gaze_point.fill_(wp.vec3(1.0, 0.0, 0.6))
    c.reset()
    start = gaze_error(c)
    for _ in range(STEPS):
        c.step()
        q[:, WBC] = c.q_target.numpy()
        c.q.assign(q.astype(np.float32))
    c.forward_kinematics()
    assert start.max() > np.radians(170)
    assert np.percentile(gaze_error(c), 99) < LARGEST


@wp.kernel
def _turn(hand: wp.vec3, target: wp.vec3, looks: bool, yaw: float, out: wp.array(dtype=wp.float32)):
    out[0] = obj.face_turn(hand, target, looks, yaw, -2.0 * wp.pi, 2.0 * wp.pi)


def face_turn(a: float, b: float, looks: bool, yaw: float) -> float:
    """The kernel's answer for azimuths a and b, 1 m away."""
    out = wp.full(1, value=np.inf, dtype=wp.float32, device="cpu")
    points = [wp.vec3(np.cos(x), np.sin(x), 0.0) for x in (a, b)]
    wp.launch(_turn, dim=1, inputs=[*points, looks, yaw, out], device="cpu")
    return float(out.numpy()[0])


@settings(max_examples=200, deadline=None)
@given(st.floats(-3.1, 3.1), st.floats(-3.1, 3.1), st.booleans(), st.floats(-6.2, 6.2))
def test_the_base_turns_as_little_as_brings_both_points_into_their_sectors(a, b, looks, yaw):
    turn = face_turn(a, b, looks, yaw)

    def fits(x, slack):
        hand = np.abs(np.angle(np.exp(1j * (a - x)))) <= 1.15 + slack
        seen = np.abs(np.angle(np.exp(1j * (b - x)))) <= 2.0 + slack if looks else True
        return hand & seen & (np.abs(yaw + x) <= 2 * np.pi + slack)

    assert fits(turn, SECTOR)
    smaller = np.linspace(-abs(turn), abs(turn), 2001)[1:-1]
    assert not (fits(smaller, -SECTOR) & (np.abs(smaller) < abs(turn) - SECTOR)).any()

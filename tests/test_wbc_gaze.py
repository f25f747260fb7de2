"""The gaze from every starting direction, and the turn of the base that makes room for it."""

import numpy as np
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from wbm.control.config import WbcConfig
from wbm.control.gaze_trial import hand_error, place_facing, place_reachable, settle
from wbm.control.wbc import WholeBodyController
from wbm.kernels import wbc_objectives as obj
from wbm.robot.model import load_robot

N = 128
STEPS = 240
LARGEST = np.radians(2.0)
SECTOR = 1e-4  # rad, float32 angles of a few turns


def test_the_gaze_arrives_from_every_direction():
    """Hand and gaze on one target, base heading and neck uniformly random, the first robot with its back to it."""
    c = WholeBodyController(load_robot(), N, 0, WbcConfig())
    errors = settle(c, place_facing(c, 0), STEPS, every=STEPS)
    assert errors[0].max() > np.radians(150)
    assert np.percentile(errors[-1], 99) < LARGEST


def test_reachable_poses_are_reached_exactly():
    """From home; a few end in a corner between the damper distances, which no local controller leaves."""
    c = WholeBodyController(load_robot(), N, 0, WbcConfig())
    settle(c, place_reachable(c, 0), 2 * STEPS, every=STEPS)
    away, angle = hand_error(c)
    assert (away < 1e-3).mean() > 0.93
    assert (angle < np.radians(0.1)).mean() > 0.93
    assert np.median(away) < 3e-4


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

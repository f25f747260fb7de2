"""What a scene means for an environment: widths of a target against float64, and where the base stands."""

from types import SimpleNamespace
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from wbm.envs.binding import NUM_DIRECTIONS, _stand, _widths

SEEDS = st.integers(0, 2**32 - 1)


@settings(max_examples=15, deadline=None)
@given(SEEDS)
def test_widths_are_the_extents_of_the_turned_points(seed):
    rng = np.random.default_rng(seed)
    points, turn = rng.normal(size=(3, 40, 3)), Rotation.random(3, rng=rng)
    widths = _widths(points, np.roll(turn.as_quat(), 1, axis=1))
    assert widths.shape == (3, NUM_DIRECTIONS)
    for s in range(3):
        world = turn[s].apply(points[s])
        for k in rng.integers(NUM_DIRECTIONS, size=5):
            angle = np.pi * k / NUM_DIRECTIONS
            along = world[:, 0] * np.cos(angle) + world[:, 1] * np.sin(angle)
            np.testing.assert_allclose(widths[s, k], along.max() - along.min(), rtol=1e-12)


def scene_bank(rng: np.random.Generator, count: int = 6) -> Any:
    """What `_stand` asks of a bank: targets about the origin, start poses 2 to 4 m away, places to grasp from."""
    way = rng.uniform(-np.pi, np.pi, count)
    far = rng.uniform(2.0, 4.0, count)
    target, start = rng.uniform(-0.5, 0.5, (count, 2, 3)), np.zeros((count, 32))
    start[:, 0], start[:, 1] = target[:, 0, 0] + far * np.cos(way), target[:, 0, 1] + far * np.sin(way)
    grasp = np.column_stack([target[:, 0, :2] + rng.uniform(0.3, 0.7, (count, 2)), rng.uniform(-3, 3, count)])
    return SimpleNamespace(object_pos=target, q_start=start, base_grasp=grasp)


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_the_base_stands_on_the_way_from_the_start_as_far_as_it_can_reach_and_faces_the_target(seed):
    bank = scene_bank(np.random.default_rng(seed))
    rows = np.array([4, 1, 2])
    base = _stand(bank, rows)
    for pose, row in zip(base, rows, strict=True):
        target, start = bank.object_pos[row, 0, :2], bank.q_start[row, :2]
        reach = np.linalg.norm(target - bank.base_grasp[row, :2])
        facing = np.array([np.cos(pose[2]), np.sin(pose[2])])
        np.testing.assert_allclose(target - pose[:2], reach * facing, atol=1e-12)  # faces it from its reach
        ahead = (pose[:2] - start) @ facing  # and has come straight ahead
        np.testing.assert_allclose(start + ahead * facing, pose[:2], atol=1e-12)
        assert ahead > 0.0

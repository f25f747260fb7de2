"""Closed loops from every starting direction: does the camera find its target, and does the hand arrive exactly?"""

from __future__ import annotations

import numpy as np

from wbm.control.wbc import WholeBodyController
from wbm.robot.joints import ARM, BASE, NECK, WBC

TRIES = 60


def gaze_error(c: WholeBodyController) -> np.ndarray:
    """Angle [N] (rad) between the optical axis and the line of sight, at the frames of the last step."""
    camera = c.frame_names.index("camera")
    w, x, y, z = c.frame_quat.numpy()[:, camera].astype(float).T
    axis = np.c_[2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
    sight = c.gaze_point.numpy() - c.frame_pos.numpy()[:, camera]
    return np.arctan2(np.linalg.norm(np.cross(axis, sight), axis=1), (axis * sight).sum(axis=1))


def hand_error(c: WholeBodyController) -> tuple[np.ndarray, np.ndarray]:
    """Distance [N] (m) and angle [N] (rad) of the hand from its target, at the frames of the last step."""
    ee = c.frame_names.index("ee")
    away = np.linalg.norm(c.frame_pos.numpy()[:, ee].astype(float) - c.ee_pos.numpy(), axis=1)
    dot = (c.frame_quat.numpy()[:, ee].astype(float) * c.ee_quat.numpy()).sum(axis=1)
    cross = np.sqrt(np.maximum(0.0, 1.0 - dot * dot))
    return away, 2.0 * np.arctan2(cross, np.abs(dot))


def place_facing(c: WholeBodyController, seed: int, spread: bool = True) -> np.ndarray:
    """Start with the base heading and the neck uniformly random, hand and gaze on a target.

    Args:
        c: without obstacles; it is reset, with its targets set.
        seed: of all random numbers.
        spread: targets all around at 0.8 to 1.4 m; else one, 1 m ahead of the origin.

    Returns:
        Joints [N,32]; none of them touches itself. The first robot has its back to the target.
    """
    robot, n, rng = c.robot, c.num_envs, np.random.default_rng(seed)
    azimuth, distance = rng.uniform(-np.pi, np.pi, n), rng.uniform(0.8, 1.4, n)
    height = rng.uniform(0.4, 0.9, n)
    if not spread:
        azimuth[:], distance[:], height[:] = 0.0, 1.0, 0.6
    target = np.c_[distance * np.cos(azimuth), distance * np.sin(azimuth), height]
    q = np.tile(robot.q_home, (n, 1))
    q[:, BASE.start + 2] = rng.uniform(-np.pi, np.pi, n)
    q[0, BASE.start + 2] = azimuth[0] - np.pi if azimuth[0] > 0 else azimuth[0] + np.pi
    touching = np.arange(n)
    for _ in range(TRIES):
        q[touching, NECK] = rng.uniform(robot.q_min[NECK], robot.q_max[NECK], (len(touching), 6))
        _measure(c, q)
        touching = np.flatnonzero(c.min_distance.numpy() < 0.0)
        if len(touching) == 0:
            break
    yaw = azimuth + rng.uniform(-0.5, 0.5, n)
    palm_down = np.c_[np.zeros(n), np.cos(yaw / 2), np.sin(yaw / 2), np.zeros(n)]
    _aim(c, target + np.array([0.0, 0.0, 0.1]), palm_down, target)
    return q


def place_reachable(c: WholeBodyController, seed: int) -> np.ndarray:
    """Start at home with the hand's target at a pose that some joints clear of themselves are known to have.

    Args:
        c: without obstacles; it is reset, with its targets set.
        seed: of all random numbers.

    Returns:
        Joints [N,32].
    """
    robot, n, rng = c.robot, c.num_envs, np.random.default_rng(seed)
    q = np.tile(robot.q_home, (n, 1))
    near = np.arange(n)
    for _ in range(TRIES):
        m = len(near)
        q[near, BASE] = rng.uniform([-1.0, -1.0, -np.pi], [1.0, 1.0, np.pi], (m, 3))
        reach = 0.35 * (robot.q_max[ARM] - robot.q_min[ARM]) / 2
        arm = robot.q_home[ARM] + rng.uniform(-1.0, 1.0, (m, 7)) * reach
        margin = 0.1 * (robot.q_max[ARM] - robot.q_min[ARM])
        q[near, ARM] = np.clip(arm, robot.q_min[ARM] + margin, robot.q_max[ARM] - margin)
        _measure(c, q)
        near = np.flatnonzero(c.min_distance.numpy() < 0.05)
        if len(near) == 0:
            break
    ee = c.frame_names.index("ee")
    pos, quat = c.frame_pos.numpy()[:, ee].copy(), c.frame_quat.numpy()[:, ee].copy()
    _aim(c, pos, quat, pos)
    return np.tile(robot.q_home, (n, 1))


def settle(c: WholeBodyController, q: np.ndarray, steps: int, every: int = 1) -> np.ndarray:
    """Close the loop with joints that follow perfectly; gaze errors [T,N] (rad) of every `every`-th step and the last.

    Args:
        c: with targets set.
        q: start joints [N,32]; holds the last ones afterwards.
        steps: control steps.
        every: how often to look.
    """
    c.q.assign(q.astype(np.float32))
    c.reset()
    errors = []
    for k in range(steps + 1):
        c.step()
        if k % every == 0 or k == steps:
            errors.append(gaze_error(c))
        if k < steps:
            q[:, WBC] = c.q_target.numpy()
            c.q.assign(q.astype(np.float32))
    return np.array(errors)


def _measure(c: WholeBodyController, q: np.ndarray) -> None:
    c.q.assign(q.astype(np.float32))
    c.reset()
    c.step()


def _aim(c: WholeBodyController, pos: np.ndarray, quat: np.ndarray, look: np.ndarray) -> None:
    for array, value in ((c.ee_pos, pos), (c.ee_quat, quat), (c.gaze_point, look)):
        array.assign(np.ascontiguousarray(value, dtype=np.float32))

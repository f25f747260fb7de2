"""Poses on the host: where to put a camera."""

from __future__ import annotations

import numpy as np

from wbm.robot.rotations import mat_to_quat


def look_at(pos: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Quaternion [4] (w x y z) of the optical frame at `pos` [3] whose z axis points at `target` [3], image upright."""
    z = np.asarray(target, float) - np.asarray(pos, float)
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = np.array([0.0, -1.0, 0.0]) if np.linalg.norm(x) < 1e-6 else x / np.linalg.norm(x)
    return mat_to_quat(np.stack([x, np.cross(z, x), z], axis=1))


def optical_axis(quat: np.ndarray) -> np.ndarray:
    """The z axis [3] of a frame with quaternion [4] (w x y z)."""
    w, x, y, z = quat / np.linalg.norm(quat)
    return np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])

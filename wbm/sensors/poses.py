"""Poses on the host: where to put a camera."""

from __future__ import annotations

import numpy as np


def mat_to_quat(m: np.ndarray) -> np.ndarray:
    """Quaternion [4] (w x y z) of a rotation matrix [3,3], by its largest squared component (Shepperd, 1978)."""
    k = int(np.argmax([np.trace(m), *np.diag(m)])) - 1
    q = np.empty(4)
    if k < 0:
        q[:] = 1 + np.trace(m), m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    else:
        i, j, n = k, (k + 1) % 3, (k + 2) % 3
        q[0] = m[n, j] - m[j, n]
        q[1 + i], q[1 + j], q[1 + n] = 1 + m[i, i] - m[j, j] - m[n, n], m[j, i] + m[i, j], m[n, i] + m[i, n]
    return q / np.linalg.norm(q)


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

"""Quaternion algebra on NumPy arrays; quaternions are w x y z, along the last axis."""

from __future__ import annotations

from typing import Any

import numpy as np

from wbm.robot import proprio


def unit_quat(quat: Any) -> np.ndarray:
    """Return `quat` scaled to unit length, as MuJoCo does on load."""
    q = np.asarray(quat, dtype=np.float64)
    q = q / np.abs(q).max()  # else the squares of huge values overflow
    return q / np.linalg.norm(q)


def quat_to_mat(quat: Any) -> np.ndarray:
    """Rotation matrices [...,3,3] of unit quaternions [...,4]."""
    return proprio.quat_to_mat(np, np.asarray(quat, dtype=np.float64))


def mat_to_quat(rot: np.ndarray) -> np.ndarray:
    """Unit quaternion [4] of a rotation matrix [3,3], by its largest component (Shepperd, 1978)."""
    (a, b, c), (d, e, f), (g, h, i) = rot.tolist()
    trace = a + e + i
    largest = max(trace, a, e, i)
    if largest == trace:
        quat = (1 + trace, h - f, c - g, d - b)
    elif largest == a:
        quat = (h - f, 1 + a - e - i, d + b, g + c)
    elif largest == e:
        quat = (c - g, d + b, 1 + e - i - a, h + f)
    else:
        quat = (d - b, g + c, h + f, 1 + i - a - e)
    return np.array(quat) / np.sqrt(sum(x * x for x in quat))


def rotate(quat: np.ndarray, vec: np.ndarray) -> np.ndarray:
    """Vectors [...,3] rotated by unit quaternions [...,4]."""
    xyz, w = quat[..., 1:], quat[..., :1]
    t = 2.0 * np.cross(xyz, vec)
    return vec + w * t + np.cross(xyz, t)


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product [...,4] of quaternions."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def quat_angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle (rad) between unit quaternions [...,4]."""
    return 2 * np.arccos(np.clip(np.abs((a * b).sum(axis=-1)), 0.0, 1.0))

"""Per-environment model fields: what an object's mass makes of them, and how they are written in bulk."""

from __future__ import annotations

from typing import Any

import numpy as np

from wbm.robot.rotations import quat_to_mat
from wbm.scenes.objects import ObjectSet


def body_tables(objects: ObjectSet) -> dict[str, np.ndarray]:
    """Masses and what MuJoCo derives from them for a free body, [O+1,...]; the last row is an absent object.

    With mass m, inertia I about the centre of mass at offset c, and C = [c]x, the free body's mass matrix at the
    reference pose is [[m 1, -m C], [m C, I - m C C]]; its inverse has the blocks 1/m - C I^-1 C and I^-1.
    """
    mass = np.append(objects.mass, 0.1)
    inertia = np.concatenate([objects.inertia, [[1e-4] * 3]])
    com = np.concatenate([objects.com, np.zeros((1, 3))])
    iquat = np.concatenate([objects.iquat, [[1.0, 0, 0, 0]]])
    axes = quat_to_mat(iquat)
    tensor = np.einsum("oij,oj,okj->oik", axes, inertia, axes)
    inverse = np.einsum("oij,oj,okj->oik", axes, 1 / inertia, axes)
    x, y, z = com.T
    zero = np.zeros_like(x)
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    linear = 1 / mass[:, None] - np.einsum("oij,ojk,oki->oi", cross, inverse, cross)
    rotor = tensor - mass[:, None, None] * cross @ cross
    three = np.ones((1, 3))
    diagonal = np.diagonal(inverse, axis1=1, axis2=2)
    return {
        "body_mass": mass,
        "body_inertia": inertia,
        "body_ipos": com,
        "body_iquat": iquat,
        "body_gravcomp": np.append(np.zeros(len(objects)), 1.0),
        "body_invweight0": np.stack([1 / mass, diagonal.mean(axis=1)], axis=1),
        "dof_M0": np.concatenate([mass[:, None] * three, np.diagonal(rotor, axis1=1, axis2=2)], axis=1),
        "dof_invweight0": np.concatenate(
            [linear.mean(axis=1)[:, None] * three, diagonal.mean(axis=1)[:, None] * three], axis=1
        ),
    }


def columns(values: np.ndarray) -> np.ndarray:
    values = np.asarray(values, dtype=float)
    return values[:, None] if values.ndim == 1 else values


def write(target: Any, ids: np.ndarray, columns: slice, values: np.ndarray, component: int | None = None) -> None:
    """`target[ids, columns] = values` for a NumPy array or a torch tensor on any device."""
    if not isinstance(target, np.ndarray):
        import torch

        values = torch.as_tensor(np.ascontiguousarray(values), dtype=target.dtype, device=target.device)  # pyright: ignore[reportAssignmentType]
        ids = torch.as_tensor(ids, device=target.device)  # pyright: ignore[reportAssignmentType]
    if component is None:
        target[ids, columns] = values
    else:
        target[ids, columns, component] = values

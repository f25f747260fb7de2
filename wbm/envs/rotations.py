"""Quaternion algebra on torch tensors; quaternions are w x y z, unit, along the last axis."""

from __future__ import annotations

import torch
from torch import Tensor


def quat_mul(a: Tensor, b: Tensor) -> Tensor:
    """Product [...,4]: rotate by `b` first, then by `a`."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    w = aw * bw - (av * bv).sum(-1, keepdim=True)
    return torch.cat([w, aw * bv + bw * av + torch.linalg.cross(av, bv)], dim=-1)


def quat_conj(q: Tensor) -> Tensor:
    """Inverse of a unit quaternion [...,4]."""
    return torch.cat([q[..., :1], -q[..., 1:]], dim=-1)


def quat_to_mat(q: Tensor) -> Tensor:
    """Rotation matrices [...,3,3]."""
    w, x, y, z = q.unbind(-1)
    xx, yy, zz, xy, xz, yz, wx, wy, wz = x * x, y * y, z * z, x * y, x * z, y * z, w * x, w * y, w * z
    flat = [1 - 2 * (yy + zz), 2 * (xy - wz), 2 * (xz + wy), 2 * (xy + wz), 1 - 2 * (xx + zz), 2 * (yz - wx)]
    flat += [2 * (xz - wy), 2 * (yz + wx), 1 - 2 * (xx + yy)]
    return torch.stack(flat, dim=-1).unflatten(-1, (3, 3))


def quat_exp(rotvec: Tensor) -> Tensor:
    """Quaternion [...,4] of a rotation vector [...,3], rad."""
    angle = rotvec.norm(dim=-1, keepdim=True)
    return torch.cat([torch.cos(angle / 2), 0.5 * torch.sinc(angle / (2 * torch.pi)) * rotvec], dim=-1)


def quat_log(q: Tensor) -> Tensor:
    """Rotation vector [...,3] of the shorter way, rad."""
    q = torch.where(q[..., :1] < 0, -q, q)
    sine = q[..., 1:].norm(dim=-1, keepdim=True)
    scale = torch.where(sine > 1e-6, 2 * torch.atan2(sine, q[..., :1]) / sine.clamp_min(1e-6), 2.0)
    return scale * q[..., 1:]


def quat_turn(a: Tensor, b: Tensor) -> Tensor:
    """Rotation vector [...,3] of the shorter way from `a` to `b`, in the frame of `a`, rad."""
    return quat_log(quat_mul(quat_conj(a), b))


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """Rotate vectors [...,3] by q [...,4]."""
    u = q[..., 1:].expand_as(v)
    t = 2 * torch.linalg.cross(u, v)
    return v + q[..., :1] * t + torch.linalg.cross(u, t)

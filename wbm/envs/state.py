"""What rewards, observations and success read: one set of tensors, refreshed once a step."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

FINGERS = 4
THUMB = 3


@dataclass
class GraspState:
    """Quantities of N environments after a step. Suffix w: world frame, e: grasp frame. Flags are 0.0 or 1.0.

    Shapes: positions [N,3], quaternions [N,4] (w x y z), per-finger values [N,4] in the order index, middle, ring,
    thumb, scalars [N]. Units: m, rad, s, N.
    """

    q: Tensor  # [N,32]
    qd: Tensor  # [N,32]
    ee_pos_w: Tensor
    ee_quat: Tensor
    ee_mat: Tensor  # [N,3,3]
    tips_w: Tensor  # [N,4,3]
    obj_pos_w: Tensor  # centre of the target's bounding box
    obj_quat: Tensor
    obj_mat: Tensor  # [N,3,3]
    obj_lin_vel_w: Tensor
    obj_ang_vel_w: Tensor
    obj_half: Tensor  # half extents of the bounding box, object frame
    tip_to_obj_w: Tensor  # [N,4,3] from each tip to the nearest point of the bounding box
    tip_gap: Tensor  # [N,4]
    centre_gap: Tensor  # grasp frame's origin to the object's centre
    enclosure_gap: Tensor  # object's centre to the segment from thumb tip to the fingers' mean tip
    finger_contact: Tensor  # [N,4]
    finger_force: Tensor  # [N,4]
    palm_contact: Tensor
    palm_force: Tensor
    opposition: Tensor  # 0 to 1: thumb against fingers
    obstacle_force: Tensor  # hand on supports and distractors
    forbidden: Tensor
    height: Tensor  # above the settled height
    drift: Tensor  # horizontal distance from the settled place
    lifted: Tensor
    held: Tensor  # lifted or not, the hand has hold of it
    holding: Tensor  # held above the success height
    slip: Tensor  # speed of the object relative to the hand
    spin: Tensor


def box_gap(points: Tensor, centre: Tensor, mat: Tensor, half: Tensor) -> Tensor:
    """Vectors [N,K,3] (world) from points [N,K,3] to the nearest point of boxes; zero inside.

    Args:
        points: [N,K,3], m.
        centre: box centres [N,3].
        mat: box axes [N,3,3] as columns.
        half: half extents [N,3].
    """
    local = (points - centre.unsqueeze(1)) @ mat
    nearest = torch.maximum(torch.minimum(local, half.unsqueeze(1)), -half.unsqueeze(1))
    return (nearest - local) @ mat.transpose(1, 2)


def segment_gap(point: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Distance [N] of points [N,3] from segments."""
    axis = end - start
    along = ((point - start) * axis).sum(-1, keepdim=True) / axis.square().sum(-1, keepdim=True).clamp_min(1e-9)
    return (start + along.clamp(0.0, 1.0) * axis - point).norm(dim=-1)


def opposition(force_w: Tensor) -> Tensor:
    """How well the thumb's force opposes the fingers' [N]: -cos of the angle between them, 0 where one is missing.

    Args:
        force_w: net contact force of each finger on the object [N,4,3], N.
    """
    fingers, thumb = force_w[:, :THUMB].sum(1), force_w[:, THUMB]
    size = fingers.norm(dim=-1) * thumb.norm(dim=-1)
    return torch.where(size > 1e-4, (-(fingers * thumb).sum(-1) / size.clamp_min(1e-4)).clamp(0.0, 1.0), 0.0)

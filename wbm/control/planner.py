"""Pre-grasps from a target's box and what stands around it: candidates, and which kind of grasp to take.

The grasp frame's z is the approach direction and its x the direction in which fingers and thumb close.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from wbm.robot.proprio import quat_to_mat

GRASPS = ("top_down", "side")

HAND_ROOM = 0.20
"""Height (m) that the hand and wrist need above a top-down grasp frame."""

SIDE_HEIGHT = 0.06
"""A target must rise this far (m) above its support for fingers beside it to clear the surface."""

SIDE_ROOM = 0.10
"""Height (m) of a side grasp frame above the support at which the hand keeps the controller's distance from it."""

SWING = 1.2
"""Range (rad) of the headings from which a side grasp comes."""

AMPLE = 0.05
"""Clearance (m) beyond which more room is worth nothing."""

COMFORT = 0.03
"""What closing a top-down grasp across the heading costs against closing along it, m of the object's width."""

PREFERENCE = 0.75
"""How much of the ample clearance the scene's preferred grasp may lack and still be taken."""


@dataclass(frozen=True)
class Target:
    """What candidates follow from, for B targets.

    Attributes:
        pos: centre of the bounding box [B,3], m; quat: its orientation [B,4] (w x y z); half: half extents [B,3], m.
        width: horizontal extent [B,A] along A world directions, evenly from 0 to pi, m.
        heading: yaw of the robot's base where it will stand [B], rad.
        support, ceiling: heights of the surface below and of what is above [B], m; inf where nothing is.
    """

    pos: Tensor
    quat: Tensor
    half: Tensor
    width: Tensor
    heading: Tensor
    support: Tensor
    ceiling: Tensor

    @property
    def mat(self) -> Tensor:
        """Orientation as matrices [B,3,3]."""
        return quat_to_mat(torch, self.quat)

    @property
    def extent(self) -> Tensor:
        """Half extents along the world's axes [B,3], m."""
        return (self.mat.abs() @ self.half.unsqueeze(-1)).squeeze(-1)


def pregrasp_poses(target: Target, grasp: str, standoff: float, swing: Tensor) -> tuple[Tensor, Tensor]:
    """Positions [B,3] and orientations [B,4] of the grasp frame before the target.

    `top_down`: z down above the target, x where the target is narrow as seen from above, along the heading where it is
    round (of the two directions the one that points away from the base, which is in the wrist's reach). `side`: z level
    at the heading plus `swing` (x level too), so that the fingers wrap around an upright object; at the height of its
    middle or, where the hand would have no room below, as low as it has.

    Args:
        target: B targets.
        grasp: one of `GRASPS`.
        standoff: distance from the box to the grasp frame, m.
        swing: [B] in 0..1, which of the side grasp's headings.
    """
    extent = target.extent
    if grasp == "top_down":
        count = target.width.shape[1]
        angle = torch.arange(count, device=target.width.device) * (math.pi / count)
        cost = target.width + COMFORT * torch.sin(angle - target.heading.unsqueeze(1)) ** 2
        yaw = angle[cost.argmin(1)]
        yaw = torch.where(torch.cos(yaw - target.heading) < 0, yaw + math.pi, yaw)
        c, s, zero = torch.cos(yaw / 2), torch.sin(yaw / 2), torch.zeros_like(yaw)
        pos = target.pos + torch.stack([zero, zero, extent[:, 2] + standoff], -1)
        return pos, torch.stack([zero, c, s, zero], -1)
    yaw = target.heading + SWING * (swing - 0.5)
    c, s = torch.cos(yaw / 2), torch.sin(yaw / 2)
    radius = (extent[:, :2].amax(1) + standoff).unsqueeze(1)
    ahead = torch.stack([torch.cos(yaw), torch.sin(yaw), torch.zeros_like(yaw)], -1)
    # The unturned frame has x to the left, y up and z ahead: (1 + i + j + k) / 2.
    pos = target.pos - radius * ahead
    pos[:, 2] = torch.maximum(pos[:, 2], target.support + SIDE_ROOM)
    return pos, 0.5 * torch.stack([c - s, c - s, c + s, c + s], -1)


def fits(target: Target, grasp: str, standoff: float) -> Tensor:
    """Targets [B] for which a kind of grasp has room, by geometry alone."""
    top = target.pos[:, 2] + target.extent[:, 2]
    if grasp == "top_down":
        return target.ceiling - top > standoff + HAND_ROOM
    return top - target.support > SIDE_HEIGHT


def choose_grasp(clearance: Tensor, preferred: Tensor) -> Tensor:
    """The kind of grasp to take for each of S scenes [S]: the one whose best pre-grasp has the most room.

    Args:
        clearance: [G,S] largest clearance of the reachable, collision-free pre-grasps of a kind, m; -inf: none is.
        preferred: [S] the kind to take unless another has `PREFERENCE` of the ample clearance more; -1: none.

    Returns:
        Index into the kinds, -1 where no pre-grasp was found.
    """
    score = (clearance / AMPLE).clamp(max=1.0)
    kinds = torch.arange(len(clearance), device=clearance.device).unsqueeze(1)
    score = score + PREFERENCE * (kinds == preferred)
    return torch.where(torch.isfinite(clearance).any(0), score.argmax(0), -1)

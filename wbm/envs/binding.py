"""What the environment needs from scenes: one compiled model and how a record is loaded into environments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import mujoco
import torch
from torch import Tensor

from wbm.sim.simulation import Simulation


@dataclass
class SceneTable:
    """Per-scene tensors of S scenes, gathered once; an environment's scene is an index into them.

    Attributes:
        target_pos: settled position of the target's body origin [S,3], m.
        target_quat: settled orientation [S,4].
        box_centre: centre of the target's bounding box in its body frame [S,3], m.
        box_half: half extents of that box [S,3], m.
        support_height: height of the surface that the target settled on [S], m.
        obstacle_type, obstacle_size, obstacle_pos, obstacle_quat: the controller's obstacles [S,M,...].
    """

    target_pos: Tensor
    target_quat: Tensor
    box_centre: Tensor
    box_half: Tensor
    support_height: Tensor
    obstacle_type: Tensor
    obstacle_size: Tensor
    obstacle_pos: Tensor
    obstacle_quat: Tensor

    @property
    def count(self) -> int:
        """S."""
        return len(self.target_pos)


class SceneBinding(Protocol):
    """A model for all scenes, and records that are written into environments of a running simulation."""

    model: mujoco.MjModel
    table: SceneTable
    target_body: int
    target_geoms: tuple[int, ...]
    target_qpos: slice
    target_dofs: slice
    num_distractors: int

    def load(self, sim: Simulation, ids: Tensor, scenes: Tensor) -> None:
        """Write model fields and object poses of `scenes` [K] into environments `ids` [K]; no `set_const`, no `forward`."""
        ...


def target_centre(pos: Tensor, quat_mat: Tensor, box_centre: Tensor) -> Tensor:
    """World position [N,3] of the bounding box's centre."""
    return pos + torch.einsum("nij,nj->ni", quat_mat, box_centre)

"""Joins scenes to running environments: which scenes are played, and what each one means for state and controller."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from wbm.robot.rotations import rotate
from wbm.scenes.bank import SceneBank, obstacle_boxes
from wbm.scenes.model import SceneModel
from wbm.sim.simulation import Simulation

NUM_DIRECTIONS = 180


@dataclass
class SceneTable:
    """Per-scene tensors of S scenes, gathered once; an environment's scene is an index into them.

    Attributes:
        target_pos: settled position of the target's frame [S,3], m: the centre of its bounding box.
        target_quat: settled orientation [S,4].
        box_half: half extents of the bounding box in the target's frame [S,3], m.
        width: horizontal extent of the settled target along `NUM_DIRECTIONS` directions from 0 to pi [S,A], m.
        support_height: height of the surface that the target settled on [S], m.
        ceiling_height: height of what is above it [S], m; inf where nothing is.
        base: base x, y, yaw from which the target is in reach [S,3]: on the straight line from the start pose, facing
            the target, so that a policy which sees the target knows where to stand.
        q_start: collision-free joint positions away from the support [S,32].
        obstacle_type, obstacle_size, obstacle_pos, obstacle_quat: the controller's obstacles [S,M,...]; the target's
            own boxes are unused.
    """

    target_pos: Tensor
    target_quat: Tensor
    box_half: Tensor
    width: Tensor
    support_height: Tensor
    ceiling_height: Tensor
    base: Tensor
    q_start: Tensor
    obstacle_type: Tensor
    obstacle_size: Tensor
    obstacle_pos: Tensor
    obstacle_quat: Tensor

    @property
    def count(self) -> int:
        """S."""
        return len(self.target_pos)


class SceneBinding:
    """A compiled model and the scenes of a bank that are played in it.

    Attributes:
        model: the template `MjModel`.
        scenes: rows of the bank [S]; everything else counts scenes by their place in this list.
        table: per-scene tensors.
        target_geoms: geom ids of the target's slots; target_qpos, target_dofs: its columns in qpos and qvel.
        num_distractors: free bodies besides the target.
    """

    def __init__(self, scene_model: SceneModel, bank: SceneBank, scenes: np.ndarray, device: str = "cpu") -> None:
        if len(scenes) == 0:
            raise ValueError("no scene is left to play: widen teacher.supports or the split, or prepare more assets")
        self.scene_model, self.bank, self.scenes = scene_model, bank, np.asarray(scenes)
        self.model = scene_model.model
        self.target_geoms = tuple(int(g) for g in scene_model.slot_geoms[0])
        start = scene_model.robot_nq
        self.target_qpos, self.target_dofs = slice(start, start + 7), slice(start, start + 6)
        self.num_distractors = scene_model.cfg.num_distractors
        self.table = self._tabulate(device)

    def load(self, sim: Simulation, ids: Tensor, scenes: Tensor, mass_scale: Tensor, friction: Tensor | None) -> None:
        """Write model fields and object poses of `scenes` [K] into environments `ids` [K]; `set_const` is not needed.

        Args:
            mass_scale: factor on the objects' masses [K].
            friction: sliding friction of the objects [K], or None for the template's.
        """
        self.scene_model.load_scene(
            sim.field,
            sim.qpos,
            ids.cpu().numpy(),
            self.bank,
            self.scenes[scenes.cpu().numpy()],
            mass_scale.cpu().numpy(),
            None if friction is None else friction.cpu().numpy(),
        )

    def _tabulate(self, device: str) -> SceneTable:
        bank, rows, objects = self.bank, self.scenes, self.scene_model.objects
        boxes = obstacle_boxes(bank, objects, rows, with_target=False)
        pos, quat = boxes.world(bank.object_pos[rows], bank.object_quat[rows])

        def tensor(values: np.ndarray) -> Tensor:
            return torch.as_tensor(np.ascontiguousarray(values), dtype=torch.float32, device=device)

        return SceneTable(
            target_pos=tensor(bank.object_pos[rows, 0]),
            target_quat=tensor(bank.object_quat[rows, 0]),
            box_half=tensor(objects.half_extent[bank.object[rows, 0]]),
            width=tensor(_widths(objects.points[bank.object[rows, 0]], bank.object_quat[rows, 0])),
            support_height=tensor(bank.surface_z[rows]),
            ceiling_height=tensor(bank.ceiling_z[rows]),
            base=tensor(_stand(bank, rows)),
            q_start=tensor(bank.q_start[rows]),
            obstacle_type=torch.as_tensor(boxes.type, dtype=torch.int32, device=device),
            obstacle_size=tensor(boxes.size),
            obstacle_pos=tensor(pos),
            obstacle_quat=tensor(quat),
        )


def _widths(points: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """Extents [S,A] of surface points [S,P,3] in orientations [S,4] along horizontal directions."""
    angle = np.arange(NUM_DIRECTIONS) * (np.pi / NUM_DIRECTIONS)
    along = rotate(quat[:, None], points)[..., :2] @ np.stack([np.cos(angle), np.sin(angle)])
    return np.ptp(along, axis=1)


def _stand(bank: SceneBank, rows: np.ndarray) -> np.ndarray:
    """Base poses [S,3] as far from the targets as the bank's own, on the lines from the start poses, facing them."""
    target = bank.object_pos[rows, 0, :2]
    reach = np.linalg.norm(target - bank.base_grasp[rows, :2], axis=1, keepdims=True)
    away = target - bank.q_start[rows, :2]
    ahead = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    return np.concatenate([target - reach * ahead, np.arctan2(ahead[:, 1:], ahead[:, :1])], axis=1)

"""Poses of all links and of named frames as live tensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import warp as wp
from torch import Tensor

from wbm.kernels.links import link_poses
from wbm.robot.model import RobotModel
from wbm.robot.proprio import quat_to_mat


class LinkPoses:
    """Forward kinematics of N robots.

    Attributes:
        pos: world positions [N,L,3], m; quat: world orientations [N,L,4] (w x y z). Live: `update` rewrites them.
    """

    def __init__(self, robot: RobotModel, num_envs: int, device: str = "cpu") -> None:
        self.robot, self.num_envs, self.device = robot, num_envs, device

        def upload(values: np.ndarray, dtype: type) -> wp.array:
            kind = np.int32 if dtype is wp.int32 else np.float32
            return wp.array(np.asarray(values).astype(kind), dtype=dtype, device=device)

        self._tree = [
            upload(robot.parent, wp.int32),
            upload(robot.link_pos, wp.vec3),
            upload(robot.link_quat, wp.vec4),
            upload(robot.joint_type, wp.int32),
            upload(robot.joint_axis, wp.vec3),
            upload(robot.joint_index, wp.int32),
        ]
        shape = (num_envs, len(robot.link_names))
        self._q = wp.zeros((num_envs, len(robot.joint_names)), dtype=wp.float32, device=device)
        self._pos, self._quat = (wp.zeros(shape, dtype=t, device=device) for t in (wp.vec3, wp.vec4))
        self._q_in, self.pos, self.quat = wp.to_torch(self._q), wp.to_torch(self._pos), wp.to_torch(self._quat)

    def update(self, q: Tensor) -> None:
        """Recompute `pos` and `quat` at joint positions `q` [N,32]."""
        self._q_in.copy_(q)
        wp.launch(
            link_poses,
            dim=self.num_envs,
            inputs=[*self._tree, self._q],
            outputs=[self._pos, self._quat],
            device=self.device,
        )

    def frames(self, names: Sequence[str]) -> tuple[Tensor, Tensor]:
        """World positions [N,F,3] and orientations [N,F,4] (w x y z) of named frames, as of the last `update`."""
        frames = [self.robot.frames[name] for name in names]
        index = torch.tensor([f.link for f in frames], device=self.device)
        offset = torch.tensor(np.stack([f.pos for f in frames]), dtype=torch.float32, device=self.device)
        turn = torch.tensor(np.stack([f.quat for f in frames]), dtype=torch.float32, device=self.device)
        quat = self.quat[:, index]
        pos = self.pos[:, index] + (quat_to_mat(torch, quat) @ offset.unsqueeze(-1)).squeeze(-1)
        aw, av, bw, bv = quat[..., :1], quat[..., 1:], turn[:, :1], turn[:, 1:].expand_as(quat[..., 1:])
        w = aw * bw - (av * bv).sum(-1, keepdim=True)
        return pos, torch.cat([w, aw * bv + bw * av + torch.linalg.cross(av, bv)], dim=-1)

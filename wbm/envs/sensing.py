"""Reads the simulation into a `GraspState`: object pose, contacts, and what rewards are made of."""

from __future__ import annotations

import torch
from torch import Tensor

from wbm.control.wbc import WholeBodyController
from wbm.envs.binding import SceneBinding
from wbm.envs.config import EnvConfig
from wbm.envs.rotations import quat_conj, quat_mul, quat_to_mat
from wbm.envs.state import THUMB, GraspState, box_gap, opposition, segment_gap
from wbm.robot import joints
from wbm.robot.mjcf import CONTACT_VALUES
from wbm.robot.model import RobotModel
from wbm.sim.simulation import Simulation


class StateReader:
    """Builds the state of N environments; remembers what an episode started from.

    Attributes:
        start_pos: bounding-box centre of the settled target [N,3], world.
        support: height of the surface that it settled on [N].
    """

    STATE = ("_last_pos", "_last_quat", "_fresh")

    def __init__(
        self,
        robot: RobotModel,
        sim: Simulation,
        controller: WholeBodyController,
        binding: SceneBinding,
        cfg: EnvConfig,
        period: float,
    ) -> None:
        self.sim, self.binding, self.cfg, self.period = sim, binding, cfg, period
        names = list(controller.frame_names)
        self.ee = names.index("ee")
        self.tips = torch.tensor([names.index(f"tip_{f}") for f in joints.FINGERS], device=sim.device)
        n, device = sim.num_envs, sim.device
        self.start_pos, self.support = torch.zeros(n, 3, device=device), torch.zeros(n, device=device)
        self.box_half = torch.zeros(n, 3, device=device)
        hand = [f"hand_distractor_{i}" for i in range(binding.num_distractors)]
        robot_all = [f"robot_distractor_{i}" for i in range(binding.num_distractors)]
        rows = [f"finger_{f}" for f in joints.FINGERS]
        rows += ["palm", "support_target", "robot_support", "hand_support", *robot_all, *hand]
        starts = torch.tensor([sim.sensor_slice(name).start for name in rows], device=device)
        self._last_pos, self._last_quat = torch.zeros(n, 3, device=device), torch.zeros(n, 4, device=device)
        self._fresh = torch.ones(n, dtype=torch.bool, device=device)
        # One gather brings all sensors into rows: [N, rows, CONTACT_VALUES].
        self._gather = (starts.unsqueeze(1) + torch.arange(CONTACT_VALUES, device=device)).flatten()
        self._rows, self._d = len(rows), binding.num_distractors

    def begin(self, ids: Tensor, scenes: Tensor) -> None:
        """Remember the settled target of `scenes` [K] for environments `ids` [K]."""
        t = self.binding.table
        self.box_half[ids], self.support[ids] = t.box_half[scenes], t.support_height[scenes]
        self.start_pos[ids] = t.target_pos[scenes]
        self._fresh[ids] = True

    def read(self, frame_pos: Tensor, frame_quat: Tensor) -> GraspState:
        """State from the simulation and the controller's frames [N,F,3], [N,F,4] at the present joints."""
        sim, c = self.sim, self.cfg
        q, qd = sim.qpos[:, : joints.NUM_JOINTS].clone(), sim.qvel[:, : joints.NUM_JOINTS].clone()
        ee_pos, ee_quat, tips = frame_pos[:, self.ee].clone(), frame_quat[:, self.ee].clone(), frame_pos[:, self.tips]
        ee_mat = quat_to_mat(ee_quat)
        pose, twist = sim.qpos[:, self.binding.target_qpos], sim.qvel[:, self.binding.target_dofs]
        obj_quat = pose[:, 3:7].clone()
        obj_mat = quat_to_mat(obj_quat)
        obj_pos, lin_vel = pose[:, :3].clone(), twist[:, :3].clone()
        ang_vel = (obj_mat @ twist[:, 3:6].unsqueeze(-1)).squeeze(-1)  # a free joint's spin is in its own frame

        points = torch.cat([tips, ee_pos.unsqueeze(1)], dim=1)
        gaps = box_gap(points, obj_pos, obj_mat, self.box_half)
        distance = gaps.norm(dim=-1)

        rows = sim.sensordata[:, self._gather].view(-1, self._rows, CONTACT_VALUES)
        found, force = rows[:, :, 0], rows[:, :, 1:4]
        size = force.norm(dim=-1)
        touching = (found > 0).float()
        d = self._d
        hand_obstacle = size[:, 7] + size[:, 8 + d :].sum(1)
        others = (found[:, 6] - found[:, 7]) + (found[:, 8 : 8 + d] - found[:, 8 + d :]).sum(1)
        forbidden = ((others > 0.5) | (hand_obstacle > c.max_hand_force)).float()

        height = obj_pos[:, 2] - self.start_pos[:, 2]
        fingers = touching[:, :4]
        held = ((fingers.sum(1) + touching[:, 4]) >= 2).float()
        lifted = ((height > 0.02) & (found[:, 5] == 0)).float()
        slip, spin = self._relative_motion(ee_pos, ee_quat, ee_mat, obj_pos, obj_quat)
        return GraspState(
            q=q,
            qd=qd,
            ee_pos_w=ee_pos,
            ee_quat=ee_quat,
            ee_mat=ee_mat,
            tips_w=tips,
            obj_pos_w=obj_pos,
            obj_quat=obj_quat,
            obj_mat=obj_mat,
            obj_lin_vel_w=lin_vel,
            obj_ang_vel_w=ang_vel,
            obj_half=self.box_half,
            tip_to_obj_w=gaps[:, :4],
            tip_gap=distance[:, :4],
            centre_gap=distance[:, 4],
            enclosure_gap=segment_gap(obj_pos, tips[:, THUMB], tips[:, :THUMB].mean(1)),
            finger_contact=fingers,
            finger_force=size[:, :4],
            palm_contact=touching[:, 4],
            palm_force=size[:, 4],
            opposition=opposition(force[:, :4]),
            obstacle_force=hand_obstacle,
            forbidden=forbidden,
            height=height,
            drift=(obj_pos - self.start_pos)[:, :2].norm(dim=-1),
            lifted=lifted,
            held=held,
            holding=((height >= c.success_height) & (held > 0)).float(),
            slip=slip,
            spin=spin,
        )

    def _relative_motion(
        self, ee_pos: Tensor, ee_quat: Tensor, ee_mat: Tensor, obj_pos: Tensor, obj_quat: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Speed (m/s) and spin (rad/s) [N] of the object in the grasp frame since the last read; 0 at an
        episode's start.
        """
        pos = ((obj_pos - ee_pos).unsqueeze(1) @ ee_mat).squeeze(1)
        quat = quat_mul(quat_conj(ee_quat), obj_quat)
        slip = (pos - self._last_pos).norm(dim=-1) / self.period
        cosine = (quat * self._last_quat).sum(-1).abs().clamp(max=1.0)
        spin = 2.0 * torch.arccos(cosine) / self.period
        self._last_pos, self._last_quat = pos, quat
        still = self._fresh
        self._fresh = torch.zeros_like(still)
        return slip.masked_fill(still, 0.0), spin.masked_fill(still, 0.0)

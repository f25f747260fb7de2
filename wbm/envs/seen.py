"""What a policy knows of its target when only the camera tells: the pose at the last sight, and how old that is."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
import warp as wp
from torch import Tensor

from wbm.control.links import LinkPoses
from wbm.envs.observations import TeacherObservation
from wbm.envs.rotations import quat_to_mat, rotate
from wbm.envs.seen_config import SeenConfig
from wbm.envs.state import GraspState, box_gap
from wbm.kernels.visibility import count_visible
from wbm.robot import joints
from wbm.robot.model import RobotModel

_NECK = joints.JOINT_NAMES[joints.NECK]
FIELDS: tuple[tuple[str, tuple[str, ...], float], ...] = (
    ("target in the camera's view now", ("seen",), 1.0),
    ("time since it was, as a share of `memory_s`", ("seen_age",), 1.0),
    ("believed object position in the base frame, m", tuple(f"obj_pos_b/{a}" for a in "xyz"), 1.5),
    ("direction of the believed object in the camera's frame", tuple(f"obj_dir_c/{a}" for a in "xyz"), 1.0),
    ("neck joints within their limits, -1 to 1", tuple(f"q/{n}" for n in _NECK), 1.0),
    (
        "velocities of base (in its own frame), arm and neck, m/s and rad/s",
        tuple(f"qd/{joints.JOINT_NAMES[i]}" for i in joints.WBC),
        0.3,
    ),
)
LABELS: tuple[str, ...] = tuple(label for _, labels, _ in FIELDS for label in labels)
"""Labels that follow those of the privileged observation."""

NUM_RAYS = 7


class Sightline:
    """Whether the target is in the camera's view, by a handful of rays an environment.

    In the way are the robot's own primitives and the boxes that the controller avoids: supports and distractors.
    """

    def __init__(
        self,
        robot: RobotModel,
        cfg: SeenConfig,
        obstacles: tuple[wp.array, wp.array, wp.array, wp.array],
        num_envs: int,
        device: str,
    ) -> None:
        """Prepare for N environments.

        Args:
            obstacles: live type [N,M], half size [N,M,3], world position [N,M,3] and orientation [N,M,4].
        """
        self.cfg, self.device = cfg, device
        self.links = LinkPoses(robot, num_envs, device)
        self._poses = [wp.from_torch(self.links.pos, dtype=wp.vec3), wp.from_torch(self.links.quat, dtype=wp.vec4)]
        frame, geoms = robot.frames["camera"], robot.geoms

        def upload(values: list, dtype: type) -> wp.array:
            return wp.array(np.asarray(values, np.int32 if dtype is wp.int32 else np.float32), dtype, device=device)

        self._camera = (frame.link, wp.vec3(*map(float, frame.pos)), wp.vec4(*map(float, frame.quat)))
        tangents = (math.tan(math.radians(a) / 2) for a in (cfg.hfov_deg, cfg.vfov_deg))
        self._reach = wp.vec4(*tangents, cfg.min_range, cfg.max_range)
        self._geoms = [
            upload([g.type for g in geoms], wp.int32),
            upload([robot.link(g.link) for g in geoms], wp.int32),
            upload([g.size for g in geoms], wp.vec3),
            upload([g.pos for g in geoms], wp.vec3),
            upload([g.quat for g in geoms], wp.vec4),
        ]
        self._obstacles = list(obstacles)
        self._target = [wp.zeros(num_envs, dtype=t, device=device) for t in (wp.vec3, wp.vec4, wp.vec3)]
        self._target_in = [wp.to_torch(a) for a in self._target]
        self._near = wp.zeros((num_envs, len(geoms) + obstacles[0].shape[1]), dtype=wp.int16, device=device)
        self._count = wp.zeros(num_envs, dtype=wp.int32, device=device)
        self._seen = wp.to_torch(self._count)

    def look(self, q: Tensor, pos: Tensor, quat: Tensor, half: Tensor) -> Tensor:
        """Whether targets at `pos` [N,3], `quat` [N,4] with half extents [N,3] are seen at joints `q` [N,32]: [N]."""
        self.links.update(q)
        for live, values in zip(self._target_in, (pos, quat, half), strict=True):
            live.copy_(values)
        wp.launch(
            count_visible,
            dim=len(q),
            inputs=[
                *self._poses, *self._camera, self._reach, *self._geoms, *self._obstacles, *self._target, NUM_RAYS,
                self.cfg.spread, self.cfg.rays, self._near,
            ],
            outputs=[self._count],
            device=self.device,
        )  # fmt: skip
        return self._seen >= self.cfg.rays


class Belief:
    """Pose of the target at the last sight, for N environments.

    Attributes:
        pos, quat: believed centre of the bounding box [N,3] and orientation [N,4]; the hint before a first sight.
        sight: policy step of the last sight [N], `NEVER` before the first.
        seen: whether the target is in view now [N].
    """

    STATE = ("pos", "quat", "sight", "seen")
    NEVER = -1_000_000

    def __init__(self, num_envs: int, device: str) -> None:
        self.pos, self.quat = torch.zeros(num_envs, 3, device=device), torch.zeros(num_envs, 4, device=device)
        self.sight = torch.full((num_envs,), self.NEVER, dtype=torch.int64, device=device)
        self.seen = torch.zeros(num_envs, dtype=torch.bool, device=device)

    def begin(self, ids: Tensor, settled: Tensor, u: Tensor, error: float) -> None:
        """Start episodes with a hint: `settled` [K,3] moved on the support by at most `error`, drawn by `u` [K,2]."""
        angle, radius = 2 * math.pi * u[:, 0], error * torch.sqrt(u[:, 1])
        shift = torch.stack([radius * torch.cos(angle), radius * torch.sin(angle), torch.zeros_like(angle)], -1)
        self.pos[ids] = settled + shift
        self.quat[ids] = torch.tensor([1.0, 0.0, 0.0, 0.0], device=u.device)
        self.sight[ids] = self.NEVER

    def update(self, seen: Tensor, s: GraspState, step: Tensor) -> GraspState:
        """Take in what is seen at policy step `step` [N]; the state as it is known then."""
        self.seen.copy_(seen)
        at = seen.unsqueeze(1)
        self.pos.copy_(torch.where(at, s.obj_pos_w, self.pos))
        self.quat.copy_(torch.where(at, s.obj_quat, self.quat))
        self.sight.copy_(torch.where(seen, step, self.sight))
        mat = quat_to_mat(self.quat)
        return replace(
            s,
            obj_pos_w=self.pos,
            obj_quat=self.quat,
            obj_mat=mat,
            obj_lin_vel_w=s.obj_lin_vel_w * at,
            obj_ang_vel_w=s.obj_ang_vel_w * at,
            tip_to_obj_w=box_gap(s.tips_w, self.pos, mat, s.obj_half),
            height=s.height + self.pos[:, 2] - s.obj_pos_w[:, 2],
        )


class SeenObservation(TeacherObservation):
    """The privileged observation's entries, to be given a believed state, with `FIELDS` behind them."""

    def __init__(
        self,
        robot: RobotModel,
        offset_labels: tuple[str, ...],
        action_labels: tuple[str, ...],
        cfg: SeenConfig,
        device: str,
    ) -> None:
        super().__init__(robot, offset_labels, action_labels, device)
        self.cfg = cfg
        self.labels = self.labels + LABELS
        self.more = torch.tensor([s for _, labels, s in FIELDS for _ in labels], device=device)
        self.scale = torch.cat([self.scale, self.more])
        low, high = (
            torch.tensor(v[joints.NECK], dtype=torch.float32, device=device) for v in (robot.q_min, robot.q_max)
        )
        self._neck_middle, self._neck_half = (low + high) / 2, (high - low) / 2
        self._arm_neck = torch.as_tensor(joints.WBC[3:], device=device)

    def extend(self, obs: Tensor, s: GraspState, belief: Belief, age_s: Tensor, pos: Tensor, quat: Tensor) -> Tensor:
        """The whole observation [N,O+E].

        Args:
            obs: the privileged entries [N,O] of the believed state `s`.
            belief: what is believed.
            age_s: time since the last sight [N], s.
            pos, quat: world poses of base and camera [N,2,3], [N,2,4].
        """
        inverse = quat * torch.tensor([1.0, -1.0, -1.0, -1.0], device=quat.device)
        local = rotate(inverse, belief.pos.unsqueeze(1) - pos)
        direction = local[:, 1] / local[:, 1].norm(dim=-1, keepdim=True).clamp_min(1e-6)
        c, sine = torch.cos(s.q[:, 2]), torch.sin(s.q[:, 2])
        vx, vy = s.qd[:, 0], s.qd[:, 1]
        parts = [
            belief.seen.float().unsqueeze(1),
            (age_s / self.cfg.memory_s).clamp(max=1.0).unsqueeze(1),
            local[:, 0],
            direction,
            (s.q[:, joints.NECK] - self._neck_middle) / self._neck_half,
            torch.stack([c * vx + sine * vy, c * vy - sine * vx, s.qd[:, 2]], -1),
            s.qd[:, self._arm_neck],
        ]
        more = torch.cat([p.to(obs) for p in parts], dim=1) * self.more
        return torch.cat([obs, more.clamp_(-5.0, 5.0)], dim=1)

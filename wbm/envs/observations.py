"""The teacher's privileged observation, assembled in one place; every entry has a label."""

from __future__ import annotations

import torch
from torch import Tensor

from wbm.envs.state import GraspState
from wbm.robot import joints
from wbm.robot.model import RobotModel

_XYZ = "xyz"
_ROT = tuple(f"{a}{i}" for a in ("x", "y") for i in _XYZ)  # first two columns of a rotation matrix


def _each(prefix: str, names) -> tuple[str, ...]:
    return tuple(f"{prefix}/{n}" for n in names)


FIELDS: tuple[tuple[str, tuple[str, ...], float], ...] = (
    ("object position in E, m", _each("obj_pos_e", _XYZ), 6.0),
    ("object axes in E", _each("obj_rot6d_e", _ROT), 1.0),
    ("object velocity in E, m/s", _each("obj_lin_vel_e", _XYZ), 1.0),
    ("object angular velocity in E, rad/s", _each("obj_ang_vel_e", _XYZ), 0.2),
    ("half extents of the object's bounding box, m", _each("obj_half", _XYZ), 20.0),
    ("fingertips in E, m", tuple(f"tip_{f}_pos_e/{a}" for f in joints.FINGERS for a in _XYZ), 8.0),
    ("fingertips to the bounding box in E, m", tuple(f"tip_{f}_gap_e/{a}" for f in joints.FINGERS for a in _XYZ), 10.0),
    ("arm and hand joints within their limits, -1 to 1", _each("q", joints.JOINT_NAMES[3:26]), 1.0),
    ("hand joint velocities, rad/s", _each("qd", joints.JOINT_NAMES[joints.HAND]), 0.1),
    ("hand targets minus joints, rad", _each("hand_offset", joints.JOINT_NAMES[joints.HAND]), 2.0),
    ("finger and palm contact flags", _each("contact", (*joints.FINGERS, "palm")), 1.0),
    ("tanh of finger and palm forces over 10 N", _each("force", (*joints.FINGERS, "palm")), 1.0),
    ("up in E", _each("up_e", _XYZ), 1.0),
    ("object above its settled height, m", ("height",), 5.0),
    ("grasp frame above the support, m", ("ee_above_support",), 5.0),
    ("fingertips above the support, m", _each("tip_above_support", joints.FINGERS), 8.0),
    ("controller's nearest obstacle distance, m, at most 0.2", ("obstacle_distance",), 5.0),
)
LABELS: tuple[str, ...] = tuple(label for _, labels, _ in FIELDS for label in labels)
"""Labels of the fixed part; the action term's target offset and the previous action follow."""


class TeacherObservation:
    """Builds observations [N,O]; `labels` names the O entries in order."""

    def __init__(
        self, robot: RobotModel, offset_labels: tuple[str, ...], action_labels: tuple[str, ...], device: str
    ) -> None:
        self.labels = LABELS + offset_labels + _each("prev_action", action_labels)
        scales = [s for _, labels, s in FIELDS for _ in labels] + [1.0] * (len(self.labels) - len(LABELS))
        self.scale = torch.tensor(scales, device=device)
        low = torch.tensor(robot.q_min[3:26], dtype=torch.float32, device=device)
        high = torch.tensor(robot.q_max[3:26], dtype=torch.float32, device=device)
        self.middle, self.half_range = (low + high) / 2, (high - low) / 2

    def __call__(
        self,
        s: GraspState,
        hand_target: Tensor,
        support_height: Tensor,
        obstacle_distance: Tensor,
        offset: Tensor,
        previous: Tensor,
    ) -> Tensor:
        """Assemble one observation.

        Args:
            s: state of N environments.
            hand_target: commanded hand joints [N,16].
            support_height: world height [N] of the surface that the target settled on.
            obstacle_distance: the controller's smallest distance [N].
            offset: the action term's target offset.
            previous: previous action.
        """
        n = len(s.q)
        # All world vectors go to the grasp frame in one product: rows times R_WE.
        vectors = torch.cat(
            [
                (s.obj_pos_w - s.ee_pos_w).unsqueeze(1),
                s.obj_lin_vel_w.unsqueeze(1),
                s.obj_ang_vel_w.unsqueeze(1),
                s.tips_w - s.ee_pos_w.unsqueeze(1),
                s.tip_to_obj_w,
                s.obj_mat[:, :, 0].unsqueeze(1),
                s.obj_mat[:, :, 1].unsqueeze(1),
            ],
            dim=1,
        )
        e = vectors @ s.ee_mat
        parts = [
            e[:, 0],
            e[:, 11:13].reshape(n, 6),
            e[:, 1],
            e[:, 2],
            s.obj_half,
            e[:, 3:7].reshape(n, 12),
            e[:, 7:11].reshape(n, 12),
            (s.q[:, 3:26] - self.middle) / self.half_range,
            s.qd[:, joints.HAND],
            hand_target - s.q[:, joints.HAND],
            s.finger_contact,
            s.palm_contact.unsqueeze(1),
            torch.tanh(0.1 * s.finger_force),
            torch.tanh(0.1 * s.palm_force).unsqueeze(1),
            s.ee_mat[:, 2],
            s.height.unsqueeze(1),
            (s.ee_pos_w[:, 2] - support_height).unsqueeze(1),
            s.tips_w[:, :, 2] - support_height.unsqueeze(1),
            obstacle_distance.clamp(max=0.2).unsqueeze(1),
            offset,
            previous,
        ]
        entries = torch.cat(parts, dim=1)
        return (entries * self.scale[: entries.shape[1]]).clamp_(-5.0, 5.0)

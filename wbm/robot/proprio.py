"""Proprioception of the policy from joint state and frame poses; one code path for NumPy and torch.

Functions take the array namespace `xp` (numpy or torch) first, so that training, the dataset, the exported runtime and
the robot assemble the same numbers. Batched arrays lead with N.
"""

from __future__ import annotations

from typing import Any

from wbm.robot import joints

FRAMES: tuple[str, ...] = ("base", "ee", "camera", "tip_index", "tip_middle", "tip_ring", "tip_thumb")
"""Frames whose world poses `proprioception` needs, in this order."""


def quat_to_mat(xp: Any, quat: Any) -> Any:
    """Rotation matrices [...,3,3] of unit quaternions [...,4] (w x y z)."""
    w, x, y, z = quat[..., 0], quat[..., 1], quat[..., 2], quat[..., 3]
    row0 = xp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1)
    row1 = xp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1)
    row2 = xp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1)
    return xp.stack([row0, row1, row2], -2)


def into_frame(rot_wf: Any, pos_wf: Any, points_w: Any) -> Any:
    """Points [N,P,3] of the world in frame F, given `R_WF` [N,3,3] and `p_WF` [N,3]."""
    return (points_w - pos_wf[:, None, :]) @ rot_wf


def proprioception(xp: Any, q: Any, qd: Any, frame_pos: Any, frame_quat: Any) -> Any:
    """The `proprio` field of the policy schema.

    Args:
        xp: numpy or torch.
        q: joint positions [N,32] (m, rad).
        qd: joint velocities [N,32]; the base's are in the world.
        frame_pos: world positions [N,7,3] of `FRAMES`.
        frame_quat: world quaternions [N,7,4] (w x y z) of `FRAMES`.

    Returns:
        [N, NUM_PROPRIO], laid out as `wbm.robot.schema.PROPRIO_LABELS`.
    """
    num = q.shape[0]
    rot = quat_to_mat(xp, frame_quat)
    rot_wb, rot_we = rot[:, 0], rot[:, 1]
    pos_b = into_frame(rot_wb, frame_pos[:, 0], frame_pos)
    tips_e = into_frame(rot_we, frame_pos[:, 1], frame_pos[:, 3:7])
    to_base = xp.stack([rot_wb[:, :, 0], rot_wb[:, :, 1], rot_wb[:, :, 2]], 1)  # R_BW
    rot_be, rot_bc = to_base @ rot_we, to_base @ rot[:, 2]
    c, s = rot_wb[:, 0, 0], rot_wb[:, 1, 0]
    twist_b = xp.stack([c * qd[:, 0] + s * qd[:, 1], -s * qd[:, 0] + c * qd[:, 1], qd[:, 2]], -1)
    body = slice(joints.BASE.stop, joints.NUM_JOINTS)
    parts = [
        q[:, body],
        twist_b,
        qd[:, body],
        pos_b[:, 1],
        rot_be[:, :, 0],
        rot_be[:, :, 1],
        pos_b[:, 2],
        rot_bc[:, :, 0],
        rot_bc[:, :, 1],
        tips_e.reshape(num, 12),
    ]
    return xp.concatenate(parts, -1)

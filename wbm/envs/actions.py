"""Action terms: what a policy's values in [-1, 1] do to the commanded targets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from wbm.envs.config import ActionConfig
from wbm.envs.rotations import quat_conj, quat_exp, quat_log, quat_mul, quat_turn, rotate
from wbm.robot import joints
from wbm.robot.model import RobotModel

HAND_OPEN = (0.35, 0.0, 0.70, 0.50) * 3 + (0.85, 1.68, 0.68, 1.15)
HAND_CLOSED = (1.20, 0.0, 0.95, 0.60) * 3 + (1.60, 0.35, 0.56, 0.25)
"""Ends of the closure synergy: index, middle, ring, thumb (4 joints each, rad).

Found by fingertip inverse kinematics: on the way from open to closed the fingers' tips move from x = 9 cm to -1 cm and
the thumb's from -6 cm to 0 in the grasp frame, all near z = 3 cm, so that they meet an object at its centre.
"""

NUM_HAND = 16
EE_LABELS = tuple(f"ee_{kind}_{axis}" for kind in ("move", "turn") for axis in "xyz")


class HandAction:
    """Incremental hand joint targets, kept near the joints so that the grip force stays bounded.

    `mix`: target += step * a_joint + closure * (closure_step * a_common + finger_step * a_finger), where `closure`
    is the
    direction from the open to the closed hand, scaled to a largest entry of 1.
    """

    STATE = ("target",)

    def __init__(self, cfg: ActionConfig, robot: RobotModel, num_envs: int, device: str) -> None:
        self.cfg = cfg
        names = joints.JOINT_NAMES[joints.HAND]
        self.labels: tuple[str, ...] = names
        rows = [cfg.hand_step * torch.eye(NUM_HAND)]
        if cfg.hand == "mix":
            closure = torch.tensor(HAND_CLOSED) - torch.tensor(HAND_OPEN)
            closure = closure / closure.abs().max()
            fingers = torch.block_diag(*closure.view(4, 1, 4).unbind(0))
            rows += [cfg.closure_step * closure.unsqueeze(0), cfg.finger_step * fingers]
            self.labels += ("hand_close", *(f"hand_close_{f}" for f in joints.FINGERS))
        self.mix = torch.cat(rows).to(device)  # [A,16]
        self.low = torch.tensor(robot.q_min[joints.HAND], dtype=torch.float32, device=device)
        self.high = torch.tensor(robot.q_max[joints.HAND], dtype=torch.float32, device=device)
        self.target = torch.zeros(num_envs, NUM_HAND, device=device)

    def reset(self, ids: Tensor, q: Tensor) -> None:
        """Hold the hand where it is: `q` [K,32] of environments `ids`."""
        self.target[ids] = q[:, joints.HAND]

    def apply(self, action: Tensor, q: Tensor) -> None:
        """Move `target` [N,16] by `action` [N,A] at joint positions `q` [N,32]."""
        hand = q[:, joints.HAND]
        step = (self.target + action @ self.mix - hand).clamp_(-self.cfg.hand_leash, self.cfg.hand_leash)
        torch.clamp(hand + step, self.low, self.high, out=self.target)


class WbcAction:
    """Equation (5): a relative end-effector target, which the whole-body controller tracks, and hand commands.

    The target pose moves in its own frame by at most `ee_step`, `ee_turn` a step and stays on a leash from the hand.
    """

    STATE = ("pos", "quat")

    def __init__(self, cfg: ActionConfig, robot: RobotModel, num_envs: int, period: float, device: str) -> None:
        self.cfg, self.period = cfg, period
        self.hand = HandAction(cfg, robot, num_envs, device)
        self.labels = EE_LABELS + self.hand.labels
        self.offset_labels = tuple(f"ee_offset_{kind}_{axis}" for kind in ("pos", "rot") for axis in "xyz")
        self.pos = torch.zeros(num_envs, 3, device=device)
        self.quat = torch.zeros(num_envs, 4, device=device)
        self.quat[:, 0] = 1.0
        self.velocity = torch.zeros(num_envs, 3, device=device)

    def reset(self, ids: Tensor, q: Tensor, ee_pos: Tensor, ee_quat: Tensor) -> None:
        """Put the targets of environments `ids` onto the present state (`q` [K,32], `ee_pos` [K,3], `ee_quat`
        [K,4]).
        """
        self.hand.reset(ids, q)
        self.pos[ids], self.quat[ids] = ee_pos, ee_quat

    def apply(self, action: Tensor, q: Tensor, ee_pos: Tensor, ee_quat: Tensor) -> None:
        """Move the targets by `action` [N,A], already clipped."""
        c = self.cfg
        self.hand.apply(action[:, 6:], q)
        shift = self.pos + rotate(self.quat, c.ee_step * action[:, 0:3]) - ee_pos
        pos = ee_pos + _shorten(shift, c.ee_leash)
        self.velocity.copy_((pos - self.pos) * (c.feed_forward / self.period))
        self.pos.copy_(pos)
        turned = quat_mul(self.quat, quat_exp(c.ee_turn * action[:, 3:6]))
        turn = _shorten(quat_turn(ee_quat, turned), c.ee_turn_leash)
        quat = quat_mul(ee_quat, quat_exp(turn))
        self.quat.copy_(quat / quat.norm(dim=-1, keepdim=True))

    def offset(self, q: Tensor, ee_pos: Tensor, ee_quat: Tensor) -> Tensor:
        """Target pose relative to the hand, in the grasp frame [N,6]: m and rad, scaled to order one."""
        inverse = quat_conj(ee_quat)
        return torch.cat(
            [20.0 * rotate(inverse, self.pos - ee_pos), 3.0 * quat_log(quat_mul(inverse, self.quat))], dim=-1
        )


class JointAction:
    """The joint-space ablation: 32 incremental joint targets, base increments in the base frame."""

    STATE = ("target",)

    def __init__(self, cfg: ActionConfig, robot: RobotModel, num_envs: int, period: float, device: str) -> None:
        self.cfg = cfg
        self.hand = HandAction(replace(cfg, hand="joints"), robot, num_envs, device)
        self.labels = joints.JOINT_NAMES
        self.offset_labels = tuple(f"offset_{joints.JOINT_NAMES[i]}" for i in joints.WBC)
        kinds = torch.tensor([0] * 3 + [1] * 7 + [2] * 6, device=device)
        self.step = torch.tensor(cfg.body_step, device=device)[kinds]
        self.leash = torch.tensor(cfg.body_leash, device=device)[kinds]
        self.body = torch.as_tensor(joints.WBC, device=device)
        self.low = torch.tensor(robot.q_min[joints.WBC], dtype=torch.float32, device=device)
        self.high = torch.tensor(robot.q_max[joints.WBC], dtype=torch.float32, device=device)
        self.target = torch.zeros(num_envs, len(joints.WBC), device=device)

    def reset(self, ids: Tensor, q: Tensor, ee_pos: Tensor, ee_quat: Tensor) -> None:
        """Hold all joints where they are."""
        self.hand.reset(ids, q)
        self.target[ids] = q[:, self.body]

    def apply(self, action: Tensor, q: Tensor, ee_pos: Tensor, ee_quat: Tensor) -> None:
        """Move the targets by `action` [N,32], already clipped."""
        self.hand.apply(action[:, joints.HAND], q)
        step = action[:, self.body] * self.step
        c, s = torch.cos(q[:, 2]), torch.sin(q[:, 2])
        x, y = step[:, 0].clone(), step[:, 1].clone()
        step[:, 0], step[:, 1] = c * x - s * y, s * x + c * y
        at = q[:, self.body]
        moved = at + torch.maximum(torch.minimum(self.target + step - at, self.leash), -self.leash)
        torch.clamp(moved, self.low, self.high, out=self.target)

    def offset(self, q: Tensor, ee_pos: Tensor, ee_quat: Tensor) -> Tensor:
        """Body joint targets minus joints [N,16], in leashes."""
        return (self.target - q[:, self.body]) / self.leash


def make_action(
    cfg: ActionConfig, robot: RobotModel, num_envs: int, period: float, device: str
) -> WbcAction | JointAction:
    """The action term that `cfg.term` names, for a policy period of `period` seconds."""
    return (WbcAction if cfg.term == "wbc" else JointAction)(cfg, robot, num_envs, period, device)


def _shorten(v: Tensor, limit: float) -> Tensor:
    """Vectors [N,3] no longer than `limit`."""
    return v * (limit / v.norm(dim=-1, keepdim=True).clamp_min(1e-9)).clamp(max=1.0)


def joint_limits(robot: RobotModel, device: str) -> tuple[Tensor, Tensor]:
    """Lower and upper joint limits [32] as tensors."""
    assert len(robot.q_min) == joints.NUM_JOINTS
    return (
        torch.tensor(np.asarray(robot.q_min), dtype=torch.float32, device=device),
        torch.tensor(np.asarray(robot.q_max), dtype=torch.float32, device=device),
    )

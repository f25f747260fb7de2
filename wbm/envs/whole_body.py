"""The whole-body episode: from a start pose through free space to a pre-grasp, then the grasp."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from wbm.control.base_path import BaseMap, Obstacles, base_path
from wbm.envs.grasp_env import AT_PREGRASP, FULL, SCATTERED, GraspEnv
from wbm.envs.rotations import quat_conj, quat_exp, quat_mul, quat_to_mat, quat_turn, rotate
from wbm.robot import joints

FREE, CONTACT = 0, 1
ASIDE = (2.0, 0.2)  # metres to stay back along the approach direction per metre and radian off its line
LINE = (0.01, 0.05)  # m and rad that count as on it
NEAR_PREGRASP = (0.012, 0.08)  # m and rad at which the pre-grasp counts as reached, with the joints nearly at rest
GOOD_PREGRASP = (0.02, 0.15)  # and after `LINGER` s of trying, in whatever motion
LINGER = 0.8
CALM = (0.05, 0.15)  # m/s of the base and rad/s of arm joints that count as rest
BEGUN = (0.05, 0.5)  # m and rad off the pre-grasp's line within which a hand that is ahead of it is at work
LOST = 0.15  # m off the line or behind the pre-grasp from which it has to come anew
SEEN_FROM = 0.3  # m from the pre-grasp at which the hand turns to how the object lies, which the camera sees by then
TURN_AHEAD = 0.25  # s by which the target's orientation leads the hand
MAX_CORNERS = 12
NEAR_CORNER = 0.15  # m at which a corner of the base's way counts as passed
CARROT = 1.0  # m ahead of the base at which its target moves along the way
DETOUR_WEIGHTS = {"ee_position": 0.0, "ee_rotation": 0.0, "posture": 0.1, "posture_base": 1.0}
APPROACH_WEIGHTS = {"posture": 0.05, "posture_base": 0.2}
"""On the way to the pre-grasp; the body ends where the pre-grasp was solved, not just the hand."""


class WholeBodyEnv(GraspEnv):
    """`GraspEnv` whose episodes start far away: the controller brings the hand to a pre-grasp, then the policy
    takes over.

    In free space the end-effector target moves at a bounded speed to the planner's own pre-grasp, which is fixed in the
    world (a target that followed the base would make the controller chase itself); while the hand is off the line along
    which it will approach, the target stays back on that line. From afar a hand that will come from above closes along
    the base's heading, and turns to how the object lies only where that can be seen. The posture is the pre-grasp's,
    base included. Where the hand goes next so follows from where it is and what it sees, with nothing that a student
    could not know.

    Where obstacles block the straight way of the base, the base first follows the planner's corners with the arm held
    as it is. A teacher's action counts from the moment the pre-grasp is reached. `step_targets` moves through both
    phases alike.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Arguments as `GraspEnv`."""
        super().__init__(*args, **kwargs)
        n, device = self.num_envs, self.device
        self._near, self._scatter = self.columns.add("near"), self.columns.add("scatter")
        self._contact_since, self._close_since = (torch.zeros(n, dtype=torch.int64, device=device) for _ in range(2))
        self._goal_q = torch.zeros(n, joints.NUM_JOINTS, device=device)
        self._goal_pos = torch.zeros(n, 3, device=device)
        self._goal_quat, self._far_quat = torch.zeros(n, 4, device=device), torch.zeros(n, 4, device=device)
        self._corner = torch.zeros(n, MAX_CORNERS, 2, device=device)
        self._corners, self._corner_at = (torch.zeros(n, dtype=torch.int64, device=device) for _ in range(2))
        self._start_q = torch.zeros(n, joints.NUM_JOINTS, device=device)
        names: list[str] = list(self.controller.weight_names)
        weights = wp.to_torch(self.controller.weights)
        self._weights = []
        for name, detour in DETOUR_WEIGHTS.items():
            column = weights[:, names.index(name)]
            usual = column[0].item()
            self._weights.append((column, detour, APPROACH_WEIGHTS.get(name, usual), usual))

    @property
    def limit_steps(self) -> int:
        """Policy steps of approach and grasp together."""
        return self.max_steps + round(self.cfg.approach_s / self.period)

    def _start_joints(self, ids: Tensor, scenes: Tensor, u: Tensor) -> Tensor:
        near = u[:, self._near].squeeze(1) < self.cfg.pregrasp_share
        own = self._fixed_neck(self.starts.first(scenes))
        goal = torch.where(near.unsqueeze(1), super()._start_joints(ids, scenes, u), own)
        self._goal_q[ids] = goal
        scattered = ~near & (u[:, self._near].squeeze(1) < self.cfg.pregrasp_share + self.cfg.scatter_share)
        self.started[ids] = torch.where(near, AT_PREGRASP, torch.where(scattered, SCATTERED, FULL))
        self.phase[ids] = torch.where(near, CONTACT, FREE).to(torch.uint8)
        self._contact_since[ids], self._close_since[ids] = 0, -1
        away = self.binding.table.q_start[scenes].to(goal)
        if len(self.starts.scattered):
            count = self.starts.scattered.shape[1]
            pick = (u[:, self._scatter].squeeze(1) * count).long()
            away = torch.where(scattered.unsqueeze(1), self.starts.scattered[scenes, pick], away)
        away[:, joints.HAND] = goal[:, joints.HAND]
        start = torch.where(near.unsqueeze(1), goal, away)
        self._corners[ids], self._corner_at[ids], self._start_q[ids] = 0, 0, start
        far = ~near
        self._plan(ids[far], scenes[far], start[far], goal[far])
        return start

    def _plan(self, ids: Tensor, scenes: Tensor, start: Tensor, goal: Tensor) -> None:
        """Corners of the base's way from `start` to `goal` [K,32]; none where the straight one is free."""
        t = self.binding.table
        for env, scene, a, b in zip(
            ids.tolist(), scenes.tolist(), start.cpu().numpy(), goal.cpu().numpy(), strict=True
        ):
            rows = (t.obstacle_type, t.obstacle_size, t.obstacle_pos, t.obstacle_quat)
            there = BaseMap(self.robot, a, float(b[2]), Obstacles(*(r[scene].cpu().numpy() for r in rows)))
            corners = base_path(there, a[:2].astype(float), b[:2].astype(float))[:MAX_CORNERS]
            self._corner[env, : len(corners)] = torch.as_tensor(corners, dtype=torch.float32)
            self._corners[env] = len(corners)

    def _begin(self, ids: Tensor, episodes: np.ndarray) -> None:
        super()._begin(ids, episodes)
        # The pre-grasp's pose in the world, by the same kinematics that will be asked to reach it.
        keep = self.q_in.clone()
        self.q_in[ids] = self._goal_q[ids].to(self.q_in)
        self.controller.forward_kinematics()
        ee = self.reader.ee
        self._goal_pos[ids], self._goal_quat[ids] = self.frame_pos[ids, ee], self.frame_quat[ids, ee]
        self._far_quat[ids] = _along_heading(self._goal_quat[ids], self._goal_q[ids, 2])
        self.q_in.copy_(keep)
        self.controller.forward_kinematics()
        self.posture[ids] = self._goal_q[ids][:, self._body].to(self.posture)

    def _contact_steps(self) -> Tensor:
        return torch.where(self.phase == CONTACT, self.elapsed - self._contact_since, 0)

    def _time_up(self) -> Tensor:
        return (self._contact_steps() >= self.max_steps) | (self.elapsed >= self.limit_steps)

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, dict]:
        """One policy step with a teacher's action [N,A], which counts in the contact-rich phase only."""
        action = action.clamp(-self.cfg.action.limit, self.cfg.action.limit)
        s = self.state
        self._arrive()
        contact = (self.phase == CONTACT).unsqueeze(1)
        action = action * contact
        self.action.apply(action, s.q, s.ee_pos_w, s.ee_quat)
        self._follow()
        self._approach(~contact.squeeze(1))
        self._command()
        return self._advance(action)

    def resume(self, which: Tensor) -> None:
        """Go on in environments `which` [N] as if what was executed had been this environment's own commands.

        Where noise was added, or another policy acted, the memories of the controller and of the action term hold what
        they would have done. Here the controller starts from the measured joints, and the targets of hand and fingers
        are those that were executed, so that the next command follows from the present state alone.
        """
        if not bool(which.any()):
            return
        s, c, row = self.state, self._controller_state, which.unsqueeze(1)
        executed = self.sim.ctrl[:, : joints.NUM_JOINTS].float()
        # The command leads the new target by the actuators' delay; the target must not lead the joints by a step more.
        q, qd = s.q[:, self._body].float(), s.qd[:, self._body].float()
        c["q_target"].copy_(torch.where(row, q - self.controller.cfg.dt * qd, c["q_target"]))
        c["qd"].copy_(torch.where(row, qd, c["qd"]))
        self.q_in.copy_(executed)
        self.controller.forward_kinematics()
        at, term = self.reader.ee, self.action
        term.pos.copy_(torch.where(row, self.frame_pos[:, at], term.pos))
        term.quat.copy_(torch.where(row, self.frame_quat[:, at], term.quat))
        term.hand.target.copy_(torch.where(row, executed[:, joints.HAND], term.hand.target))
        self.ctrl[:, joints.HAND] = torch.where(row, executed[:, joints.HAND], self.ctrl[:, joints.HAND].float())
        self._refresh()

    def find_phase(self) -> None:
        """Set the phase by where the hand is, for episodes in which another policy acts and nobody kept track of it."""
        s = self.state
        off = rotate(quat_conj(self._goal_quat), s.ee_pos_w - self._goal_pos)
        aside, ahead = off[:, :2].norm(dim=-1), off[:, 2]
        _, angle = self._errors(self._goal_pos, self._goal_quat)
        lost = (s.lifted == 0) & ((ahead < -LOST) | (aside > LOST))
        begun = (ahead > -GOOD_PREGRASP[0]) & (aside < BEGUN[0]) & (angle < BEGUN[1]) & (self.phase == FREE) & ~lost
        self._enter_contact(begun)
        self.phase[lost] = FREE

    def _enter_contact(self, which: Tensor) -> None:
        """Begin the contact-rich phase in environments `which` (indices or flags), with the posture that they have."""
        self.phase[which], self._contact_since[which] = CONTACT, self.elapsed[which]
        self.posture[which] = self.state.q[which][:, self._body].to(self.posture)

    def _errors(self, pos: Tensor, quat: Tensor) -> tuple[Tensor, Tensor]:
        s = self.state
        return (pos - s.ee_pos_w).norm(dim=-1), quat_turn(s.ee_quat, quat).norm(dim=-1)

    def _waypoint(self) -> Tensor:
        """Where the hand's target goes next [N,3]: to the pre-grasp, behind it while it is off the line of approach.

        The target itself tells how far off: the hand that follows it late would feed its lag back.
        """
        ahead = rotate(self._goal_quat, torch.tensor([0.0, 0.0, 1.0], device=self.device).expand(self.num_envs, 3))
        off = self.action.pos - self._goal_pos
        aside = (off - (off * ahead).sum(-1, keepdim=True) * ahead).norm(dim=-1)
        angle = quat_turn(self.action.quat, self._goal_quat).norm(dim=-1)
        back = ASIDE[0] * (aside - LINE[0]).clamp(min=0.0) + ASIDE[1] * (angle - LINE[1]).clamp(min=0.0)
        return self._goal_pos - back.clamp(max=self.cfg.approach_back).unsqueeze(1) * ahead

    def _arrive(self) -> None:
        """Move on to the contact-rich phase where the hand has arrived."""
        free, s = self.phase == FREE, self.state
        distance, angle = self._errors(self._goal_pos, self._goal_quat)
        good = (distance < GOOD_PREGRASP[0]) & (angle < GOOD_PREGRASP[1])
        self._close_since.copy_(
            torch.where(good, torch.where(self._close_since < 0, self.elapsed, self._close_since), -1)
        )
        calm = (s.qd[:, :2].norm(dim=-1) < CALM[0]) & (s.qd[:, joints.ARM].abs().amax(1) < CALM[1])
        settled = calm & (distance < NEAR_PREGRASP[0]) & (angle < NEAR_PREGRASP[1])
        settled |= good & ((self.elapsed - self._close_since) * self.period > LINGER)
        ids = (free & settled).nonzero().squeeze(1)
        if len(ids):
            self._enter_contact(ids)
            self.action.reset(ids, s.q[ids].float(), s.ee_pos_w[ids], s.ee_quat[ids])

    def _approach(self, free: Tensor) -> None:
        """Lead the targets of the environments in free space towards waypoint and pre-grasp."""
        c, s, term = self.cfg, self.state, self.action
        goal = self._waypoint()
        speed = (c.approach_rate * (goal - term.pos).norm(dim=-1, keepdim=True)).clamp(max=c.approach_speed)
        ahead = _towards(term.pos, goal, speed * self.period)
        ahead = s.ee_pos_w + _towards(torch.zeros_like(ahead), ahead - s.ee_pos_w, c.approach_leash)
        near = (s.ee_pos_w - self._goal_pos).norm(dim=-1, keepdim=True) < SEEN_FROM
        turn = quat_turn(s.ee_quat, torch.where(near, self._goal_quat, self._far_quat))
        turned = quat_mul(s.ee_quat, quat_exp(_towards(torch.zeros_like(turn), turn, c.approach_turn * TURN_AHEAD)))
        keep = (~free).unsqueeze(1)
        term.velocity.copy_(torch.where(keep, term.velocity, (ahead - term.pos) / self.period))
        term.pos.copy_(torch.where(keep, term.pos, ahead))
        term.quat.copy_(torch.where(keep, term.quat, turned / turned.norm(dim=-1, keepdim=True)))
        hand = self._goal_q[:, joints.HAND].to(term.hand.target)
        term.hand.target.copy_(torch.where(keep, term.hand.target, hand))

    def _follow(self) -> None:
        """Lead the base along its corners; where none is left, the hand's own approach begins from where it is."""
        s, at = self.state, self._corner_at
        on = (self.phase == FREE) & (at < self._corners)
        ids = torch.arange(self.num_envs, device=self.device)
        base = s.q[:, :2].float()
        away = self._corner[ids, at.clamp(max=MAX_CORNERS - 1)] - base
        distance = away.norm(dim=-1, keepdim=True)
        at += (on & (distance.squeeze(1) < NEAR_CORNER)).long()
        ended = (on & (at >= self._corners)).nonzero().squeeze(1)
        on &= at < self._corners
        row = on.unsqueeze(1)
        for weight, detour, approach, usual in self._weights:
            weight.copy_(torch.where(on, detour, torch.where(self.phase == FREE, approach, usual)))
        way = self._start_q[:, self._body].clone()
        way[:, :2] = base + away * (CARROT / distance.clamp_min(1e-6))
        way[:, 2] = self._goal_q[:, 2]
        goal = self._goal_q[:, self._body].to(self.posture)
        self.posture.copy_(
            torch.where(
                row,
                way.to(self.posture),
                torch.where(((self.phase == FREE) & (self._corners > 0)).unsqueeze(1), goal, self.posture),
            )
        )
        hold = torch.cat([ids[on], ended])
        if len(hold):
            self.action.reset(hold, s.q[hold].float(), s.ee_pos_w[hold], s.ee_quat[hold])


def _towards(start: Tensor, goal: Tensor, step: float | Tensor) -> Tensor:
    """Points [N,3] at most `step` (a number or [N,1]) from `start` on the way to `goal`."""
    delta = goal - start
    return start + delta * (step / delta.norm(dim=-1, keepdim=True).clamp_min(1e-9)).clamp(max=1.0)


def _along_heading(quat: Tensor, heading: Tensor) -> Tensor:
    """Grasp frames [K,4] that look down turned to close along a heading [K]; the others as they are."""
    axes = quat_to_mat(quat)
    down = axes[:, 2, 2] < -0.7
    turn = heading - torch.atan2(axes[:, 1, 0], axes[:, 0, 0])
    turn = torch.atan2(torch.sin(turn), torch.cos(turn)) * down
    zero = torch.zeros_like(turn)
    return quat_mul(torch.stack([torch.cos(turn / 2), zero, zero, torch.sin(turn / 2)], -1), quat)

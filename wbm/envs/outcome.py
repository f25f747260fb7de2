"""Success and the reasons of failure, tracked over an episode."""

from __future__ import annotations

import torch
from torch import Tensor

from wbm.envs.config import EnvConfig
from wbm.envs.state import GraspState

RUNNING, SUCCESS, TIMEOUT, DROPPED, FORBIDDEN, OUT_OF_REACH, UNSTABLE = range(7)
REASONS = ("running", "success", "timeout", "dropped", "forbidden_collision", "object_out_of_reach", "unstable")


class Outcome:
    """Tracks N episodes. `code` [N] is one of the constants above; `hold` [N] counts steps of holding in a row."""

    STATE = ("hold", "best_hold", "peak", "collided", "code")

    def __init__(self, cfg: EnvConfig, period: float, num_envs: int, device: str) -> None:
        self.cfg = cfg
        self.hold_steps = max(1, round(cfg.success_hold_s / period))
        self.finish_steps = round(cfg.finish_s / period)
        self.hold = torch.zeros(num_envs, dtype=torch.int32, device=device)
        self.best_hold = torch.zeros_like(self.hold)
        self.peak = torch.zeros(num_envs, device=device)
        self.collided = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self.code = torch.zeros(num_envs, dtype=torch.int8, device=device)

    def reset(self, ids: Tensor) -> None:
        """Forget environments `ids`."""
        for item in (self.hold, self.best_hold, self.peak, self.collided, self.code):
            item[ids] = 0

    def update(self, s: GraspState, start_pos_w: Tensor, time_up: Tensor) -> Tensor:
        """Judge one step; returns `code` [N], `RUNNING` where the episode goes on.

        Success is a lift of at least `success_height`, held in contact for at least `success_hold_s`, without a
        forbidden
        contact, and still held when the episode ends.

        Args:
            s: state after the step.
            start_pos_w: settled position of the target [N,3].
            time_up: episodes whose time has run out [N].
        """
        c = self.cfg
        self.hold.add_(1).mul_(s.holding > 0)
        torch.maximum(self.best_hold, self.hold, out=self.best_hold)
        torch.maximum(self.peak, s.height, out=self.peak)
        forbidden = s.forbidden > 0
        self.collided |= forbidden
        away = (s.obj_pos_w - start_pos_w)[:, :2].norm(dim=-1)
        speed = s.obj_lin_vel_w.norm(dim=-1)
        finite = torch.isfinite(speed + s.q.sum(-1) + s.qd.sum(-1))
        finished = time_up | (self.hold >= self.finish_steps) if self.finish_steps > 0 else time_up
        achieved = (self.best_hold >= self.hold_steps) & (s.holding > 0)
        dropped = (self.peak > 0.05) & (s.height < c.drop_height) & (s.held == 0)
        code = torch.zeros_like(self.code)
        # Later lines overrule earlier ones.
        code[finished] = TIMEOUT
        code[finished & achieved] = SUCCESS
        code[(away > c.reach_radius) | (s.height < -c.fall_height)] = OUT_OF_REACH
        code[dropped] = DROPPED
        if c.end_on_collision:
            code[forbidden] = FORBIDDEN
        code[finished & self.collided] = FORBIDDEN
        code[~finite | (speed > c.max_speed)] = UNSTABLE
        self.code.copy_(code)
        return code

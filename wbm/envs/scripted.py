"""The scripted baseline: move onto the target, close the synergy, lift; a floor for the teachers."""

from __future__ import annotations

import torch
from torch import Tensor

from wbm.envs.config import ActionConfig
from wbm.robot import joints


class ScriptedGrasp:
    """Maps a teacher's observation [N,O] and the time to an action [N,A] of the `wbc` term with the `mix` hand.

    Args:
        obs_labels, obs_scale: labels and scales of the observation (`TeacherObservation`).
        cfg: the action's settings.
        reach, close: shares of the episode at which reaching ends and lifting begins.
        depth: least height of the grasp frame above the support, m.
        lift: upward action while lifting.

    Raises:
        ValueError: the action term is not `wbc` with the `mix` hand.
    """

    def __init__(
        self,
        obs_labels: tuple[str, ...],
        obs_scale: Tensor,
        cfg: ActionConfig,
        reach: float = 0.28,
        close: float = 0.45,
        depth: float = 0.05,
        lift: float = 0.6,
    ) -> None:
        if cfg.term != "wbc" or cfg.hand != "mix":
            raise ValueError("the scripted grasp needs env.action.term=wbc and env.action.hand=mix")
        index = {label: i for i, label in enumerate(obs_labels)}
        self.scale, self.cfg = obs_scale, cfg
        self.object = [index[f"obj_pos_e/{a}"] for a in "xyz"]
        self.up = [index[f"up_e/{a}"] for a in "xyz"]
        self.above = index["ee_above_support"]
        self.phases, self.depth, self.lift = (reach, close), depth, lift
        self.size = 6 + 16 + 1 + len(joints.FINGERS)

    def __call__(self, obs: Tensor, time: Tensor) -> Tensor:
        """Actions [N,A] for observations [N,O] at `time` [N], the share of the episode that has passed."""
        x = obs / self.scale
        up = x[:, self.up]
        action = torch.zeros(len(obs), self.size, device=obs.device)
        # Go to the object's centre, but not below the least height above the support.
        goal = x[:, self.object]
        sink = (self.depth - (x[:, self.above] + (goal * up).sum(-1))).clamp(min=0.0)
        goal = goal + sink.unsqueeze(1) * up
        reaching, lifting = time < self.phases[0], time >= self.phases[1]
        move = torch.where(reaching.unsqueeze(1), goal / self.cfg.ee_step * 0.5, self.lift * up * lifting.unsqueeze(1))
        action[:, :3] = move.clamp(-1.0, 1.0)
        action[:, 6 + 16] = (~reaching).float()
        return action

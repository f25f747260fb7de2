"""The whole-body episode for a policy that knows its target's pose only while the camera sees it."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from wbm.envs.grasp_env import GraspEnv
from wbm.envs.seen import Belief, SeenObservation, Sightline
from wbm.envs.state import GraspState
from wbm.envs.whole_body import CONTACT, WholeBodyEnv

_FRAMES = ["base", "camera"]


class SeenEnv(WholeBodyEnv):
    """`WholeBodyEnv` under partial observability: policy, gaze and approach are led by the last seen pose.

    Before a first sight that is a hint of the target's place. With the `wbc` term the controller leads the hand to the
    pre-grasp, which lies relative to the believed target, before the policy takes over. With the `joint` term there is
    no controller: the policy gives all 32 joint targets from the start pose on, for the same total time. Rewards and
    success are judged by the true state.

    Attributes:
        belief: the last seen pose of every environment.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Arguments as `GraspEnv`."""
        super().__init__(*args, **kwargs)
        c, n, device = self.controller, self.num_envs, self.device
        self._hint = self.columns.add("hint", 2)
        self.guided = self.cfg.action.term == "wbc"
        obstacles = (c.obstacle_type, c.obstacle_size, c.obstacle_pos, c.obstacle_quat)
        self.sightline = Sightline(self.robot, self.cfg.seen, obstacles, n, device)
        self.belief = Belief(n, device)
        self.observe = SeenObservation(self.robot, self.action.offset_labels, self.action.labels, self.cfg.seen, device)
        self._settled_goal = torch.zeros_like(self._goal_pos)

    def _live(self) -> dict[str, Tensor]:
        own = {f"belief.{name}": getattr(self.belief, name) for name in Belief.STATE}
        own |= {name: getattr(self, name) for name in self._EPISODE}
        return super()._live() | own

    _EPISODE = ("phase", "started", "_contact_since", "_close_since", "_goal_q", "_goal_pos",
                "_goal_quat", "_far_quat", "_start_q", "_settled_goal", "_corner", "_corners",
                "_corner_at")  # fmt: skip

    def _plan(self, ids: Tensor, scenes: Tensor, start: Tensor, goal: Tensor) -> None:
        if self.guided:
            super()._plan(ids, scenes, start, goal)

    def _begin(self, ids: Tensor, episodes: np.ndarray) -> None:
        super()._begin(ids, episodes)
        self._settled_goal[ids] = self._goal_pos[ids]
        u = self._uniforms(episodes)[:, self._hint]
        self.belief.begin(ids, self.reader.start_pos[ids], u, self.cfg.seen.hint_error)
        if not self.guided:
            self.phase[ids] = CONTACT

    def _contact_steps(self) -> Tensor:
        if self.guided:
            return super()._contact_steps()
        return self.elapsed * (self.max_steps / self.limit_steps)  # the whole episode is the policy's

    def _known(self, s: GraspState) -> GraspState:
        seen = self.sightline.look(s.q, s.obj_pos_w, s.obj_quat, s.obj_half)
        return self.belief.update(seen, s, self.elapsed)

    def _refresh(self) -> None:
        super()._refresh()
        age = (self.elapsed - self.belief.sight) * self.period
        pos, quat = self.sightline.links.frames(_FRAMES)
        assert isinstance(self.observe, SeenObservation)
        self.obs = self.observe.extend(self.obs, self.known, self.belief, age, pos, quat)

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, dict]:
        """One policy step with an action [N,A]; with the `wbc` term it counts from the pre-grasp on."""
        if not self.guided:
            return GraspEnv.step(self, action)
        # The pre-grasp stays in its place relative to the target, wherever that is believed to be.
        self._goal_pos.copy_(self._settled_goal + self.belief.pos - self.reader.start_pos)
        return super().step(action)

"""The approach of a whole-body episode: a reference from the start to the pre-grasp that the controller follows."""

from __future__ import annotations

import torch
from torch import Tensor

from wbm.robot import joints
from wbm.robot.model import RobotModel

SPEED_SHARE = 0.45  # of the joints' speed limits, which leaves the controller room to dodge
WAIT_DISTANCE = 0.12  # m that the hand may lag behind before the reference waits


class Approach:
    """Interpolates joint positions between a start and a pre-grasp, both fixed in the world.

    `q(t) = start + s(t) (goal - start)` with the smooth step `s = 3 t^2 - 2 t^3`. The controller tracks the hand's pose
    along it, has the reference as posture, and avoids obstacles. The reference waits for a hand that lags behind.

    Attributes:
        share: how far along each environment is, 0 to 1 [N].
    """

    STATE = ("start", "goal", "share", "rate")

    def __init__(self, robot: RobotModel, num_envs: int, period: float, device: str) -> None:
        self.period = period
        self.speed = torch.tensor(robot.qd_max * SPEED_SHARE, dtype=torch.float32, device=device)
        self.start = torch.zeros(num_envs, joints.NUM_JOINTS, device=device)
        self.goal = torch.zeros_like(self.start)
        self.share = torch.zeros(num_envs, device=device)
        self.rate = torch.ones(num_envs, device=device)

    def begin(self, ids: Tensor, start: Tensor, goal: Tensor) -> None:
        """Plan from `start` [K,32] to `goal` [K,32] in environments `ids`."""
        self.start[ids], self.goal[ids], self.share[ids] = start, goal, 0.0
        # The smooth step's peak rate is 1.5.
        duration = (1.5 * (goal - start).abs() / self.speed).amax(-1).clamp_min(self.period)
        self.rate[ids] = self.period / duration

    def advance(self, lag: Tensor) -> Tensor:
        """Joint positions [N,32] of the next step's reference; `lag` [N] is the hand's distance from the last one, m."""
        self.share = (self.share + self.rate * (lag < WAIT_DISTANCE)).clamp_(max=1.0)
        s = self.share * self.share * (3 - 2 * self.share)
        return torch.lerp(self.start, self.goal, s.unsqueeze(1))

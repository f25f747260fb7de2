"""A curriculum over objects: families whose grasps fail are drawn more often."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from wbm.envs.grasp_env import GraspEnv
from wbm.envs.outcome import SUCCESS

RATE = 0.02
"""Weight of one episode in a family's running success."""

FLOOR = 0.15
"""Added to a family's failure rate, so that what is mastered is still practised."""


class Curriculum:
    """Sets `env.scene_weight` from the running success of each family of target objects.

    A scene of family f is drawn with a weight of `(1 - share) + share * (1 - success_f + FLOOR)`.

    Args:
        env: whose scenes are weighted.
        share: `teacher.curriculum`, 0 to 1; 0 leaves all scenes alike.

    Attributes:
        success: running success by family [F], 0 at first; goes into checkpoints.
    """

    def __init__(self, env: GraspEnv, share: float) -> None:
        binding = env.binding
        families = np.asarray(binding.scene_model.objects.family)[binding.bank.object[binding.scenes, 0]]
        self.names, group = np.unique(families, return_inverse=True)
        self.env, self.share = env, share
        self.group = torch.as_tensor(group, dtype=torch.int64, device=env.device)
        self.success = torch.zeros(len(self.names), dtype=torch.float64, device=env.device)
        self._tally = torch.zeros(2, len(self.names), dtype=torch.float64, device=env.device)

    def count(self, scenes: Tensor, outcomes: Tensor) -> None:
        """Take in the outcomes [K] of episodes that ended in `scenes` [K]."""
        group = self.group[scenes]
        won = (outcomes == SUCCESS).double()
        self._tally[0].index_add_(0, group, torch.ones_like(won))
        self._tally[1].index_add_(0, group, won)

    def update(self, total: Callable[[Tensor], Tensor] = lambda tally: tally) -> None:
        """Move the running success by what was counted and set the weights anew; forgets the counts.

        Args:
            total: sums the counts over the processes that train together.
        """
        tried, won = total(self._tally)
        gain = 1.0 - (1.0 - RATE) ** tried
        self.success += gain * (won / tried.clamp(min=1.0) - self.success)
        self._tally.zero_()
        wanted = 1.0 - self.success + FLOOR
        self.env.scene_weight.copy_(((1.0 - self.share) + self.share * wanted)[self.group])

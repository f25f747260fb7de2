"""Controller and teachers as a student's example: what they do depends on what there is to see, not on memories."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from wbm.envs.episodes import StudentDriver
from wbm.envs.grasp_env import GraspEnv
from wbm.envs.perception import Sight
from wbm.envs.whole_body import FREE, WholeBodyEnv
from wbm.robot.schema import PolicySchema


class DemonstrationDriver:
    """Controller and teachers act; in free space each command follows from the present state alone.

    Else the controller's target, which does not know of injected noise, would show in the commands, and each command
    would tell the next so well that a student learns to repeat itself.

    Args:
        teacher: maps the privileged observation to an action.
    """

    needs_sight = False

    def __init__(self, teacher: Callable[[Tensor], Tensor]) -> None:
        self.teacher = teacher

    def step(self, env: GraspEnv, sight: Sight | None) -> tuple[Tensor, Tensor, Tensor, dict]:
        """Act once in all environments."""
        assert isinstance(env, WholeBodyEnv)
        env.resume(env.phase == FREE)
        return env.step(self.teacher(env.obs))


class RelabelDriver:
    """What they would have done where a student acts: the labels of DAgger (Ross et al. 2011).

    Executes a student's targets; the environment's own command, a frame's `action`, is what its expert asks for.

    The expert's memory is rebuilt from what was executed before every question: labels of an expert that believes to
    have been obeyed lead away from the states that it is asked about.

    Args:
        student: maps the schema's observation to 32 actions.
        teacher: maps the privileged observation to an action.
        env: where both act, a `WholeBodyEnv`.
    """

    needs_sight = True

    def __init__(
        self,
        student: Callable[[dict[str, Tensor]], Tensor],
        teacher: Callable[[Tensor], Tensor],
        env: GraspEnv,
        schema: PolicySchema,
    ) -> None:
        self.student, self.teacher = StudentDriver(student, env, schema), teacher

    def step(self, env: GraspEnv, sight: Sight | None) -> tuple[Tensor, Tensor, Tensor, dict]:
        """Act once in all environments."""
        assert sight is not None and isinstance(env, WholeBodyEnv)
        env.find_phase()
        env.resume(torch.ones_like(env.phase, dtype=torch.bool))
        env.override = self.student.target(env, sight)
        try:
            return env.step(self.teacher(env.obs))
        finally:
            env.override = None

"""Routes every environment to the teacher that its pre-grasp asks for."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from wbm.envs.grasp_env import GraspEnv
from wbm.envs.world import GRASPS
from wbm.learning.teacher_policy import TeacherPolicy, load_teacher


def load_suite(paths: Mapping[str, Path], device: str = "cpu") -> dict[str, TeacherPolicy]:
    """Teachers by the grasp that they were trained for.

    Raises:
        ValueError: two teachers for one grasp, or none at all.
    """
    suite: dict[str, TeacherPolicy] = {}
    for name in sorted(paths):
        policy = load_teacher(paths[name], device)
        if policy.spec.grasp in suite:
            raise ValueError(f"teachers {suite[policy.spec.grasp].spec.name} and {name} both grasp {policy.spec.grasp}")
        suite[policy.spec.grasp] = policy
    if not suite:
        raise ValueError("no teacher: train one first with `wbm train-teacher`")
    return suite


class RoutedTeacher:
    """One policy of several teachers: observations [N,O] of an environment to actions [N,A]."""

    def __init__(self, suite: Mapping[str, TeacherPolicy], env: GraspEnv) -> None:
        """Check that every teacher fits the environment.

        Raises:
            ValueError: a teacher expects other observations or actions than the environment has.
        """
        for policy in suite.values():
            if policy.spec.obs_labels != env.observe.labels or policy.spec.action_labels != env.action.labels:
                raise ValueError(
                    f"teacher {policy.spec.name} was trained on other observations or actions than this environment "
                    "offers; train it again"
                )
        self.env = env
        self.policies = [(GRASPS.index(grasp), policy) for grasp, policy in suite.items()]
        rows = env.binding.scenes
        self.approach = torch.as_tensor(env.binding.bank.approach[rows], device=env.device)

    def __call__(self, obs: Tensor) -> Tensor:
        wanted = self.approach[self.env.scene].unsqueeze(1)
        code, policy = self.policies[0]
        action = policy(obs).clone()
        for code, policy in self.policies[1:]:
            action = torch.where(wanted == code, policy(obs), action)
        return action

    def names(self) -> dict[int, str]:
        """Teacher's name by approach code."""
        return {code: policy.spec.name for code, policy in self.policies}

"""The eight reward terms of equation (6) as pure functions, each [N], each before its weight.

Weights, decay lengths and heights come from `RewardConfig`; `GraspState` gives the quantities.
"""

from __future__ import annotations

import torch
from torch import Tensor

from wbm.envs.config import RewardConfig
from wbm.envs.state import GraspState

TERMS = ("reach", "contact", "grasp", "lift", "stable", "col", "act", "smooth")


def reach(s: GraspState, c: RewardConfig) -> Tensor:
    """exp(-mean tip gap / l) + exp(-centre gap / l) / 2: hand and fingertips come near the object.

    Episodes that start far away may add `reach_far` exp(-centre gap / L), whose slope is felt there.
    """
    near = torch.exp(-s.tip_gap.mean(-1) / c.reach_length) + 0.5 * torch.exp(-s.centre_gap / c.reach_length)
    return near if c.reach_far == 0 else near + c.reach_far * torch.exp(-s.centre_gap / c.reach_far_length)


def contact(s: GraspState, c: RewardConfig) -> Tensor:
    """Share of fingers on the target, less the hand's force on anything else (in `support_force` units, at most 1)."""
    return s.finger_contact.mean(-1) - (s.obstacle_force / c.support_force).clamp(max=1.0)


def grasp(s: GraspState, c: RewardConfig) -> Tensor:
    """Opposing contact forces of thumb and fingers, and an object centre that lies between their tips."""
    return (1 - c.enclose) * s.opposition + c.enclose * torch.exp(-s.enclosure_gap / 0.03)


def lift(s: GraspState, c: RewardConfig) -> Tensor:
    """Height above the settled height up to the goal, paid for opposition, decaying where the object is flung or
    carried away.
    """
    rise = (s.height / c.goal_height).clamp(0.0, 1.0)
    near = 0.5 * torch.exp(-(s.height - c.goal_height).abs() / c.goal_width)
    overshoot = torch.exp(-(s.height - c.overshoot_height).clamp(min=0.0) / c.overshoot_width)
    away = torch.exp(-(s.drift - c.drift_free).clamp(min=0.0) / c.drift_width)
    return (c.lift_open + (1 - c.lift_open) * s.opposition) * (rise + near * rise) * overshoot * away


def stable(s: GraspState, c: RewardConfig) -> Tensor:
    """After lift-off: no slip, no spin, contact kept; and holding still above the success height."""
    calm = torch.exp(-s.slip / c.slip_speed - s.spin / c.spin_speed)
    still = torch.exp(-s.obj_lin_vel_w.norm(dim=-1) / c.hold_speed - s.obj_ang_vel_w.norm(dim=-1) / c.hold_turn)
    return s.lifted * (s.held * calm - (1 - s.held)) + c.hold * s.holding * still


def col(s: GraspState, c: RewardConfig) -> Tensor:
    """Forbidden contacts of arm, neck and base, and finger forces beyond a firm grip."""
    return s.forbidden + ((s.finger_force - c.grip_force).clamp(min=0.0) / c.grip_force).mean(-1).clamp(max=1.0)


def act(action: Tensor) -> Tensor:
    """|a|^2."""
    return action.square().sum(-1)


def smooth(action: Tensor, previous: Tensor) -> Tensor:
    """|a - a'|^2."""
    return (action - previous).square().sum(-1)


def total(s: GraspState, action: Tensor, previous: Tensor, c: RewardConfig) -> tuple[Tensor, Tensor]:
    """Weighted sum [N] of all terms, and the weighted terms [N,8] in the order of `TERMS` for the log."""
    parts = torch.stack(
        [
            c.reach * reach(s, c),
            c.contact * contact(s, c),
            c.grasp * grasp(s, c),
            c.lift * lift(s, c),
            c.stable * stable(s, c),
            -c.col * col(s, c),
            -c.act * act(action),
            -c.smooth * smooth(action, previous),
        ],
        dim=-1,
    ).mul_(c.scale)
    return parts.sum(-1), parts

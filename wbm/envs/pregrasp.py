"""Pre-grasp start states: for each scene, joint positions that put the grasp frame in front of the target."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
import warp as wp
from torch import Tensor

from wbm.control.config import WbcConfig
from wbm.control.planner import Target, pregrasp_poses
from wbm.control.wbc import WholeBodyController
from wbm.envs.actions import HAND_CLOSED, HAND_OPEN, joint_limits
from wbm.envs.binding import SceneTable
from wbm.envs.config import EnvConfig, ScatterConfig
from wbm.envs.draws import Columns, Stream
from wbm.envs.randomization import scaled
from wbm.envs.rotations import quat_exp, quat_mul, quat_turn, rotate
from wbm.robot import joints
from wbm.robot.model import RobotModel

NECK_ASIDE = (1.11, 1.63, -2.02, 1.12, -0.31, -1.84)
"""Neck joints from which the gaze starts at a pre-grasp: a camera to the side sees past the hand (on shelves in 90 % of
scenes with the hand at the target; 60 % from the home pose)."""

FEW = (16, 96)
"""Batches in which the last few candidates are solved."""

ROOMY = 0.015
"""Clearance (m) with which the planner's own pre-grasp is taken before those with more."""


@dataclass
class StartBank:
    """Joint positions at pre-grasps: `q` [S,K,32]; scene s has `count[s]` of them, first in its row.

    The first of a scene is the planner's own: straight ahead and in the middle, so that it follows from what can be
    seen, or, where that is out of reach or short of room, the one with the most room. The others are spread around it.

    `clearance` [S] is the largest distance from everything among a scene's starts, m, -inf without one. `scattered`
    [S,P,32] are starts off the way to the pre-grasp, where they were asked for.
    A scene without a reachable pre-grasp has a count of 0; `draw` must not be asked for it.
    """

    q: Tensor
    count: Tensor
    clearance: Tensor = field(default_factory=lambda: torch.zeros(0))
    scattered: Tensor = field(default_factory=lambda: torch.zeros(0, 0, joints.NUM_JOINTS))

    def draw(self, scenes: Tensor, uniform: Tensor) -> Tensor:
        """One start [K,32] for each of `scenes` [K], picked by `uniform` [K] in [0, 1)."""
        pick = (uniform * self.count[scenes]).long()
        return self.q[scenes, pick].clone()

    def first(self, scenes: Tensor) -> Tensor:
        """The planner's own choice [K,32] for each of `scenes` [K]."""
        return self.q[scenes, 0].clone()

    @property
    def usable(self) -> Tensor:
        """Indices of the scenes that have a start."""
        return self.count.nonzero().squeeze(1)


def target_of(table: SceneTable, scenes: Tensor) -> Target:
    """The targets of `scenes` [B] as the planner sees them."""
    t = table
    rows = (t.target_pos, t.target_quat, t.box_half, t.width, t.base[:, 2], t.support_height, t.ceiling_height)
    return Target(*(values[scenes] for values in rows))


def grasp_poses(
    table: SceneTable, scenes: Tensor, grasp: str, cfg: EnvConfig, u: Tensor, spread: Tensor
) -> tuple[Tensor, Tensor]:
    """Pre-grasp positions [B,3] and orientations [B,4] of the grasp frame, jittered by `u` [B,7] times `spread` [B]."""
    r = cfg.randomization
    pos, quat = pregrasp_poses(target_of(table, scenes), grasp, cfg.standoff, 0.5 + spread * (u[:, 0] - 0.5))
    turn = torch.stack([scaled(r.start_tilt, u[:, 1]), scaled(r.start_tilt, u[:, 2]), scaled(r.start_yaw, u[:, 3])], -1)
    shift = torch.stack([scaled(r.start_offset, u[:, k]) for k in (4, 5, 6)], -1)
    spread = spread.unsqueeze(1)
    return pos + rotate(quat, spread * shift), quat_mul(quat, quat_exp(spread * turn))


def solve_starts(
    table: SceneTable,
    robot: RobotModel,
    wbc_cfg: WbcConfig,
    cfg: EnvConfig,
    grasp: str,
    seed: int = 0,
    device: str = "cpu",
    batch: int = 512,
    iterations: int = 120,
    rounds: int = 4,
) -> StartBank:
    """Find `cfg.starts_per_scene` pre-grasps for each scene by running the controller itself, kinematically.

    A scene's first candidate is the planner's own, the others are spread around it at random; those that reach the pose
    clear of every obstacle are kept.

    Args:
        batch: candidates solved together.
        iterations: controller steps given to a candidate.
        rounds: candidates tried for each wanted start, at most.

    Raises:
        ValueError: no scene has a reachable pre-grasp.
    """
    count, keep = table.count, cfg.starts_per_scene
    bank = torch.zeros(count, keep, joints.NUM_JOINTS, device=device)
    found = torch.zeros(count, dtype=torch.int64, device=device)
    room = torch.full((count, keep), -torch.inf, device=device)
    own = torch.zeros(count, keep, device=device)
    solvers: dict[int, _Solver] = {}
    columns = Columns()
    jitter, stand = columns.add("jitter", 7), columns.add("stand", 3)
    uniforms = Stream(seed, columns, device)
    for _ in range(rounds):
        # Every scene that lacks starts gets as many candidates as it lacks, interleaved so that all scenes progress.
        lacking = torch.cat([(found < keep - k).nonzero().squeeze(1) for k in range(keep)])
        for first in range(0, len(lacking), batch):
            part = lacking[first : first + batch]
            first_choice = torch.arange(len(part), device=device) < count - uniforms.drawn
            u = uniforms.draw(len(part))
            pos, quat = grasp_poses(table, part, grasp, cfg, u[:, jitter], (~first_choice).float())
            base = stand_poses(table.base[part], torch.where(first_choice.unsqueeze(1), 0.5, u[:, stand]))
            size = min(n for n in (*FEW, max(batch, *FEW)) if n >= len(part))
            if size not in solvers:  # one costs what its full batch costs
                solvers[size] = _Solver(table, robot, wbc_cfg, size, device)
            q, good, clear = solvers[size].solve(part, pos, quat, base, iterations)
            for scene, i in zip(part[good].tolist(), good.nonzero().squeeze(1).tolist(), strict=True):
                k = int(found[scene])
                if k < keep:
                    bank[scene, k], room[scene, k], own[scene, k] = q[i], clear[i], float(first_choice[i])
                    found[scene] += 1
    if int(found.max()) == 0:
        raise ValueError(
            f"no scene has a reachable {grasp} pre-grasp; check the scenes' support heights and env.standoff"
        )
    best = (room + own * (room > ROOMY)).argmax(1)
    scenes, first = torch.arange(count, device=device), bank[:, 0].clone()
    bank[:, 0] = bank[scenes, best]
    bank[scenes[best > 0], best[best > 0]] = first[best > 0]
    return StartBank(bank, found, room.amax(1))


def stand_poses(base: Tensor, u: Tensor) -> Tensor:
    """Base poses [B,3] (x, y, yaw) near the scenes' own grasp places, jittered by `u` [B,3]."""
    spread = torch.tensor([0.10, 0.20, 0.30], device=base.device)
    offset = spread * (u - 0.5)
    c, s = torch.cos(base[:, 2]), torch.sin(base[:, 2])
    x = base[:, 0] + c * offset[:, 0] - s * offset[:, 1]
    y = base[:, 1] + s * offset[:, 0] + c * offset[:, 1]
    return torch.stack([x, y, base[:, 2] + offset[:, 2]], -1)


def scatter_starts(
    table: SceneTable,
    robot: RobotModel,
    wbc_cfg: WbcConfig,
    cfg: ScatterConfig,
    goal: Tensor,
    seed: int = 0,
    device: str = "cpu",
    batch: int = 512,
    rounds: int = 24,
) -> Tensor:
    """Starts between the scenes' start poses and `goal` [S,32], offset at random and clear of everything: [S,P,32].

    A start that could not be placed within `rounds` is the scene's own start pose.
    """
    everything = torch.arange(table.count, device=device)
    out = table.q_start.unsqueeze(1).repeat(1, cfg.per_scene, 1)
    batch = min(batch, table.count)
    solver = _Solver(table, robot, wbc_cfg, batch, device)
    offset = torch.zeros(joints.NUM_JOINTS, device=device)
    offset[:2], offset[2], offset[joints.ARM], offset[joints.NECK] = cfg.base, cfg.yaw, cfg.arm, cfg.neck
    low, high = joint_limits(robot, device)
    columns = Columns()
    along, aside = columns.add("along"), columns.add("aside", joints.NUM_JOINTS)
    closure, closed = columns.add("closure"), torch.tensor(HAND_CLOSED, device=device)
    uniforms = Stream(seed, columns, device)
    for place in range(cfg.per_scene):
        waiting = everything
        for _ in range(rounds):
            left = []
            for part in waiting.split(batch):
                u = uniforms.draw(len(part))
                way = table.q_start[part] + u[:, along] * (goal[part] - table.q_start[part])
                q = (way + offset * (2.0 * u[:, aside] - 1.0)).clamp(low, high)
                hand = goal[part][:, joints.HAND]
                q[:, joints.HAND] = hand
                free = solver.clearance(part, q) > cfg.clearance
                # Half of the hands are open, the others more or less closed (fingers that are near each other are).
                grip = (2.0 * u[:, closure] - 1.0).clamp(min=0.0)
                q[:, joints.HAND] = hand + grip * (closed - hand)
                out[part[free], place] = q[free]
                left.append(part[~free])
            waiting = torch.cat(left)
            if len(waiting) == 0:
                break
    return out


class _Solver:
    """Runs the controller on a batch of candidates without physics."""

    def __init__(self, table: SceneTable, robot: RobotModel, cfg: WbcConfig, batch: int, device: str) -> None:
        self.table, self.batch = table, batch
        self.controller = c = WholeBodyController(robot, batch, table.obstacle_type.shape[1], cfg, device)
        self.q, self.q_target = wp.to_torch(c.q), wp.to_torch(c.q_target)
        self.pos, self.quat = wp.to_torch(c.ee_pos), wp.to_torch(c.ee_quat)
        self.gaze, self.posture = wp.to_torch(c.gaze_point), wp.to_torch(c.q_posture)
        self.obstacles = tuple(
            wp.to_torch(a) for a in (c.obstacle_type, c.obstacle_size, c.obstacle_pos, c.obstacle_quat)
        )
        self.distance = wp.to_torch(c.min_distance)
        self.ee = list(c.frame_names).index("ee")
        self.frame_pos, self.frame_quat = wp.to_torch(c.frame_pos), wp.to_torch(c.frame_quat)
        wp.to_torch(c.gaze_weight).fill_(1.0)
        self.home = torch.tensor(robot.q_home, dtype=torch.float32, device=device)
        self.home[joints.HAND] = torch.tensor(HAND_OPEN, device=device)
        self.home[joints.NECK] = torch.tensor(NECK_ASIDE, device=device)
        self.home.clamp_(*joint_limits(robot, device))
        self.body = torch.as_tensor(joints.WBC, device=device)

    def solve(self, scenes: Tensor, pos: Tensor, quat: Tensor, base: Tensor, iterations: int) -> tuple[Tensor, ...]:
        """Joint positions [B,32], which of them are good [B], and their distance from everything [B], m."""
        t, size = self.table, len(scenes)
        pad = self._show(scenes)
        self.q.copy_(self.home)
        self.q[:, joints.BASE] = base[pad]
        self.pos.copy_(pos[pad])
        self.quat.copy_(quat[pad])
        self.gaze.copy_(t.target_pos[scenes[pad]])
        self.posture.copy_(self.q[:, self.body])
        self.controller.reset(torch.arange(self.batch, device=scenes.device))  # pyright: ignore[reportArgumentType]
        for _ in range(iterations):
            self.controller.step()
            self.q[:, self.body] = self.q_target
        self.controller.step()
        error = (self.frame_pos[:, self.ee] - self.pos).norm(dim=-1)
        angle = quat_turn(self.frame_quat[:, self.ee], self.quat).norm(dim=-1)
        good = (error < 0.02) & (angle < 0.15) & (self.distance > 0.005)
        return self.q[:size].clone(), good[:size].clone(), self.distance[:size].clone()

    def clearance(self, scenes: Tensor, q: Tensor) -> Tensor:
        """Distance [B] of joints `q` [B,32] from everything in their scenes and from themselves, m.

        1e6 where nothing is within the controller's reach.
        """
        self.q.copy_(q[self._show(scenes)])
        self.controller.reset(torch.arange(self.batch, device=scenes.device))  # pyright: ignore[reportArgumentType]
        self.controller.step()
        return self.distance[: len(scenes)].clone()

    def _show(self, scenes: Tensor) -> Tensor:
        """Place the obstacles of `scenes` [B]; which of them each of the batch's places shows."""
        t = self.table
        pad = torch.arange(self.batch, device=scenes.device) % len(scenes)
        for live, values in zip(
            self.obstacles, (t.obstacle_type, t.obstacle_size, t.obstacle_pos, t.obstacle_quat), strict=True
        ):
            live.copy_(values[scenes[pad]])
        return pad

"""Puts a target, distractors and the robot into a layout without overlap."""

from __future__ import annotations

import numpy as np

from wbm.robot import joints
from wbm.robot.model import RobotModel
from wbm.robot.rotations import multiply, rotate
from wbm.robot.spheres import robot_spheres, self_pairs, sphere_positions
from wbm.scenes.bank import NUM_SUPPORTS, SIDE, TOP_DOWN
from wbm.scenes.config import KINDS, ScenesConfig
from wbm.scenes.instructions import NUM_HELD_OUT, NUM_TRAINING
from wbm.scenes.layout import Layout, draw_layout
from wbm.scenes.objects import ObjectSet

TARGET_GAP = (0.045, 0.12)  # free space between the target and its neighbours, m
CLUTTER_GAP = 0.015
DROP = 0.0005  # objects start this far above the surface, m
START_CLEARANCE = 0.03
SUPPORT_YAW = 0.1
FRONT = (0.9, 0.1)  # where the support's front edge lies on x, and how much that varies, m
_WOODS = np.array([[0.72, 0.58, 0.42], [0.55, 0.40, 0.28], [0.80, 0.78, 0.74], [0.45, 0.47, 0.50], [0.62, 0.66, 0.60]])
_TRIES = 40


def fits(kind: str, objects: ObjectSet) -> np.ndarray:
    """[O] which objects can be the target in a kind of scene: from above in bins, from the front on shelves."""
    height, width = 2 * objects.half_extent[:, 2], objects.width
    if kind == "shelf":
        return (height >= 0.055) & (height <= 0.2) & (width <= 0.095)
    if kind == "bin":
        return (width <= 0.095) & (height >= 0.04)
    return (width <= 0.115) & (height >= 0.035)


def draw_scene(
    kind: str, pool: np.ndarray, split: str, objects: ObjectSet, robot: RobotModel, cfg: ScenesConfig, rng
) -> dict | None:
    """One scene as a row for `bank.stack_scenes`, or None when it could not be arranged; `pool` [P]: object indices."""
    layout = draw_layout(kind, rng, cfg)
    targets = pool[fits(kind, objects)[pool]]
    if len(targets) == 0:
        raise ValueError(
            f"scenes: none of the {len(pool)} {split} objects can be a target in a {kind} scene; "
            f"add objects, or leave {kind} out of scenes.kinds"
        )
    placed = _place(layout, int(rng.choice(targets)), pool, objects, cfg, rng)
    if placed is None:
        return None
    chosen, pos, quat = placed
    frame_quat, frame_pos = _support_pose(rng)
    size, support_pos = np.full((NUM_SUPPORTS, 3), 0.01), np.zeros((NUM_SUPPORTS, 3))
    support_pos[:, 2] = -5.0 - np.arange(NUM_SUPPORTS)
    count = len(layout.pos)
    size[:count] = layout.size
    support_pos[:count] = frame_pos + rotate(frame_quat, layout.pos)
    used = chosen >= 0
    pos[used] = frame_pos + rotate(frame_quat, pos[used])
    quat[used] = multiply(frame_quat, quat[used])
    start = _start(robot, support_pos[:count], size[:count], frame_quat, pos[0], cfg, rng)
    if start is None:
        return None
    tall = 2 * objects.half_extent[chosen[0], 2] > 0.13
    return dict(
        kind=KINDS.index(kind),
        split=split,
        support_size=size,
        support_pos=support_pos,
        support_quat=np.tile(frame_quat, (NUM_SUPPORTS, 1)),
        support_count=count,
        support_rgb=np.clip(_WOODS[rng.integers(len(_WOODS))] + rng.normal(0, 0.03, 3), 0, 1),
        surface_z=layout.surface_z,
        ceiling_z=layout.ceiling_z,
        object=chosen,
        object_pos=pos,
        object_quat=quat,
        q_start=start[0],
        base_grasp=start[1],
        approach=SIDE if kind == "shelf" or (kind == "table" and tall) else TOP_DOWN,
        text=np.full(NUM_TRAINING, -1),
        text_held_out=np.full(NUM_HELD_OUT, -1),
    )


def _support_pose(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    yaw = rng.uniform(-SUPPORT_YAW, SUPPORT_YAW)
    place = np.array([FRONT[0] + rng.uniform(-FRONT[1], FRONT[1]), rng.uniform(-FRONT[1], FRONT[1]), 0.0])
    return np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]), place


def _place(
    layout: Layout, target: int, pool: np.ndarray, objects: ObjectSet, cfg: ScenesConfig, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Object indices [1+D] (-1 absent) and poses in the support frame; footprints are circles that keep apart.

    No distractor has the target's noun and colour: every target can be named.
    """
    slots = 1 + cfg.num_distractors
    chosen = np.full(slots, -1)
    pos, quat = np.zeros((slots, 3)), np.tile((1.0, 0.0, 0.0, 0.0), (slots, 1))
    pos[:, 2] = -3.0 - np.arange(slots)
    want = int(rng.integers(cfg.distractors[0], cfg.distractors[1] + 1))
    circles: list[tuple[np.ndarray, float]] = []
    room = layout.ceiling_z - layout.surface_z - 0.03
    for slot in range(1 + want):
        for _ in range(_TRIES):
            o = target if slot == 0 else int(rng.choice(pool))
            rest = int(rng.integers(objects.rest_count[o])) if slot else 0
            yaw = rng.uniform(-np.pi, np.pi)
            turn = multiply(np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]), objects.rest_quat[o, rest])
            half = np.abs(_matrix(objects.rest_quat[o, rest])) @ objects.half_extent[o]
            radius = float(np.hypot(half[0], half[1]))
            twin = slot > 0 and objects.noun[o] == objects.noun[target] and objects.color[o] == objects.color[target]
            if 2 * half[2] > room or o in chosen or twin:
                continue
            border = radius + layout.wall_gap
            low, high = layout.low + border, layout.high - border
            if slot == 0:
                low, high = np.maximum(low, layout.target_low), np.minimum(high, layout.target_high)
            if (low >= high).any():
                continue
            spot = rng.uniform(low, high)
            gap = rng.uniform(*TARGET_GAP)
            free = [
                np.linalg.norm(spot - c) >= radius + r + (gap if k == 0 else CLUTTER_GAP)
                for k, (c, r) in enumerate(circles)
            ]
            if all(free):
                circles.append((spot, radius))
                chosen[slot], quat[slot] = o, turn
                pos[slot] = [*spot, layout.surface_z + objects.rest_height[o, rest] + DROP]
                break
        else:
            if slot == 0 or slot <= cfg.distractors[0]:
                return None
    return chosen, pos, quat


def _matrix(quat: np.ndarray) -> np.ndarray:
    return np.stack([rotate(quat, axis) for axis in np.eye(3)], axis=1)


def _start(
    robot: RobotModel, pos: np.ndarray, size: np.ndarray, quat: np.ndarray, target: np.ndarray, cfg: ScenesConfig, rng
) -> tuple[np.ndarray, np.ndarray] | None:
    """A start configuration [32] clear of supports and of itself, and the base pose [3] from which to grasp."""
    heading = 2 * np.arctan2(quat[3], quat[0]) + rng.uniform(-0.15, 0.15)
    ahead = np.array([np.cos(heading), np.sin(heading)])
    grasp = np.r_[target[:2] - cfg.grasp_reach * ahead, heading]
    for _ in range(_TRIES):
        back, side = rng.uniform(*cfg.start_distance), rng.uniform(-cfg.start_lateral, cfg.start_lateral)
        q = robot.q_home.copy()
        q[:2] = grasp[:2] - back * ahead + side * np.array([-ahead[1], ahead[0]])
        q[2] = heading + rng.uniform(-cfg.start_yaw, cfg.start_yaw)
        q[joints.ARM] += rng.uniform(-0.12, 0.12, 7)
        q[joints.HAND] += rng.uniform(-0.08, 0.08, 16)
        q[joints.NECK] += rng.uniform(-0.08, 0.08, 6)
        q = np.clip(q, robot.q_min + 1e-3, robot.q_max - 1e-3)
        if clearance(robot, q, pos, size, quat) > START_CLEARANCE and self_clearance(robot, q) > 0.0:
            return q, grasp
    return None


def clearance(robot: RobotModel, q: np.ndarray, pos: np.ndarray, size: np.ndarray, quat: np.ndarray) -> float:
    """Smallest distance (m) of the robot's spheres at `q` [32] from boxes that share the orientation `quat`."""
    spheres = robot_spheres(robot)
    centre = sphere_positions(robot, spheres, q[None])[0]
    inverse = quat * np.array([1.0, -1.0, -1.0, -1.0])
    local = rotate(inverse, centre[:, None] - pos)
    return float((_box_distance(local, size) - spheres.radius[:, None]).min())


def self_clearance(robot: RobotModel, q: np.ndarray) -> float:
    """Smallest gap (m) between the sphere pairs of the robot at `q` [32]."""
    spheres = robot_spheres(robot)
    centre = sphere_positions(robot, spheres, q[None])[0]
    a, b = self_pairs(robot, spheres).T
    return float((np.linalg.norm(centre[a] - centre[b], axis=1) - spheres.radius[a] - spheres.radius[b]).min())


def _box_distance(local: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Signed distance of points [...,3] from boxes with half sizes [...,3] about the origin."""
    d = np.abs(local) - size
    return np.linalg.norm(np.maximum(d, 0), axis=-1) + np.minimum(d.max(axis=-1), 0)

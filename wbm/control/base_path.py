"""A path of the base around obstacles, for when the straight one is blocked.

The robot keeps its posture and the heading of its goal on the way, so that its collision spheres only translate: a
place is free if all of them clear every obstacle there. A grid search over such places (A*, `pathfinding`) finds the
way, which is then pulled straight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pathfinding.core.diagonal_movement import DiagonalMovement
from pathfinding.core.grid import Grid
from pathfinding.finder.a_star import AStarFinder

from wbm.robot import joints
from wbm.robot.model import RobotModel
from wbm.robot.rotations import quat_to_mat
from wbm.robot.spheres import robot_spheres, sphere_positions

CELL = 0.1  # m
BORDER = 1.5  # m of grid around start and goal
NEAR_GOAL = 0.5  # m before the goal where the hand's own approach takes over
MARGIN = 0.08  # m kept from obstacles on the way: the controller's own distance and what it lags behind
NO_OBSTACLE, PLANE, SPHERE, CAPSULE, CYLINDER, BOX = -1, 0, 2, 3, 5, 6


@dataclass(frozen=True)
class Obstacles:
    """M primitives of one scene as the controller takes them: `type [M]`, `size [M,3]`, `pos [M,3]`, `quat [M,4]`."""

    type: np.ndarray
    size: np.ndarray
    pos: np.ndarray
    quat: np.ndarray

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distance (m, negative inside) of points [P,3] to the nearest obstacle [P]; planes do not count."""
        out = np.full(len(points), np.inf)
        for kind, size, pos, quat in zip(self.type, self.size, self.pos, self.quat, strict=True):
            if kind in (NO_OBSTACLE, PLANE):
                continue
            p = (points - pos) @ quat_to_mat(np.asarray(quat, dtype=np.float64))
            out = np.minimum(out, _distance(int(kind), size, p))
        return out


def _distance(kind: int, size: np.ndarray, p: np.ndarray) -> np.ndarray:
    if kind == BOX:
        d = np.abs(p) - size
    elif kind == CYLINDER:
        d = np.stack([np.hypot(p[:, 0], p[:, 1]) - size[0], np.abs(p[:, 2]) - size[1]], axis=1)
    else:
        half = size[1] if kind == CAPSULE else 0.0
        axis = p - np.clip(p[:, 2], -half, half)[:, None] * np.array([0.0, 0.0, 1.0])
        return np.linalg.norm(axis, axis=1) - size[0]
    return np.linalg.norm(np.maximum(d, 0.0), axis=1) + np.minimum(d.max(axis=1), 0.0)


class BaseMap:
    """Where the base may stand in a fixed posture and heading.

    Args:
        robot: the kinematic tree.
        q: joints [32] of the posture; the base's position does not count.
        yaw: heading, rad.
        obstacles: what is in the way.
    """

    def __init__(self, robot: RobotModel, q: np.ndarray, yaw: float, obstacles: Obstacles) -> None:
        spheres = robot_spheres(robot)
        at = np.array(q, dtype=np.float64)
        at[joints.BASE] = [0.0, 0.0, yaw]
        self.offset, self.radius = sphere_positions(robot, spheres, at[None])[0], spheres.radius
        self.obstacles = obstacles

    def free(self, places: np.ndarray) -> np.ndarray:
        """Which places [P,2] of the base keep `MARGIN` from every obstacle [P]."""
        points = np.zeros((len(places), len(self.offset), 3)) + self.offset
        points[..., :2] += places[:, None]
        gap = self.obstacles.distance(points.reshape(-1, 3)).reshape(points.shape[:2]) - self.radius
        return gap.min(axis=1) > MARGIN

    def free_line(self, a: np.ndarray, b: np.ndarray) -> bool:
        """Whether the whole way from a to b [2] is free."""
        count = 2 + int(np.linalg.norm(b - a) / (0.5 * CELL))
        return bool(self.free(np.linspace(a, b, count)).all())


def base_path(base: BaseMap, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Places [W,2] to pass between `start` and `goal` [2], m: none where the straight way will do or no way is known.

    The goal itself is where the hand works, often closer to things than a way should lead: the path ends at the free
    place nearest to it, and so may the straight way. The start may lack the margin too.
    """
    line = np.linspace(start, goal, 2 + int(np.linalg.norm(goal - start) / (0.5 * CELL)))
    free = base.free(line)
    first = int(np.argmax(free)) if free.any() else len(line)
    stretch = first + int(np.argmin(np.r_[free[first:], False]))
    left = float(np.linalg.norm(line[stretch - 1] - goal)) if stretch > first else np.inf
    if left < NEAR_GOAL and not free[stretch:].any():
        return np.zeros((0, 2))
    low = np.minimum(start, goal) - BORDER
    shape = np.ceil((np.maximum(start, goal) + BORDER - low) / CELL).astype(int) + 1
    centres = low + CELL * np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="xy"), axis=-1)
    open_cells = base.free(centres.reshape(-1, 2)).reshape(centres.shape[:2])
    if not open_cells.any():
        return np.zeros((0, 2))
    here, there = (_nearest(centres, open_cells, point) for point in (start, goal))
    if left < np.linalg.norm(centres[there[::-1]] - goal) + 2 * CELL:
        return np.zeros((0, 2))
    grid = Grid(matrix=open_cells.astype(int).tolist())
    finder = AStarFinder(diagonal_movement=DiagonalMovement.only_when_no_obstacle)
    nodes, _ = finder.find_path(grid.node(*here), grid.node(*there), grid)
    return _pulled(base, np.array([start, *(centres[node.y, node.x] for node in nodes)]))


def _nearest(centres: np.ndarray, free: np.ndarray, point: np.ndarray) -> tuple[int, int]:
    """Column and row of the free cell nearest to a point."""
    away = np.where(free, np.linalg.norm(centres - point, axis=-1), np.inf)
    row, column = np.unravel_index(int(np.argmin(away)), away.shape)
    return int(column), int(row)


def _pulled(base: BaseMap, places: np.ndarray) -> np.ndarray:
    """The corners that are left of a way when every straight stretch that is free is taken, without its start."""
    corners, at = [], 0
    while at < len(places) - 1:
        at = next((j for j in range(len(places) - 1, at, -1) if base.free_line(places[at], places[j])), at + 1)
        corners.append(places[at])
    return np.array(corners).reshape(-1, 2)

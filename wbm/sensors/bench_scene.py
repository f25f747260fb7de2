"""Random table-top scenes for benchmarks and tests: robot, table, shelf, props and meshes."""

from __future__ import annotations

import numpy as np
import trimesh

from wbm.robot.model import forward_kinematics, load_robot
from wbm.robot.rotations import mat_to_quat, quat_to_mat
from wbm.sensors.poses import look_at
from wbm.sensors.scene import (
    BOX,
    CAPSULE,
    CYLINDER,
    MESH,
    SPHERE,
    Instances,
    Semantic,
    floor_instance,
    robot_instances,
)

TABLE_X = 0.95  # centre of the table, m
COLORS = np.array([[0.85, 0.2, 0.2], [0.2, 0.45, 0.85], [0.25, 0.65, 0.3], [0.95, 0.75, 0.2], [0.55, 0.3, 0.65]])


def sample_meshes(detail: int = 4) -> list[tuple[np.ndarray, np.ndarray]]:
    """Four closed meshes 0.1 to 0.25 m large; detail 4 gives 4 to 5 thousand triangles each."""
    n = 8 + 13 * detail
    profile = np.linspace(0, 1, n // 2)
    bottle = np.stack([0.036 - 0.022 / (1 + np.exp(-14 * (profile - 0.7))), 0.2 * profile - 0.1], axis=1)
    bowl = np.concatenate(
        [
            np.stack([0.02 + 0.06 * profile, 0.08 * profile**2], axis=1),
            np.stack([0.075 - 0.06 * profile, 0.005 + 0.075 * (1 - profile) ** 2], axis=1),
        ]
    )
    shapes = [
        trimesh.creation.icosphere(subdivisions=detail, radius=0.06),
        trimesh.creation.torus(0.055, 0.02, major_sections=n + 8, minor_sections=n // 2 + 4),
        trimesh.creation.revolve(_closed(bottle), sections=n + 12),
        trimesh.creation.revolve(_closed(bowl), sections=n * 2 // 3 + 4),
    ]
    return [(np.asarray(s.vertices, np.float64), np.asarray(s.faces)) for s in shapes]


def _closed(profile: np.ndarray) -> np.ndarray:
    """A profile (radius, height) whose ends meet the axis."""
    return np.concatenate([[[0.0, profile[0, 1]]], profile, [[0.0, profile[-1, 1]]]])


def _box(center: tuple, half: tuple, color: tuple) -> Instances:
    out = Instances.empty(1)
    out.type[0], out.pos[0], out.size[0] = BOX, center, half
    out.id[0], out.color[0] = Semantic.SUPPORT, color
    return out


def _furniture(height: float) -> Instances:
    """A table with four legs and a shelf of three boards behind it."""
    wood, white = (0.72, 0.55, 0.38), (0.85, 0.85, 0.83)
    parts = [_box((TABLE_X, 0, height - 0.02), (0.35, 0.6, 0.02), wood)]
    legs = [(x, y) for x in (-0.31, 0.31) for y in (-0.56, 0.56)]
    parts += [_box((TABLE_X + x, y, height / 2 - 0.02), (0.025, 0.025, height / 2 - 0.02), wood) for x, y in legs]
    parts += [_box((TABLE_X + 0.75, 0, z), (0.15, 0.6, 0.012), white) for z in (0.4, 0.8, 1.2)]
    return Instances.concat(parts)


def _props(rng: np.random.Generator, num: int, num_meshes: int, mesh_count: int, height: float) -> Instances:
    """Meshes and primitives about the table top, the first mesh being the target."""
    out = Instances.empty(num)
    for i in range(num):
        mesh = i < num_meshes
        out.type[i] = MESH if mesh else rng.choice([SPHERE, CAPSULE, CYLINDER, BOX])
        out.mesh[i] = rng.integers(mesh_count) if mesh else -1
        out.size[i] = rng.uniform(0.015, 0.05, 3)
        spread = (0.3, 0.5) if i < 24 else (1.6, 1.8)
        out.pos[i, :2] = rng.uniform(-1, 1, 2) * spread + (TABLE_X, 0)
        out.pos[i, 2] = height + rng.uniform(0.02, 0.12) if i < 24 else rng.uniform(0.05, 1.3)
        quat = rng.normal(size=4)
        out.quat[i] = quat / np.linalg.norm(quat)
        out.id[i] = Semantic.TARGET if i == 0 else Semantic.DISTRACTOR + i - 1
        out.color[i] = COLORS[i % len(COLORS)]
    return out


def tabletop(rng: np.random.Generator, num_instances: int, num_meshes: int, mesh_count: int) -> tuple[Instances, float]:
    """A scene of exactly `num_instances`, and the height of its table (m)."""
    height = rng.uniform(0.4, 0.75)
    fixed = Instances.concat([floor_instance(), robot_instances(load_robot()), _furniture(height)])
    props = _props(rng, num_instances - len(fixed.type), num_meshes, mesh_count, height)
    return Instances.concat([fixed, props]), height


def robot_bodies(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World poses of all links at `q` [32]: [L,3] and [L,4] (w x y z)."""
    rot, pos = forward_kinematics(load_robot(), q)
    return pos, np.stack([mat_to_quat(r) for r in rot])


def sensor_pose(name: str, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World pose of the robot frame `camera` or `lidar` at `q` [32]: [3] and [4] (w x y z)."""
    frame = load_robot().frames[name]
    rot, pos = forward_kinematics(load_robot(), q)
    return pos[frame.link] + rot[frame.link] @ frame.pos, mat_to_quat(rot[frame.link] @ quat_to_mat(frame.quat))


def viewpoint(rng: np.random.Generator, height: float) -> tuple[np.ndarray, np.ndarray]:
    """A camera pose 0.6 to 0.9 m away that looks at the table top: [3] and [4] (w x y z)."""
    target = np.array([TABLE_X, 0.0, height]) + rng.uniform(-0.1, 0.1, 3)
    pos = target + rng.uniform([-0.75, -0.3, 0.35], [-0.5, 0.3, 0.55])
    return pos, look_at(pos, target)

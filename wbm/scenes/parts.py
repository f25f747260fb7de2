"""Convex parts that objects are made of: primitives and hulls, their meshes, volumes and inertia."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from wbm.robot.rotations import quat_to_mat

SPHERE, CAPSULE, CYLINDER, BOX, MESH = 2, 3, 5, 6, 7
MAX_PARTS = 8
IDENTITY = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Part:
    """A convex solid in the object frame: MuJoCo type and half sizes, pose (m, w x y z), vertices [V,3] of a hull."""

    type: int
    size: tuple[float, float, float]
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quat: tuple[float, float, float, float] = IDENTITY
    vertices: np.ndarray | None = None


def hull_part(vertices: np.ndarray) -> Part:
    """The convex hull of points [V,3], in the object frame, as a part."""
    hull = ConvexHull(vertices)
    kept = np.ascontiguousarray(vertices[np.sort(hull.vertices)])
    half = (kept.max(axis=0) - kept.min(axis=0)) / 2
    return Part(MESH, tuple(half), vertices=kept)


def moved(part: Part, offset: np.ndarray) -> Part:
    """The part shifted by `offset` [3]."""
    if part.vertices is not None:
        return Part(part.type, part.size, part.pos, part.quat, part.vertices + offset)
    return Part(part.type, part.size, tuple(np.asarray(part.pos) + offset), part.quat)


def part_mesh(part: Part, sections: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """Triangle mesh of a part in the object frame: vertices [V,3] and outward faces [F,3]."""
    points = part.vertices if part.vertices is not None else _outline(part, sections)
    vertices, faces = convex_mesh(points)
    if part.vertices is None:
        vertices = vertices @ quat_to_mat(np.asarray(part.quat)).T + np.asarray(part.pos)
    return vertices, faces


def convex_mesh(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convex hull of points [P,3] as a mesh whose faces wind counter-clockwise seen from outside."""
    hull = ConvexHull(points)
    index = np.full(len(points), -1)
    used = np.sort(hull.vertices)
    index[used] = np.arange(len(used))
    faces = hull.simplices.copy()
    a, b, c = (points[faces[:, k]] for k in range(3))
    flip = np.einsum("fi,fi->f", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[flip] = faces[flip][:, ::-1]
    return points[used], index[faces].astype(np.int32)


def _outline(part: Part, sections: int) -> np.ndarray:
    """Points whose hull approximates a primitive, in its own frame."""
    angle = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if part.type == BOX:
        return np.array(np.meshgrid(*[[-s, s] for s in part.size])).reshape(3, -1).T
    radius, half = part.size[0], part.size[1]
    if part.type == CYLINDER:
        return np.concatenate([np.c_[circle * radius, np.full(sections, z)] for z in (-half, half)])
    if part.type not in (SPHERE, CAPSULE):
        raise ValueError(f"no outline for geometry type {part.type}")
    lift = half if part.type == CAPSULE else 0.0
    rings = sections // 2
    polar = np.linspace(-np.pi / 2, np.pi / 2, rings + 1 + rings % 2)
    points = [
        np.c_[circle * radius * np.cos(t), np.full(sections, radius * np.sin(t) + np.sign(t) * lift)] for t in polar
    ]
    if lift > 0:
        points += [np.c_[circle * radius, np.full(sections, z)] for z in (-lift, lift)]
    return np.unique(np.concatenate(points).round(9), axis=0)


def part_moments(part: Part) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume (m^3), centroid [3], and inertia [3,3] about the centroid at unit density, in the object frame."""
    if part.type == MESH:
        return mesh_moments(*part_mesh(part))
    a, b, c = part.size
    if part.type == BOX:
        volume, diag = 8 * a * b * c, np.array([b * b + c * c, a * a + c * c, a * a + b * b]) / 3
    elif part.type == SPHERE:
        volume, diag = 4 / 3 * np.pi * a**3, np.full(3, 0.4 * a * a)
    elif part.type == CYLINDER:
        side = (3 * a * a + 4 * b * b) / 12
        volume, diag = 2 * np.pi * a * a * b, np.array([side, side, a * a / 2])
    else:  # capsule: a cylinder and two half spheres
        body, caps = 2 * np.pi * a * a * b, 4 / 3 * np.pi * a**3
        volume = body + caps
        axial = (body * a * a / 2 + caps * 0.4 * a * a) / volume
        side = (body * (3 * a * a + 4 * b * b) / 12 + caps * (0.4 * a * a + b * b + 0.75 * a * b)) / volume
        diag = np.array([side, side, axial])
    rot = quat_to_mat(np.asarray(part.quat))
    return volume, np.asarray(part.pos, dtype=float), rot @ np.diag(volume * diag) @ rot.T


def mesh_moments(vertices: np.ndarray, faces: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume, centroid and inertia about the centroid of a closed mesh at unit density (sums over tetrahedra)."""
    origin = vertices.mean(axis=0)
    a, b, c = (vertices[faces[:, k]] - origin for k in range(3))
    det = np.einsum("fi,fi->f", a, np.cross(b, c))
    volume = det.sum() / 6
    centre = (det[:, None] * (a + b + c)).sum(axis=0) / (24 * volume)
    total = a + b + c
    second = sum(np.einsum("f,fi,fj->ij", det, v, v) for v in (a, b, c, total)) / 120
    second -= volume * np.outer(centre, centre)
    return float(volume), origin + centre, np.trace(second) * np.eye(3) - second


def combined_moments(parts: list[Part]) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume, centroid and inertia about it of all parts together; overlaps count twice."""
    moments = [part_moments(part) for part in parts]
    volume = sum(m[0] for m in moments)
    centre = sum(m[0] * m[1] for m in moments) / volume
    inertia = np.zeros((3, 3))
    for v, c, i in moments:
        d = c - centre
        inertia += i + v * (d @ d * np.eye(3) - np.outer(d, d))
    return volume, centre, inertia  # pyright: ignore[reportReturnType]


def bounds(parts: list[Part]) -> tuple[np.ndarray, np.ndarray]:
    """Axis-aligned bounds (lower [3], upper [3]) of the parts, exact for every type."""
    low, high = [], []
    for part in parts:
        if part.vertices is not None:
            low.append(part.vertices.min(axis=0))
            high.append(part.vertices.max(axis=0))
            continue
        rot = quat_to_mat(np.asarray(part.quat))
        r, h = part.size[0], part.size[1]
        if part.type == BOX:
            reach = np.abs(rot) @ np.asarray(part.size)
        elif part.type == SPHERE:
            reach = np.full(3, r)
        elif part.type == CAPSULE:
            reach = np.abs(rot[:, 2]) * h + r
        else:
            reach = np.abs(rot[:, 2]) * h + r * np.sqrt(np.clip(1 - rot[:, 2] ** 2, 0, None))
        low.append(np.asarray(part.pos) - reach)
        high.append(np.asarray(part.pos) + reach)
    return np.min(low, axis=0), np.max(high, axis=0)


def inside(part: Part, points: np.ndarray, margin: float = 1e-6) -> np.ndarray:
    """Which points [P,3] (object frame) lie more than `margin` inside the part."""
    if part.vertices is not None:
        plane = ConvexHull(part.vertices).equations
        return (points @ plane[:, :3].T + plane[:, 3]).max(axis=1) < -margin
    local = (points - np.asarray(part.pos)) @ quat_to_mat(np.asarray(part.quat))
    r, h = part.size[0], part.size[1]
    if part.type == BOX:
        return (np.abs(local) - np.asarray(part.size)).max(axis=1) < -margin
    if part.type == CYLINDER:
        radial = np.hypot(local[:, 0], local[:, 1]) - r
        return np.maximum(radial, np.abs(local[:, 2]) - h) < -margin
    if part.type == CAPSULE:
        local = local - np.c_[np.zeros((len(local), 2)), np.clip(local[:, 2], -h, h)]
    return np.linalg.norm(local, axis=1) - r < -margin


def surface_samples(parts: list[Part], count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """`count` points [P,3] on the union's surface and their outward normals [P,3], uniform by area."""
    corners, normals = [], []
    owner: list[int] = []
    for k, part in enumerate(parts):
        vertices, faces = part_mesh(part)
        corners.append(vertices[faces])
        owner += [k] * len(faces)
    triangles = np.concatenate(corners)
    owners = np.array(owner)
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.linalg.norm(cross, axis=1)
    normals = cross / np.maximum(area, 1e-20)[:, None]
    pick = rng.choice(len(triangles), size=8 * count, p=area / area.sum())
    u, v = rng.random((2, len(pick), 1))
    fold = (u + v) > 1
    u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
    a, b, c = (triangles[pick, k] for k in range(3))
    points = a + u * (b - a) + v * (c - a)
    hidden = np.zeros(len(points), dtype=bool)
    for k, part in enumerate(parts):
        hidden |= inside(part, points, 1e-5) & (owners[pick] != k)
    shown = np.flatnonzero(~hidden)
    shown = np.resize(shown, count) if len(shown) < count else shown[:count]
    return points[shown], normals[pick][shown]

"""Collision spheres of the robot and the pairs of them that can touch each other (NumPy only).

Every primitive of `geometry.py` is cut into a grid of equal cells and each cell gets the sphere about its corners, less
`COVER_SLACK`: all surface points then lie at most that far outside a sphere. The grid is the coarsest one whose
spheres stick out of the primitive by no more than the allowance of its group.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np

from wbm.robot import joints
from wbm.robot.geometry import BOX, CAPSULE, CYLINDER, SPHERE, Geom
from wbm.robot.model import FIXED, HINGE, SLIDE, RobotModel
from wbm.robot.rotations import quat_to_mat

COVER_SLACK = 0.0045
"""How far (m) a surface point may lie outside every sphere; the promise to users is 5 mm."""

OVERSHOOT: dict[str, tuple[float, float, float]] = {
    "hand": (0.022, 0.022, 0.022),
    "arm": (0.02, 0.02, 0.02),
    "neck": (0.02, 0.02, 0.02),
    "lidar": (0.03, 0.03, 0.03),
    "base": (0.105, 0.105, 0.032),  # the top matters most: tables reach over it
}
"""How far (m) a sphere may stick out of its primitive along x, y, z, by the prefix of the link's name."""

MAX_CELLS = 9
PAIR_REACH = 0.02
"""Sphere pairs that never come nearer than this (m) in the sampled configurations are left out."""

PAIR_SAMPLES = 3072
NEAREST_SLACK = 0.005
ALWAYS_NEAR = 0.6
"""Pairs that overlap in more than this share of the samples are a feature of the covering, not collisions."""


@dataclass(frozen=True, eq=False)
class SphereSet:
    """Spheres fixed to links: `link [S]` int32, `pos [S,3]` (m, link frame), `radius [S]` (m), `names [S]`."""

    link: np.ndarray
    pos: np.ndarray
    radius: np.ndarray
    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.radius)


@cache
def robot_spheres(robot: RobotModel) -> SphereSet:
    """Cover the robot's collision geometry with spheres (see the module's text for the rule)."""
    link, pos, radius, names = [], [], [], []
    for geom in robot.geoms:
        centres, r = cover(geom)
        rot = quat_to_mat(np.asarray(geom.quat))
        for k, centre in enumerate(centres):
            link.append(robot.link(geom.link))
            pos.append(np.asarray(geom.pos) + rot @ centre)
            radius.append(r)
            names.append(f"{geom.name}_{k}")
    return SphereSet(np.array(link, dtype=np.int32), np.array(pos), np.array(radius), tuple(names))


def cover(geom: Geom) -> tuple[np.ndarray, float]:
    """Centres [K,3] (geom frame) and common radius of the spheres that cover one primitive."""
    allowance = next(v for k, v in OVERSHOOT.items() if geom.link.startswith(k))
    if geom.type == SPHERE:
        return np.zeros((1, 3)), geom.size[0]
    if geom.type == CAPSULE:
        return _cover_capsule(geom.size[0], geom.size[1], allowance[0])
    if geom.type == CYLINDER:
        half = np.array([geom.size[0], geom.size[0], geom.size[1]])
        return np.zeros((1, 3)), float(np.hypot(half[0], half[2])) - COVER_SLACK
    if geom.type == BOX:
        return _cover_box(np.asarray(geom.size), allowance)
    raise ValueError(f"robot geom {geom.name}: no sphere covering for geometry type {geom.type}")


def _cover_capsule(radius: float, half: float, allowance: float) -> tuple[np.ndarray, float]:
    """Evenly spaced spheres on the axis; the farthest surface points are the poles and the rims between spheres."""
    for count in range(1, MAX_CELLS + 1):
        if count == 1:
            inset, need = np.array([half]), np.array([radius + half])
        else:
            inset = np.linspace(0.0, half, 128)
            need = np.maximum(radius + inset, np.hypot(radius, (half - inset) / (count - 1)))
        best = int(np.argmin(need))
        covering = max(float(need[best]) - COVER_SLACK, radius)
        if covering - radius <= allowance or count == MAX_CELLS:
            z = np.linspace(-1.0, 1.0, count) * (half - inset[best]) if count > 1 else np.zeros(1)
            return np.stack([np.zeros(count), np.zeros(count), z], axis=1), covering
    raise AssertionError("unreachable: the loop's last count always returns")


def _cover_box(half: np.ndarray, allowance: tuple[float, float, float]) -> tuple[np.ndarray, float]:
    """Fewest grid cells for which the spheres stick out of the faces by at most `allowance`."""
    best: tuple[int, float, tuple[int, int, int]] | None = None
    for grid in product(range(1, 5), repeat=3):
        if np.prod(grid) > MAX_CELLS:
            continue
        cell = half / grid
        radius = float(np.linalg.norm(cell)) - COVER_SLACK
        excess = float(np.max(radius - cell - allowance))
        key = (int(np.prod(grid)) if excess <= 0 else 10_000, excess, grid)
        best = key if best is None else min(best, key)  # pyright: ignore[reportAssignmentType]
    assert best is not None
    grid = np.array(best[2])
    cell = half / grid
    axes = [(np.arange(n) - (n - 1) / 2) * 2 * c for n, c in zip(grid, cell, strict=True)]
    return np.array(list(product(*axes))), float(np.linalg.norm(cell)) - COVER_SLACK


def batched_kinematics(robot: RobotModel, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World rotations [B,L,3,3] and positions [B,L,3] of all links at `q` [B,32]."""
    num, count = len(q), len(robot.link_names)
    rot = np.zeros((num, count, 3, 3))
    pos = np.zeros((num, count, 3))
    rot[:, 0] = np.eye(3)
    local = quat_to_mat(robot.link_quat)
    for i in range(1, count):
        p = robot.parent[i]
        pos[:, i] = pos[:, p] + rot[:, p] @ robot.link_pos[i]
        rot[:, i] = rot[:, p] @ local[i]
        axis = robot.joint_axis[i]
        if robot.joint_type[i] == SLIDE:
            pos[:, i] += (rot[:, i] @ axis) * q[:, robot.joint_index[i], None]
        elif robot.joint_type[i] == HINGE:
            x, y, z = axis
            skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            angle = q[:, robot.joint_index[i], None, None]
            rot[:, i] = rot[:, i] @ (np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * (skew @ skew))
    return rot, pos


def sphere_positions(robot: RobotModel, spheres: SphereSet, q: np.ndarray) -> np.ndarray:
    """World centres [B,S,3] of the spheres at `q` [B,32]."""
    rot, pos = batched_kinematics(robot, q)
    return np.einsum("bsij,sj->bsi", rot[:, spheres.link], spheres.pos) + pos[:, spheres.link]


def sample_configurations(robot: RobotModel, count: int, seed: int = 0) -> np.ndarray:
    """Uniform joint positions [count,32] inside the limits with the base at the origin; row 0 is the home pose."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(robot.q_min, robot.q_max, size=(count, joints.NUM_JOINTS))
    q[:, joints.BASE] = 0.0
    q[0] = robot.q_home
    return q


def moving_joints(robot: RobotModel, a: int, b: int) -> list[int]:
    """Joint indices on the path between links `a` and `b`: what their relative pose depends on."""

    def chain(link: int) -> list[int]:
        path = []
        while link > 0:
            path.append(link)
            link = int(robot.parent[link])
        return path

    up, down = chain(a), chain(b)
    between = set(up) ^ set(down)
    return sorted(int(robot.joint_index[i]) for i in between if robot.joint_type[i] != FIXED)


@cache
def self_pairs(robot: RobotModel, spheres: SphereSet) -> np.ndarray:
    """Pairs [P,2] int32 of sphere indices that the controller must keep apart.

    Neighbouring links never count. Of the others a pair counts when, in some sampled configuration, it is within
    `PAIR_REACH` of touching and is the nearest pair (or within a centimetre of it) between its two rigid groups;
    the rest would only repeat what a nearer pair says. Overlaps of the covering itself do not count.
    """
    pairs = _candidate_pairs(robot, spheres)
    centre = sphere_positions(robot, spheres, sample_configurations(robot, PAIR_SAMPLES)).astype(np.float32)
    reach = (spheres.radius[pairs[:, 0]] + spheres.radius[pairs[:, 1]]).astype(np.float32)
    group = np.array([_group(robot, link) for link in spheres.link])
    _, key = np.unique(np.sort(group[pairs], axis=1), axis=0, return_inverse=True)
    order = np.argsort(key.ravel(), kind="stable")
    pairs, reach, key = pairs[order], reach[order], key.ravel()[order]
    starts = np.flatnonzero(np.r_[True, np.diff(key) > 0])
    needed = np.zeros(len(pairs), dtype=bool)
    overlaps = np.zeros(len(pairs))
    home_gap = None
    for block in np.array_split(centre, PAIR_SAMPLES // 256):
        offset = block[:, pairs[:, 0]] - block[:, pairs[:, 1]]
        gap = np.sqrt(np.einsum("bpi,bpi->bp", offset, offset)) - reach
        home_gap = gap[0] if home_gap is None else home_gap
        nearest = np.minimum.reduceat(gap, starts, axis=1)[:, key]
        needed |= ((gap < PAIR_REACH) & (gap <= nearest + NEAREST_SLACK)).any(axis=0)
        overlaps += (gap < 0).sum(axis=0)
    keep = needed & (overlaps < ALWAYS_NEAR * PAIR_SAMPLES) & (home_gap > 0)  # pyright: ignore[reportOptionalOperand]
    chosen = pairs[keep]
    return chosen[np.lexsort((chosen[:, 1], chosen[:, 0]))].astype(np.int32)


def _group(robot: RobotModel, link: int) -> int:
    """The link that stands for the rigid group: all fixed links of the base, the whole hand, or the link itself."""
    name = robot.link_names[link]
    if name.startswith("hand_"):
        return robot.link("hand_palm")
    while robot.joint_type[link] == FIXED and robot.parent[link] > 0:
        link = int(robot.parent[link])
    return link


def _candidate_pairs(robot: RobotModel, spheres: SphereSet) -> np.ndarray:
    """Pairs on links that are at least two moving joints apart, one of them a controller joint."""
    controlled = set(joints.WBC.tolist())
    allowed = {}
    links = sorted(set(spheres.link.tolist()))
    for i, a in enumerate(links):
        for b in links[i:]:
            path = moving_joints(robot, a, b)
            allowed[a, b] = len(path) >= 2 and bool(controlled & set(path))
    first, second = np.triu_indices(len(spheres), 1)
    la, lb = spheres.link[first], spheres.link[second]
    keep = [allowed[min(x, y), max(x, y)] for x, y in zip(la.tolist(), lb.tolist(), strict=True)]
    return np.stack([first[keep], second[keep]], axis=1)

"""The robot as one kinematic tree with limits, frames and collision geometry (NumPy only), assembled from facts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from wbm.robot import joints
from wbm.robot.facts import Entry, parse_facts, read_facts
from wbm.robot.geometry import Geom, read_geoms
from wbm.robot.parts import Inertial, PartJoint, PartLink, joint_range, part_links
from wbm.robot.rotations import quat_to_mat, unit_quat

FIXED, HINGE, SLIDE = 0, 1, 2

GROUPS = ("arm", "hand", "neck")
"""The groups that are made of parts, in the order in which they are added to the tree."""

FRAMES = ("ee", "palm", "camera", "lidar", "base", "tip_index", "tip_middle", "tip_ring", "tip_thumb")
BASE_LINKS = ("base_x", "base_y", "base")
LIDAR_SIZE = np.array([0.075, 0.075, 0.065])


@dataclass(frozen=True)
class Frame:
    """A named frame fixed to link `link` (index) at `pos` (m), `quat` (w x y z)."""

    link: int
    pos: np.ndarray
    quat: np.ndarray


@dataclass(frozen=True, eq=False)  # identity hash: what derives from a model is cached by it
class RobotModel:
    """Kinematic tree of L links over 32 joints; see `docs/architecture.md` for the meaning of each field.

    Shapes: `parent`, `joint_type`, `joint_index` [L]; `link_pos`, `joint_axis` [L,3]; `link_quat` [L,4] (w x y z);
    limits and gains [32]. Units: m, rad, s, N or N m. `facts`: the user's facts file that it was made of, empty for the
    standard robot.
    """

    link_names: tuple[str, ...]
    parent: np.ndarray
    link_pos: np.ndarray
    link_quat: np.ndarray
    joint_type: np.ndarray
    joint_axis: np.ndarray
    joint_index: np.ndarray
    inertials: tuple[Inertial | None, ...]
    joint_names: tuple[str, ...]
    q_min: np.ndarray
    q_max: np.ndarray
    qd_max: np.ndarray
    qdd_max: np.ndarray
    effort: np.ndarray
    kp: np.ndarray
    kv: np.ndarray
    armature: np.ndarray
    damping: np.ndarray
    frictionloss: np.ndarray
    q_home: np.ndarray
    frames: dict[str, Frame]
    geoms: tuple[Geom, ...]
    facts: bytes = b""

    def link(self, name: str) -> int:
        """Index of a link by name."""
        return self.link_names.index(name)


def load_robot(facts: str | Path = "") -> RobotModel:
    """Assemble base, arm, hand and neck into one model (cached by content: the result is immutable).

    Args:
        facts: a user's facts file, laid over the standard ones; empty for the standard robot.

    Raises:
        OSError: the file cannot be read.
        FactsError: it makes no robot; the message names the field.
    """
    return _assemble(read_facts(facts), str(facts)) if str(facts) else _assemble()


@cache
def _assemble(own: bytes = b"", file: str = "") -> RobotModel:
    facts = parse_facts(own, file)
    tree = _Tree()
    tree.add(PartLink("world", None, np.zeros(3), _IDENTITY, None, None), None)
    _add_base(tree, facts)
    for group in GROUPS:
        name = facts["parts"][group].word()
        links = part_links(facts[name])
        _check_part(facts[name], group, links)
        tree.add_part(group, links, facts["mounts"][group])
    replaced = facts.get("inertials")
    for link in replaced.value if replaced else ():
        if (box := replaced.get(link)) is not None:  # pyright: ignore[reportOptionalMemberAccess]
            tree.links[tree.index(link, box)] = replace(tree.links[tree.index(link, box)], inertial=_solid_box(box))
    return replace(_finish(tree, facts), facts=own)


_IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


class _Tree:
    """Links with full names, parents first, each with its joint's type and index into q."""

    def __init__(self) -> None:
        self.links: list[PartLink] = []
        self.parent: list[int] = []
        self.kind: list[int] = []

    def index(self, name: str, entry: Entry) -> int:
        for i, link in enumerate(self.links):
            if link.name == name:
                return i
        raise entry.error(f"no link is called {name}")

    def add(self, link: PartLink, parent: int | None, kind: int = FIXED) -> None:
        self.links.append(link)
        self.parent.append(-1 if parent is None else parent)
        self.kind.append(kind)

    def add_part(self, group: str, links: tuple[PartLink, ...], mount: Entry) -> None:
        """Hang the links of a part below the mount's link; the mount takes the place of the root's own pose."""
        names = {link.name: len(self.links) + i for i, link in enumerate(links)}
        for link in links:
            joint = replace(link.joint, name=f"{group}_{link.joint.name}") if link.joint else None
            moved = replace(link, name=f"{group}_{link.name}", joint=joint)
            if link.parent is None:
                parent = self.index(mount["link"].word(), mount["link"])
                pos, quat = _pose(mount)
                self.add(replace(moved, pos=pos, quat=quat), parent, HINGE if joint else FIXED)
            else:
                self.add(moved, names[link.parent], HINGE if joint else FIXED)


def _pose(entry: Entry) -> tuple[np.ndarray, np.ndarray]:
    pos, quat = entry.get("pos"), entry.get("quat")
    return pos.vector(3) if pos else np.zeros(3), quat.quat() if quat else _IDENTITY


def _check_part(part: Entry, group: str, links: tuple[PartLink, ...]) -> None:
    expected = [name.removeprefix(f"{group}_") for name in joints.JOINT_NAMES[joints.GROUPS[group]]]
    found = [link.joint.name for link in links if link.joint]
    if sorted(found) != sorted(expected):
        raise part.error(f"a part for {group} must have the joints {', '.join(expected)}; it has {', '.join(found)}")
    if sum(link.parent is None for link in links) != 1:
        raise part["bodies"].error("must be one tree of links")
    if group == "hand":
        needed = {"hand_palm", *joints.FINGER_ROOT.values(), *joints.FINGER_TIP.values()}
        missing = sorted(needed - {f"hand_{link.name}" for link in links})
        if missing:
            raise part.error(f"a hand must have the links {', '.join(m.removeprefix('hand_') for m in missing)}")


def _add_base(tree: _Tree, facts: Entry) -> None:
    """Two massless links slide along x and y, the base turns on them; the LiDAR is fixed to it."""
    body = facts["tidybot2_base"]["parts_aabb_m"]["body"]
    low, high = body["min"].vector(3), body["max"].vector(3)
    mass = facts["tidybot2_base"]["mass"].number(above=0.0)
    for i, (name, joint) in enumerate(zip(BASE_LINKS, joints.JOINT_NAMES[joints.BASE], strict=True)):
        axis = np.eye(3)[i]
        inertial = _box_inertial(mass, (low + high) / 2, high - low) if name == "base" else None
        hinge = PartJoint(joint, axis, np.zeros(2), 0.0, 0.0, 0.0, None, None, None)
        tree.add(PartLink(name, None, np.zeros(3), _IDENTITY, inertial, hinge), i, HINGE if i == 2 else SLIDE)
    mount = facts["mounts"]["lidar"]
    inertial = _box_inertial(facts["unitree_l2"]["mass_kg"].number(above=0.0), np.zeros(3), LIDAR_SIZE)
    lidar = PartLink("lidar_body", None, *_pose(mount), inertial, None)
    tree.add(lidar, tree.index(mount["link"].word(), mount["link"]))


def _finish(tree: _Tree, facts: Entry) -> RobotModel:
    of_joint = {link.joint.name: link.joint for link in tree.links if link.joint}
    published = [of_joint[name] for name in joints.JOINT_NAMES]
    limits = _joint_numbers(facts["joints"], published)
    frames = {}
    for name, entry in facts["frames"].items():
        frames[name] = Frame(tree.index(entry["link"].word(), entry["link"]), *_pose(entry))
    for name in FRAMES:
        facts["frames"][name]  # the rest of the project relies on it
    geoms = read_geoms(facts)
    for geom in geoms:
        if geom.link not in {link.name for link in tree.links[3:]}:
            raise facts["geometry"].error(f"{geom.name}: no link is called {geom.link}")
    return RobotModel(
        link_names=tuple(link.name for link in tree.links),
        parent=np.array(tree.parent, dtype=np.int32),
        link_pos=np.array([link.pos for link in tree.links]),
        # Normalised a second time: the last bits are those that published results were made with.
        link_quat=np.array([unit_quat(link.quat) for link in tree.links]),
        joint_type=np.array(tree.kind, dtype=np.int32),
        joint_axis=np.array([link.joint.axis if link.joint else (0.0, 0.0, 1.0) for link in tree.links]),
        joint_index=np.array(
            [joints.JOINT_NAMES.index(link.joint.name) if link.joint else -1 for link in tree.links], dtype=np.int32
        ),
        inertials=tuple(link.inertial for link in tree.links),
        joint_names=joints.JOINT_NAMES,
        armature=np.array([joint.armature for joint in published]),
        damping=np.array([joint.damping for joint in published]),
        frictionloss=np.array([joint.frictionloss for joint in published]),
        frames=frames,
        geoms=geoms,
        **limits,
    )


def _joint_numbers(facts: Entry, published: list[PartJoint]) -> dict[str, Any]:
    """Limits, gains and home position of all joints, from `joints` and, where that is silent, from the parts."""
    numbers = {key: np.zeros(joints.NUM_JOINTS) for key in ("q_min", "q_max", "kp", "kv", "effort")}
    numbers |= {key: np.zeros(joints.NUM_JOINTS) for key in ("qd_max", "qdd_max", "q_home")}
    for group, part in joints.GROUPS.items():
        entry, own = facts[group], published[part]
        ranges = entry.get("range")
        if ranges is not None and len(ranges.each()) != len(own):
            raise ranges.error(f"must be {len(own)} times [low, high]")
        limits = np.array([joint_range(r) for r in ranges.each()] if ranges else [joint.range for joint in own])
        numbers["q_min"][part], numbers["q_max"][part] = limits.T
        for key in ("kp", "kv", "effort"):
            given = [getattr(joint, key) for joint in own]
            numbers[key][part] = (
                given if entry.get(key) is None and None not in given else _expand(entry[key], len(own))
            )
        for key, name in (("velocity", "qd_max"), ("acceleration", "qdd_max")):
            numbers[name][part] = _expand(entry[key], len(own))
        for name in ("kp", "kv", "effort", "qd_max", "qdd_max"):
            if (numbers[name][part] <= 0).any():
                raise entry.error("gains, effort, velocity and acceleration must be positive")
        home = _expand(entry["home"], len(own))
        for i, (low, high) in enumerate(limits):
            if not low <= home[i] <= high:
                raise entry["home"].error(f"{own[i].name} at {home[i]:g} is outside its range [{low:g}, {high:g}]")
        numbers["q_home"][part] = home
    return numbers


def _expand(entry: Entry, count: int) -> np.ndarray:
    """Numbers [count] from one number for all joints, or a list."""
    return entry.vector(count) if isinstance(entry.value, list) else np.full(count, entry.number())


def _solid_box(entry: Entry) -> Inertial:
    return _box_inertial(entry["mass"].number(above=0.0), entry["com"].vector(3), entry["box"].vector(3))


def _box_inertial(mass: float, com: np.ndarray, size: np.ndarray) -> Inertial:
    s = size**2
    return Inertial(mass, com, np.diag([s[1] + s[2], s[0] + s[2], s[0] + s[1]]) * mass / 12.0)


def forward_kinematics(robot: RobotModel, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World poses of all links, float64: the oracle for the Warp kernels.

    Args:
        q: joint positions [32], m or rad.

    Returns:
        `R_WL` [L,3,3] and `p_WL` [L,3].
    """
    num = len(robot.link_names)
    rot, pos = np.zeros((num, 3, 3)), np.zeros((num, 3))
    rot[0] = np.eye(3)
    local = quat_to_mat(robot.link_quat)
    for i in range(1, num):
        p = robot.parent[i]
        pos[i] = pos[p] + rot[p] @ robot.link_pos[i]
        rot[i] = rot[p] @ local[i]
        if robot.joint_type[i] == SLIDE:
            pos[i] = pos[i] + rot[i] @ (robot.joint_axis[i] * q[robot.joint_index[i]])
        elif robot.joint_type[i] == HINGE:
            rot[i] = rot[i] @ axis_angle_to_mat(robot.joint_axis[i], q[robot.joint_index[i]])  # pyright: ignore[reportArgumentType]
    return rot, pos


def frame_poses(robot: RobotModel, q: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """World pose (R [3,3], p [3]) of every named frame at `q` [32]."""
    rot, pos = forward_kinematics(robot, q)
    return {
        name: (rot[f.link] @ quat_to_mat(f.quat), pos[f.link] + rot[f.link] @ f.pos) for name, f in robot.frames.items()
    }


def axis_angle_to_mat(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' formula for a unit axis [3] and an angle in rad."""
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew

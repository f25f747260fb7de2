"""The links and joints of one part (an arm, a hand, a neck) as its published description gives them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wbm.robot.facts import Entry
from wbm.robot.rotations import quat_to_mat

MAX_LINKS = 64
_IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
_SLACK = 1e-9


@dataclass(frozen=True)
class Inertial:
    """Mass (kg), centre of mass (m) and inertia about it (kg m^2), all in the link frame."""

    mass: float
    com: np.ndarray
    inertia: np.ndarray  # [3,3]


@dataclass(frozen=True)
class PartJoint:
    """A hinge: unit `axis` [3] (link frame), `range` [2] (rad), servo gains, effort limit (N m), and losses.

    `kp`, `kv` and `effort` are None where the description has no actuator that gives them.
    """

    name: str
    axis: np.ndarray
    range: np.ndarray
    armature: float
    damping: float
    frictionloss: float
    kp: float | None
    kv: float | None
    effort: float | None


@dataclass(frozen=True)
class PartLink:
    """One link of a part: its pose in its parent (m, w x y z), inertia and joint."""

    name: str
    parent: str | None
    pos: np.ndarray
    quat: np.ndarray
    inertial: Inertial | None
    joint: PartJoint | None


def part_links(part: Entry) -> tuple[PartLink, ...]:
    """All links of a part, parents first, in the order of the description.

    Raises:
        FactsError: names the field that is missing or wrong.
    """
    links: list[PartLink] = []
    actuators = {a["joint"].word(): a for a in part["actuators"].each()} if part.get("actuators") else {}
    losses = part.get("joint_armature_damping_frictionloss_published")

    def visit(body: Entry, parent: str | None) -> None:
        name = body["name"].word()
        if name in {link.name for link in links}:
            raise body.error(f"a second link called {name}")
        if len(links) == MAX_LINKS:
            raise part.error(f"more than {MAX_LINKS} links")
        pos, quat, joint = body.get("pos"), body.get("quat"), body.get("joint")
        links.append(
            PartLink(
                name=name,
                parent=parent,
                pos=pos.vector(3) if pos else np.zeros(3),
                quat=quat.quat() if quat else _IDENTITY,
                inertial=_inertial(body.get("inertial")),
                joint=_joint(joint, losses, actuators) if joint else None,
            )
        )
        children = body.get("children")
        for child in children.each() if children else ():
            visit(child, name)

    for body in part["bodies"].each():
        visit(body, None)
    return tuple(links)


def _joint(joint: Entry, losses: Entry | None, actuators: dict[str, Entry]) -> PartJoint:
    name, axis = joint["name"].word(), joint["axis"].vector(3)
    kind = joint.get("type")
    if kind is not None and kind.word() != "hinge":
        raise kind.error("must be hinge: arms, hands and necks turn")
    if abs(np.linalg.norm(axis) - 1) > 1e-6:
        raise joint["axis"].error("must be a unit vector")
    actuator = actuators.get(name)

    def loss(key: str) -> float:
        entry = joint.get(key) or (losses.get(key) if losses else None)
        return entry.number(above=-_SLACK) if entry else 0.0

    def servo(key: str, mjcf: str, column: int, count: int, sign: float) -> float | None:
        if actuator is None:
            return None
        plain, general = actuator.get(key), actuator.get(mjcf)
        if plain is not None:
            return plain.number(above=0.0)
        return sign * float(general.vector(count)[column]) if general else None

    return PartJoint(
        name=name,
        axis=axis,
        range=joint_range(joint["range"]),
        armature=loss("armature"),
        damping=loss("damping"),
        frictionloss=loss("frictionloss"),
        kp=servo("kp", "gainprm", 0, 1, 1.0),
        kv=servo("kv", "biasprm", 2, 3, -1.0),
        effort=servo("effort", "forcerange", 1, 2, 1.0),
    )


def joint_range(entry: Entry) -> np.ndarray:
    """Limits [2] of a joint, low first.

    Raises:
        FactsError: not two numbers in order.
    """
    limits = entry.vector(2)
    if not limits[0] < limits[1]:
        raise entry.error("must be [low, high], low first")
    return limits


def _inertial(entry: Entry | None) -> Inertial | None:
    if entry is None:
        return None
    mass, com = entry["mass"].number(above=0.0), entry["com"].vector(3)
    if entry.get("fullinertia"):  # xx yy zz xy xz yz
        xx, yy, zz, xy, xz, yz = entry["fullinertia"].vector(6)
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    else:
        quat = entry.get("quat")
        rot = quat_to_mat(quat.quat() if quat else _IDENTITY)
        inertia = rot @ np.diag(entry["diaginertia"].vector(3)) @ rot.T
    moments = np.linalg.eigvalsh(inertia)
    if moments[0] <= 0 or moments[0] + moments[1] < moments[2] * (1 - 1e-6):
        raise entry.error("no body has this inertia: moments must be positive and none above the sum of the others")
    return Inertial(mass, com, inertia)

"""Reads the published kinematic and inertial facts of the platform's parts."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

FACTS_PATH = Path(__file__).with_name("facts.yaml")
_IDENTITY = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Inertial:
    """Mass (kg), centre of mass (m) and inertia about it (kg m^2), all in the link frame."""

    mass: float
    com: np.ndarray
    inertia: np.ndarray  # [3,3]


@dataclass(frozen=True)
class PartLink:
    """One link of a published description: its pose in its parent, joint and inertia."""

    name: str
    parent: str | None
    pos: np.ndarray
    quat: np.ndarray  # w x y z, unit
    inertial: Inertial | None
    joint: dict[str, Any] | None
    boxes: tuple[dict[str, Any], ...] = field(default=())


@cache
def load_facts(path: Path = FACTS_PATH) -> dict[str, Any]:
    """Parse a facts file.

    Raises:
        FileNotFoundError: the file does not exist.
    """
    with open(path, encoding="utf-8") as stream:
        return yaml.load(stream, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))


def unit_quat(quat: Any) -> np.ndarray:
    """Return `quat` (w x y z) scaled to unit length, as MuJoCo does on load."""
    q = np.asarray(quat, dtype=np.float64)
    return q / np.linalg.norm(q)


def quat_to_mat(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix [...,3,3] of a unit quaternion [...,4] (w x y z)."""
    w, x, y, z = np.moveaxis(np.asarray(quat, dtype=np.float64), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def part_links(part: str, path: Path = FACTS_PATH) -> tuple[PartLink, ...]:
    """All links of a part, parents first, in published order."""
    links: list[PartLink] = []

    def visit(node: dict[str, Any], parent: str | None) -> None:
        links.append(
            PartLink(
                name=node["name"],
                parent=parent,
                pos=np.asarray(node.get("pos", (0.0, 0.0, 0.0)), dtype=np.float64),
                quat=unit_quat(node.get("quat", _IDENTITY)),
                inertial=_inertial(node.get("inertial")),
                joint=node.get("joint"),
                boxes=tuple(node.get("primitive_geoms", ())),
            )
        )
        for child in node.get("children", ()):
            visit(child, node["name"])

    for body in load_facts(path)[part]["bodies"]:
        visit(body, None)
    return tuple(links)


def _inertial(node: dict[str, Any] | None) -> Inertial | None:
    if node is None:
        return None
    if "fullinertia" in node:  # xx yy zz xy xz yz
        xx, yy, zz, xy, xz, yz = node["fullinertia"]
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    else:
        rot = quat_to_mat(unit_quat(node.get("quat", _IDENTITY)))
        inertia = rot @ np.diag(node["diaginertia"]) @ rot.T
    return Inertial(float(node["mass"]), np.asarray(node["com"], dtype=np.float64), inertia)

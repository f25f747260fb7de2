"""Primitive collision geometry of the platform, one list for physics, controller spheres and sensors.

Types and sizes use MuJoCo's numbers and half sizes; what there is stands in `platform.yaml`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wbm.robot.facts import Entry

SPHERE, CAPSULE, CYLINDER, BOX = 2, 3, 5, 6
_SHAPES = ("sphere", "capsule", "cylinder", "box")


@dataclass(frozen=True)
class Geom:
    """A primitive fixed to a link: `pos` (m), `quat` (w x y z) in the link frame, `size` as MuJoCo means it."""

    name: str
    link: str
    type: int
    size: tuple[float, float, float]
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    rgb: tuple[float, float, float] = (0.6, 0.6, 0.62)


def read_geoms(facts: Entry) -> tuple[Geom, ...]:
    """Collision geometry of base, arm, hand and neck, in the order of the file.

    Raises:
        FactsError: names the field that is missing or wrong.
    """
    geoms: list[Geom] = []
    for _, group in facts["geometry"].items():
        for entry in group.each():
            geom = _geom(entry)
            if geom.name in {other.name for other in geoms}:
                raise entry.error(f"a second geom called {geom.name}")
            geoms.append(geom)
    return tuple(geoms)


def _geom(entry: Entry) -> Geom:
    shapes = [shape for shape in _SHAPES if entry.get(shape)]
    if len(shapes) != 1:
        raise entry.error(f"must have one of {', '.join(_SHAPES)}")
    name, link, size = entry["name"].word(), entry["link"].word(), entry[shapes[0]]
    pos, quat, rgb = entry.get("pos"), entry.get("quat"), entry.get("rgb")
    color = _numbers(rgb.vector(3)) if rgb else Geom.rgb
    if shapes[0] == "capsule":
        ends = entry["from"].vector(3), entry["to"].vector(3)
        if np.linalg.norm(ends[1] - ends[0]) < 1e-6:
            raise entry["to"].error("must differ from `from`; use a sphere")
        return _between(name, link, *ends, size.number(above=0.0), color)
    if shapes[0] == "sphere":
        kind, half = SPHERE, (size.number(above=0.0), 0.0, 0.0)
    elif shapes[0] == "cylinder":
        kind, half = CYLINDER, (*_numbers(size.vector(2)), 0.0)
    else:
        kind, half = BOX, _numbers(size.vector(3))
    if min(half[: {SPHERE: 1, CYLINDER: 2, BOX: 3}[kind]]) <= 0:
        raise size.error("half sizes must be positive")
    at = _numbers(pos.vector(3)) if pos else Geom.pos
    return Geom(name, link, kind, half, at, _numbers(quat.quat()) if quat else Geom.quat, color)  # pyright: ignore[reportArgumentType]


def _between(name: str, link: str, start: np.ndarray, end: np.ndarray, radius: float, rgb: tuple) -> Geom:
    """Capsule of the given radius whose axis runs from `start` to `end` (m, link frame)."""
    axis = end - start
    length = float(np.linalg.norm(axis))
    axis = axis / length
    # Shortest rotation that takes z onto the axis; for the antiparallel axis any half turn does.
    quat = np.array([1.0 + axis[2], -axis[1], axis[0], 0.0])
    quat = np.array([0.0, 1.0, 0.0, 0.0]) if np.linalg.norm(quat) < 1e-9 else quat / np.linalg.norm(quat)
    return Geom(name, link, CAPSULE, (radius, length / 2, 0.0), _numbers((start + end) / 2), _numbers(quat), rgb)


def _numbers(values: np.ndarray) -> tuple:
    return tuple(float(v) for v in values)

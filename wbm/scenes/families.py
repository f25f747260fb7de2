"""Procedural object families: each draws one graspable object from a random generator.

Sizes are metres. Every family stands on its lowest face in the object frame (z up), so the identity is a rest pose.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from wbm.scenes.parts import BOX, CAPSULE, CYLINDER, SPHERE, Part, hull_part

LYING = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)  # the part's z axis along the object's x


@dataclass(frozen=True)
class Draft:
    """What a family draws: parts, and the share of the volume that is solid (hollow things are lighter)."""

    parts: list[Part]
    fill: float = 1.0


Family = Callable[[np.random.Generator], Draft]
FAMILIES: dict[str, Family] = {}


def family(noun: str) -> Callable[[Family], Family]:
    """Register a family under the noun that instructions use for it."""

    def register(function: Family) -> Family:
        FAMILIES[noun] = function
        return function

    return register


def _cylinder(radius: float, low: float, high: float) -> Part:
    return Part(CYLINDER, (radius, (high - low) / 2, 0.0), (0.0, 0.0, (low + high) / 2))


def _box(size: tuple[float, float, float], pos: tuple[float, float, float]) -> Part:
    return Part(BOX, (size[0] / 2, size[1] / 2, size[2] / 2), pos)


def _ring(radius: float, z: float, count: int, phase: float = 0.0) -> np.ndarray:
    angle = phase + np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, z)], axis=1)


def _wall(inner: tuple[float, float], outer: tuple[float, float], z: tuple[float, float], pieces: int) -> list[Part]:
    """A hollow frustum as `pieces` convex wedges; radii and heights are given at the bottom and the top."""
    parts = []
    for k in range(pieces):
        angle = 2 * np.pi * np.array([k, k + 0.25, k + 0.5, k + 0.75, k + 1]) / pieces
        unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        rims = [np.c_[unit * r, np.full(len(unit), h)] for r, h in zip((*inner, *outer), (*z, *z), strict=True)]
        parts.append(hull_part(np.concatenate(rims)))
    return parts


@family("box")
def box(rng: np.random.Generator) -> Draft:
    size = (rng.uniform(0.035, 0.075), rng.uniform(0.04, 0.10), rng.uniform(0.04, 0.15))
    return Draft([_box(size, (0, 0, size[2] / 2))], 0.6)


@family("cylinder")
def cylinder(rng: np.random.Generator) -> Draft:
    return Draft([_cylinder(rng.uniform(0.018, 0.038), 0, rng.uniform(0.06, 0.15))], 0.7)


@family("capsule")
def capsule(rng: np.random.Generator) -> Draft:
    radius = rng.uniform(0.02, 0.034)
    return Draft([Part(CAPSULE, (radius, rng.uniform(0.02, 0.05), 0.0), (0, 0, radius), LYING)])


@family("ball")
def ball(rng: np.random.Generator) -> Draft:
    radius = rng.uniform(0.024, 0.04)
    return Draft([Part(SPHERE, (radius, 0.0, 0.0), (0, 0, radius))], 0.6)


@family("bottle")
def bottle(rng: np.random.Generator) -> Draft:
    radius, body = rng.uniform(0.022, 0.036), rng.uniform(0.08, 0.13)
    neck, top = radius * rng.uniform(0.35, 0.5), rng.uniform(0.03, 0.05)
    shoulder = Part(SPHERE, (radius * 0.98, 0.0, 0.0), (0, 0, body))
    return Draft([_cylinder(radius, 0, body), shoulder, _cylinder(neck, body, body + radius + top)], 0.6)


@family("can")
def can(rng: np.random.Generator) -> Draft:
    radius, height = rng.uniform(0.025, 0.036), rng.uniform(0.07, 0.125)
    inset = radius * 0.9
    return Draft([_cylinder(inset, 0, height), _cylinder(radius, 0.005, height - 0.005)], 0.45)


@family("jar")
def jar(rng: np.random.Generator) -> Draft:
    radius, height = rng.uniform(0.025, 0.036), rng.uniform(0.05, 0.09)
    lid = radius * rng.uniform(0.8, 1.08)
    return Draft([_cylinder(radius, 0, height), _cylinder(lid, height, height + rng.uniform(0.012, 0.022))], 0.6)


@family("mug")
def mug(rng: np.random.Generator) -> Draft:
    radius, height = rng.uniform(0.034, 0.042), rng.uniform(0.07, 0.10)
    wall, floor = 0.005, 0.006
    parts = _wall((radius - wall,) * 2, (radius,) * 2, (floor, height), 5)  # pyright: ignore[reportArgumentType]
    parts.append(_cylinder(radius, 0, floor))
    reach, grip = rng.uniform(0.022, 0.03), rng.uniform(0.4, 0.55) * height
    top = 0.5 * (height + grip)
    parts.append(_box((reach, 0.012, 0.01), (radius + reach / 2 - 0.002, 0, top - 0.005)))
    parts.append(_box((0.01, 0.012, grip), (radius + reach - 0.005, 0, top - grip / 2)))
    return Draft(parts)


@family("bowl")
def bowl(rng: np.random.Generator) -> Draft:
    top, height = rng.uniform(0.042, 0.056), rng.uniform(0.035, 0.055)
    bottom, wall, floor = top * rng.uniform(0.5, 0.7), 0.006, 0.008
    parts = _wall((bottom - wall, top - wall), (bottom, top), (floor * 0.9, height), 6)
    parts.append(hull_part(np.concatenate([_ring(bottom * 0.92, 0, 16), _ring(bottom, floor, 16)])))
    return Draft(parts)


@family("pebble")
def superquadric(rng: np.random.Generator) -> Draft:
    """A superellipsoid with a blunt bottom; exponents below 2 keep it convex."""
    half = np.array([rng.uniform(0.022, 0.038), rng.uniform(0.025, 0.045), rng.uniform(0.022, 0.06)])
    polar_power, round_power = rng.uniform(0.15, 0.4), rng.uniform(0.3, 1.5)

    def power(value: np.ndarray, exponent: float) -> np.ndarray:
        return np.sign(value) * np.abs(value) ** exponent

    polar = np.linspace(-np.pi / 2, np.pi / 2, 7)[1:-1]
    points = []
    for t in polar:
        angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
        rim = power(np.cos(t), polar_power)
        ring = [rim * power(np.cos(angle), round_power), rim * power(np.sin(angle), round_power)]
        points.append(np.stack([*ring, np.full(len(angle), power(np.sin(t), polar_power))], axis=1))
    cloud = np.concatenate(points) * half
    cloud[:, 2] -= cloud[:, 2].min()
    return Draft([hull_part(cloud)], 0.8)


@family("block")
def compound(rng: np.random.Generator) -> Draft:
    """Two or three boxes that form an L, a T or a step."""
    width, thick = rng.uniform(0.035, 0.06), rng.uniform(0.025, 0.04)
    length, height = rng.uniform(0.07, 0.11), rng.uniform(0.07, 0.11)
    parts = [_box((length, width, thick), (0, 0, thick / 2))]
    shape = rng.integers(3)
    offset = 0.0 if shape == 1 else (length - thick) / 2
    upright = height - thick
    parts.append(_box((thick, width, upright), (offset, 0, thick + upright / 2)))
    if shape == 2:
        step = upright / 2
        parts.append(_box((thick, width, step), (offset - thick, 0, thick + step / 2)))
    return Draft(parts, 0.7)


@family("carton")
def carton(rng: np.random.Generator) -> Draft:
    width, depth, height = rng.uniform(0.045, 0.07), rng.uniform(0.05, 0.075), rng.uniform(0.08, 0.12)
    roof = rng.uniform(0.02, 0.035)
    a, b = width / 2, depth / 2
    gable = [(sx * a, sy * b, height) for sx in (-1, 1) for sy in (-1, 1)]
    gable += [(sx * 0.004, sy * b, height + roof) for sx in (-1, 1) for sy in (-1, 1)]
    return Draft([_box((width, depth, height), (0, 0, height / 2)), hull_part(np.array(gable))], 0.45)


@family("prism")
def prism(rng: np.random.Generator) -> Draft:
    sides, radius = int(rng.choice([3, 5, 6, 8])), rng.uniform(0.025, 0.04)
    height, taper = rng.uniform(0.06, 0.13), rng.uniform(0.8, 1.0)
    return Draft([hull_part(np.concatenate([_ring(radius, 0, sides), _ring(radius * taper, height, sides)]))], 0.7)


@family("cup")
def cup(rng: np.random.Generator) -> Draft:
    bottom, height = rng.uniform(0.022, 0.03), rng.uniform(0.07, 0.12)
    top = bottom * rng.uniform(1.15, 1.4)
    return Draft([hull_part(np.concatenate([_ring(bottom, 0, 16), _ring(top, height, 16)]))], 0.4)


@family("dumbbell")
def dumbbell(rng: np.random.Generator) -> Draft:
    bar, end = rng.uniform(0.05, 0.09), rng.uniform(0.045, 0.06)
    thick, radius = rng.uniform(0.02, 0.03), rng.uniform(0.012, 0.018)
    parts = [Part(CAPSULE, (radius, bar / 2, 0.0), (0, 0, end / 2), LYING)]
    parts += [_box((thick, end, end), (side * (bar + thick) / 2, 0, end / 2)) for side in (-1, 1)]
    return Draft(parts, 0.6)


@family("hammer")
def hammer(rng: np.random.Generator) -> Draft:
    length, thick = rng.uniform(0.10, 0.14), rng.uniform(0.024, 0.032)
    head, deep = rng.uniform(0.07, 0.10), rng.uniform(0.03, 0.04)
    handle = _box((length, thick, thick), (0, 0, thick / 2))
    return Draft([handle, _box((deep, head, deep), (length / 2, 0, deep / 2))], 0.7)


@family("torch")
def torch(rng: np.random.Generator) -> Draft:
    grip, head = rng.uniform(0.016, 0.022), rng.uniform(0.026, 0.034)
    length, deep = rng.uniform(0.06, 0.1), rng.uniform(0.03, 0.045)
    cone = np.concatenate([_ring(head, deep, 16), _ring(grip, deep + 0.02, 16)])
    return Draft([_cylinder(head, 0, deep), hull_part(cone), _cylinder(grip, deep + 0.02, deep + 0.02 + length)], 0.7)

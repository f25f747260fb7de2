"""Draws named, coloured, weighed objects from the procedural families, with their split."""

from __future__ import annotations

import numpy as np

from wbm.scenes.config import ObjectsConfig
from wbm.scenes.families import FAMILIES, Draft
from wbm.scenes.objects import ObjectEntry
from wbm.scenes.parts import BOX, IDENTITY, bounds, combined_moments

COLORS: dict[str, tuple[float, float, float]] = {
    "red": (0.80, 0.12, 0.12),
    "green": (0.15, 0.60, 0.20),
    "blue": (0.13, 0.27, 0.78),
    "yellow": (0.92, 0.80, 0.12),
    "orange": (0.93, 0.47, 0.08),
    "purple": (0.47, 0.18, 0.60),
    "pink": (0.93, 0.50, 0.66),
    "white": (0.93, 0.93, 0.92),
    "black": (0.09, 0.09, 0.10),
    "brown": (0.42, 0.26, 0.14),
    "cyan": (0.15, 0.72, 0.78),
}
SIZE_WORDS = ("tall", "flat", "large", "small")
_HALF = np.sqrt(0.5)
SIDEWAYS = ((_HALF, _HALF, 0.0, 0.0), (_HALF, 0.0, _HALF, 0.0))


def draw_objects(cfg: ObjectsConfig, seed: int) -> list[ObjectEntry]:
    """`cfg.count` objects, the families in turn; object k depends on (seed, k) alone."""
    nouns = [noun for noun in cfg.families or tuple(FAMILIES)]
    unknown = [noun for noun in (*nouns, *cfg.held_out) if noun not in FAMILIES]
    if unknown:
        raise ValueError(f"objects.families: unknown {', '.join(unknown)}; known: {', '.join(FAMILIES)}")
    return [draw_object(nouns[k % len(nouns)], k, seed, cfg) for k in range(cfg.count)]


def draw_object(noun: str, index: int, seed: int, cfg: ObjectsConfig) -> ObjectEntry:
    """Object `index` of family `noun`."""
    rng = np.random.default_rng([seed, index, 0x0B1])
    draft = FAMILIES[noun](rng)
    color = list(COLORS)[rng.integers(len(COLORS))]
    rgb = np.clip(np.array(COLORS[color]) + rng.normal(0, 0.02, 3), 0.02, 0.98)
    return ObjectEntry(
        name=f"{color}_{noun}_{index:04d}",
        noun=noun,
        family=noun,
        color=color,
        size_word=size_word(draft),
        rgb=tuple(rgb),
        parts=draft.parts,
        mass=draw_mass(draft, rng, cfg),
        split=draw_split(noun, rng, cfg),
        rests=rest_poses(noun, draft),
        seed=int(rng.integers(2**31)),
    )


def draw_mass(draft: Draft, rng: np.random.Generator, cfg: ObjectsConfig) -> float:
    """Volume times a random density (kg), within the configured bounds."""
    volume = combined_moments(draft.parts)[0] * draft.fill
    return float(np.clip(volume * rng.uniform(*cfg.density), *cfg.mass))


def draw_split(noun: str, rng: np.random.Generator, cfg: ObjectsConfig) -> str:
    """Held-out families are all test; the others are divided by the object's own random draw."""
    u = rng.random()
    if noun in cfg.held_out:
        return "test"
    return "test" if u < cfg.test_share else "val" if u < cfg.test_share + cfg.val_share else "train"


def size_word(draft: Draft) -> str:
    """`tall`, `flat`, `large`, `small` or nothing, from the bounds (m)."""
    low, high = bounds(draft.parts)
    extent = high - low
    aspect = extent[2] / max(extent[0], extent[1])
    if aspect > 1.9:
        return "tall"
    if aspect < 0.45:
        return "flat"
    volume = float(np.prod(extent))
    return "large" if volume > 6.5e-4 else "small" if volume < 2.2e-4 else ""


def rest_poses(noun: str, draft: Draft) -> list[tuple[float, float, float, float]]:
    """Orientations in which the object may be put down; boxes also lie on their sides."""
    if noun == "box" and draft.parts[0].type == BOX:
        return [IDENTITY, *SIDEWAYS]
    return [IDENTITY]

"""Tables, shelves and bins as boxes.

All are drawn in the support frame: x points into the support from its front edge, y to the left, z up from the floor;
the robot stands at negative x.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wbm.scenes.config import ScenesConfig

BOARD = 0.02
SLAB = 0.05
WALL = 0.012


@dataclass(frozen=True)
class Layout:
    """Boxes `pos [B,3]`, half `size [B,3]`; the resting surface and where objects may stand on it (support frame, m).

    Attributes:
        surface_z, ceiling_z: heights of the resting surface and of what is above it (inf where nothing is).
        low, high: corners [2] of the area for objects' footprints.
        target_low, target_high: corners [2] of the area for the target's centre.
        wall_gap: free space kept around a footprint at the area's border.
    """

    pos: np.ndarray
    size: np.ndarray
    surface_z: float
    ceiling_z: float
    low: np.ndarray
    high: np.ndarray
    target_low: np.ndarray
    target_high: np.ndarray
    wall_gap: float


def draw_layout(kind: str, rng: np.random.Generator, cfg: ScenesConfig) -> Layout:
    """One support of the given kind with random dimensions."""
    return LAYOUTS[kind](rng, cfg)


def _boxes(rows: list[tuple[tuple[float, ...], tuple[float, ...]]]) -> dict[str, np.ndarray]:
    """Rows of (lower corner, upper corner) as centres and half sizes."""
    low, high = np.array([r[0] for r in rows]), np.array([r[1] for r in rows])
    return {"pos": (low + high) / 2, "size": (high - low) / 2}


def _top_on_pedestal(rng: np.random.Generator, depth: float, width: float, top: float) -> list:
    """A slab, and a pedestal set back so that the base can drive partly under."""
    back = rng.uniform(0.30, 0.36)
    half = width * rng.uniform(0.2, 0.35)
    slab = ((0.0, -width / 2, top - SLAB), (depth, width / 2, top))
    return [slab, ((back, -half, 0.0), (depth - 0.03, half, top - SLAB))]


def _table(rng: np.random.Generator, cfg: ScenesConfig) -> Layout:
    depth, width, top = rng.uniform(0.55, 0.8), rng.uniform(0.8, 1.4), rng.uniform(*cfg.table_height)
    side = min(0.45, width / 2)
    return Layout(
        **_boxes(_top_on_pedestal(rng, depth, width, top)),
        surface_z=top,
        ceiling_z=np.inf,
        low=np.array([0.0, -side]),
        high=np.array([min(depth, 0.55), side]),
        target_low=np.array([cfg.target_depth[0], -0.2]),
        target_high=np.array([cfg.target_depth[1], 0.2]),
        wall_gap=0.02,
    )


def _shelf(rng: np.random.Generator, cfg: ScenesConfig) -> Layout:
    depth, width = rng.uniform(0.34, 0.45), rng.uniform(0.75, 1.1)
    top, clear = rng.uniform(*cfg.shelf_height), rng.uniform(*cfg.shelf_clearance)
    side, roof = width / 2, top + clear
    lower = max(top - rng.uniform(0.3, 0.4), 0.08)
    inner = side - BOARD
    boards = [((0.0, -inner, z - BOARD), (depth, inner, z)) for z in (top, lower, roof + BOARD)]
    walls = [
        ((0.0, -side, 0.0), (depth, -inner, roof + BOARD)),
        ((0.0, inner, 0.0), (depth, side, roof + BOARD)),
        ((depth, -side, 0.0), (depth + BOARD, side, roof + BOARD)),
    ]
    return Layout(
        **_boxes(boards + walls),
        surface_z=top,
        ceiling_z=roof,
        low=np.array([0.0, -inner]),
        high=np.array([depth, inner]),
        target_low=np.array([0.07, -min(0.18, inner - 0.15)]),
        target_high=np.array([min(cfg.target_depth[1], depth - 0.18), min(0.18, inner - 0.15)]),
        wall_gap=0.01,
    )


def _bin(rng: np.random.Generator, cfg: ScenesConfig) -> Layout:
    inner = np.array([rng.uniform(0.34, 0.42), rng.uniform(0.34, 0.5)])
    wall, front = rng.uniform(0.08, 0.14), rng.uniform(0.03, 0.08)
    top = rng.uniform(*cfg.bin_table_height)
    depth, width = front + inner[0] + 2 * WALL + rng.uniform(0.03, 0.2), inner[1] + rng.uniform(0.1, 0.5)
    a, b, y = front + WALL, front + WALL + inner[0], inner[1] / 2
    walls = [
        ((front, -y - WALL, top), (a, y + WALL, top + wall)),
        ((b, -y - WALL, top), (b + WALL, y + WALL, top + wall)),
        ((a, -y - WALL, top), (b, -y, top + wall)),
        ((a, y, top), (b, y + WALL, top + wall)),
    ]
    margin = 0.11  # a hand with its fingers around an object needs this much from its centre to a wall
    return Layout(
        **_boxes(_top_on_pedestal(rng, depth, width, top) + walls),
        surface_z=top,
        ceiling_z=np.inf,
        low=np.array([a, -y]),
        high=np.array([b, y]),
        target_low=np.array([a + margin, -y + margin]),
        target_high=np.array([b - margin, y - margin]),
        wall_gap=0.008,
    )


LAYOUTS = {"table": _table, "shelf": _shelf, "bin": _bin}
"""How each kind of `config.KINDS` is drawn."""

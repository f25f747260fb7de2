"""Sorting of a sensor's rays into bundles of neighbours with bounding cones (done once, on the host)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BUNDLE = 32
GROUP, SUBGROUP = 16, 4  # bundles that are culled together first, and next
PART = 8  # rays of a bundle that are traced together


@dataclass(frozen=True)
class RayTable:
    """Q interchangeable patterns of R unit rays in G bundles, sensor frame.

    Attributes:
        rays: unit directions [Q,R,3] in the order of the outputs.
        order: [Q,R] index of the output ray at each place of the bundle order.
        cone: [Q,G,4] axis and cosine of the half angle of each bundle; zeros where it is not narrow.
        group_cone: [Q,ceil(G/GROUP),4] the same around `GROUP` consecutive bundles; subgroup_cone: around `SUBGROUP`.
        part_cone: [Q,ceil(R/part),4] the same around the parts of bundles.
        view: axis [3] and half angle (rad) of a cone that holds all rays of all patterns.
    """

    rays: np.ndarray
    order: np.ndarray
    cone: np.ndarray
    group_cone: np.ndarray
    subgroup_cone: np.ndarray
    part_cone: np.ndarray
    view: tuple[np.ndarray, float]


def common_part(chunk: int) -> int:
    """Rays of a part: the largest number up to `PART` that divides `chunk`."""
    return next(k for k in range(min(PART, chunk), 0, -1) if chunk % k == 0)


def build_table(rays: np.ndarray, bundle: int = BUNDLE, part: int = 1) -> RayTable:
    """Bundle every pattern of `rays` [Q,R,3] (unit), with `part` consecutive rays of a bundle close together."""
    rays = np.asarray(rays, np.float64)
    order = np.stack([_nested(r, bundle, part) for r in rays]).astype(np.int32)
    ordered = np.take_along_axis(rays, order[:, :, None].astype(np.int64), axis=1)
    cone, group, subgroup, parts = (_cones(ordered, n) for n in (bundle, bundle * GROUP, bundle * SUBGROUP, part))
    return RayTable(rays, order, cone, group, subgroup, parts, _cone(rays.reshape(-1, 3)))


def _nested(rays: np.ndarray, bundle: int, part: int) -> np.ndarray:
    """Order in which every `bundle` rays are neighbours and, within them, every `part` rays."""
    order = _split(rays, bundle)
    blocks = [order[k : k + bundle] for k in range(0, len(order), bundle)]
    return np.concatenate([block[_split(rays[block], part)] for block in blocks])


def _cones(rays: np.ndarray, size: int) -> np.ndarray:
    """Axis and cosine of the half angle [Q,ceil(R/size),4] around every `size` consecutive rays [Q,R,3]; else zeros."""
    out = np.empty((len(rays), -(-rays.shape[1] // size), 4))
    for q, pattern in enumerate(rays):
        for g in range(out.shape[1]):
            axis, half = _cone(pattern[g * size : (g + 1) * size])
            out[q, g] = [*axis, np.cos(half)] if half < np.pi / 2 else np.zeros(4)
    return out


def _cone(rays: np.ndarray) -> tuple[np.ndarray, float]:
    """Axis and half angle of a cone around unit rays, widened by a float32 margin; pi when there is no narrow one."""
    axis = (rays.min(0) + rays.max(0)) / 2
    norm = np.linalg.norm(axis)
    if norm < 1e-6:
        return np.array([0.0, 0.0, 1.0]), np.pi
    axis = axis / norm
    half = float(np.arccos(np.clip((rays @ axis).min(), -1.0, 1.0))) + 1e-3
    return (axis, half) if half < np.pi / 2 else (axis, np.pi)


def _split(rays: np.ndarray, bundle: int) -> np.ndarray:
    """Order that halves the rays along their widest axis until a bundle is left; all bundles but the last are full."""
    stack, out = [np.arange(len(rays))], []
    while stack:
        part = stack.pop()
        if len(part) <= bundle:
            out.append(part)
            continue
        spread = np.ptp(rays[part], axis=0)
        part = part[np.argsort(rays[part, int(np.argmax(spread))], kind="stable")]
        cut = max(len(part) // bundle // 2, 1) * bundle
        stack += [part[cut:], part[:cut]]
    return np.concatenate(out)

"""Primitive collision geometry of the platform, one list for physics, controller spheres and sensors.

Panda capsules follow the coarse collision model that Franka publishes in franka_description; LEAP boxes bound the
published primitive geoms link by link; PiPER capsules follow its link axes; the base boxes are the bounds of its
published meshes. Types and sizes use MuJoCo's numbers and half sizes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SPHERE, CAPSULE, CYLINDER, BOX = 2, 3, 5, 6


@dataclass(frozen=True)
class Geom:
    """A primitive fixed to a link: `pos` (m), `quat` (w x y z) in the link frame, `size` as MuJoCo means it."""

    name: str
    link: str
    type: int
    size: tuple[float, float, float]
    pos: tuple[float, float, float]
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    rgb: tuple[float, float, float] = (0.6, 0.6, 0.62)


def _between(name: str, link: str, start: tuple, end: tuple, radius: float, rgb: tuple) -> Geom:
    """Capsule of the given radius whose axis runs from `start` to `end` (m, link frame)."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    axis = b - a
    length = float(np.linalg.norm(axis))
    axis = axis / length
    # Shortest rotation that takes z onto the axis; for the antiparallel axis any half turn does.
    quat = np.array([1.0 + axis[2], -axis[1], axis[0], 0.0])
    quat = np.array([0.0, 1.0, 0.0, 0.0]) if np.linalg.norm(quat) < 1e-9 else quat / np.linalg.norm(quat)
    pos = (a + b) / 2
    return Geom(name, link, CAPSULE, (radius, length / 2, 0.0), tuple(pos), tuple(quat), rgb)


_WHITE, _DARK, _GREEN, _GREY = (0.92, 0.92, 0.93), (0.18, 0.18, 0.2), (0.25, 0.45, 0.35), (0.5, 0.5, 0.55)


def _finger(prefix: str) -> list[Geom]:
    link = f"hand_{prefix}_"
    return [
        Geom(link + "bs_box", link + "bs", BOX, (0.0240, 0.0210, 0.0125), (-0.0180, 0.0340, 0.0147), rgb=_GREEN),
        Geom(link + "px_box", link + "px", BOX, (0.0170, 0.0130, 0.0110), (0.0075, -0.0002, -0.0110), rgb=_GREEN),
        Geom(link + "md_box", link + "md", BOX, (0.0165, 0.0205, 0.0140), (0.0060, -0.0255, 0.0150), rgb=_GREEN),
        _between(link + "ds_tip", link + "ds", (0, -0.012, 0.015), (0, -0.036, 0.015), 0.0110, _DARK),
    ]


def robot_geoms() -> tuple[Geom, ...]:
    """Collision geometry of base, arm, hand and neck, in link order."""
    geoms = [
        Geom("base_body", "base", BOX, (0.2325, 0.2325, 0.1492), (0.0, 0.0, 0.1758), rgb=_DARK),
        Geom("neck_mast", "base", BOX, (0.03, 0.03, 0.1), (-0.15, 0.15, 0.425), rgb=_GREY),
        Geom("lidar_body", "lidar_body", CYLINDER, (0.0375, 0.0325, 0.0), (0.0, 0.0, 0.0), rgb=_DARK),
        _between("arm_link0_c", "arm_link0", (-0.09, 0, 0.06), (-0.02, 0, 0.06), 0.06, _WHITE),
        _between("arm_link1_c", "arm_link1", (0, 0, -0.33), (0, 0, -0.05), 0.06, _WHITE),
        _between("arm_link2_c", "arm_link2", (0, 0, -0.06), (0, 0, 0.06), 0.06, _WHITE),
        _between("arm_link3_c", "arm_link3", (0, 0, -0.22), (0, 0, -0.07), 0.06, _WHITE),
        _between("arm_link4_c", "arm_link4", (0, 0, -0.06), (0, 0, 0.06), 0.06, _WHITE),
        _between("arm_link5_a", "arm_link5", (0, 0, -0.31), (0, 0, -0.21), 0.06, _WHITE),
        _between("arm_link5_b", "arm_link5", (0, 0.08, -0.20), (0, 0.08, -0.06), 0.03, _WHITE),
        _between("arm_link6_c", "arm_link6", (0, 0, -0.07), (0.05, 0, 0.01), 0.05, _WHITE),
        _between("arm_link7_c", "arm_link7", (0, 0, -0.04), (0, 0, 0.08), 0.045, _WHITE),
        Geom("hand_palm_a", "hand_palm", BOX, (0.0310, 0.0610, 0.0243), (-0.0290, -0.0340, -0.0103), rgb=_GREEN),
        Geom("hand_palm_b", "hand_palm", BOX, (0.0220, 0.0320, 0.0230), (-0.0780, -0.0580, -0.0115), rgb=_GREEN),
        *_finger("if"),
        *_finger("mf"),
        *_finger("rf"),
        Geom("hand_th_mp_box", "hand_th_mp", BOX, (0.0170, 0.0130, 0.0110), (-0.0075, -0.0002, -0.0110), rgb=_GREEN),
        Geom("hand_th_bs_box", "hand_th_bs", BOX, (0.0090, 0.0165, 0.0075), (0.0, 0.0, -0.0075), rgb=_GREEN),
        Geom("hand_th_px_box", "hand_th_px", BOX, (0.0120, 0.0290, 0.0150), (0.0, 0.0155, -0.0140), rgb=_GREEN),
        _between("hand_th_ds_tip", "hand_th_ds", (0, 0.0, -0.015), (0, -0.045, -0.015), 0.0120, _DARK),
        _between("neck_base_c", "neck_base_link", (0, 0, 0.02), (0, 0, 0.10), 0.05, _GREY),
        _between("neck_link2_c", "neck_link2", (0, 0, 0), (0.28358, 0.028726, 0), 0.045, _GREY),
        _between("neck_link3_c", "neck_link3", (0, 0, 0), (-0.24221, 0.068514, 0), 0.040, _GREY),
        _between("neck_link5_c", "neck_link5", (0, 0.0, 0), (0, 0.07, 0), 0.035, _GREY),
        Geom("neck_d435", "neck_link6", BOX, (0.0125, 0.045, 0.0125), (0.0, 0.0, 0.0300), rgb=_DARK),
    ]
    return tuple(geoms)

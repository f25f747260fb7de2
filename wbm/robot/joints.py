"""Joint order, groups and limits of the 32-joint platform (NumPy only).

Everything in the project that indexes joints uses these slices. Velocity and acceleration limits are not part of the
published descriptions; they are taken from the vendors' manuals (Franka FCI documentation, PiPER user manual, LEAP
hand and TidyBot++ papers) and rounded towards the safe side.
"""

from __future__ import annotations

import numpy as np

BASE = slice(0, 3)
ARM = slice(3, 10)
HAND = slice(10, 26)
NECK = slice(26, 32)
NUM_JOINTS = 32

GROUPS: dict[str, slice] = {"base": BASE, "arm": ARM, "hand": HAND, "neck": NECK}
WBC = np.r_[0:10, 26:32]  # the joints that the whole-body controller moves
"""Indices of the 16 controller joints (base, arm, neck) within the 32."""

FINGERS: tuple[str, ...] = ("index", "middle", "ring", "thumb")
FINGER_PREFIX = {"index": "if", "middle": "mf", "ring": "rf", "thumb": "th"}

HAND_JOINTS: tuple[str, ...] = (
    *(f"{p}_{j}" for p in ("if", "mf", "rf") for j in ("mcp", "rot", "pip", "dip")),
    *("th_cmc", "th_axl", "th_mcp", "th_ipl"),
)

JOINT_NAMES: tuple[str, ...] = (
    *("base_x", "base_y", "base_yaw"),
    *(f"arm_joint{i}" for i in range(1, 8)),
    *(f"hand_{j}" for j in HAND_JOINTS),
    *(f"neck_joint{i}" for i in range(1, 7)),
)

QD_MAX = np.concatenate(
    [
        [0.8, 0.8, 1.5],  # TidyBot++ base, m/s and rad/s
        [2.175] * 4 + [2.61] * 3,  # Panda
        [8.0] * 16,  # LEAP, Dynamixel XC330 under load
        [3.14, 3.40, 3.14, 3.92, 3.92, 3.92],  # PiPER
    ]
)
QDD_MAX = np.concatenate(
    [
        [2.0, 2.0, 4.0],
        [15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0],
        [200.0] * 16,
        [15.0] * 6,
    ]
)

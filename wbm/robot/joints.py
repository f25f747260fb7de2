"""Joint order and groups of the 32-joint platform (NumPy only): everything that indexes joints uses these slices."""

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
FINGER_ROOT = {f: f"hand_{p}_{'mp' if f == 'thumb' else 'bs'}" for f, p in FINGER_PREFIX.items()}
FINGER_TIP = {f: f"hand_{p}_ds" for f, p in FINGER_PREFIX.items()}
"""First and last link of each finger: contact sensors are attached to them."""

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

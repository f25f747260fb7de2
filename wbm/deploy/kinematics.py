"""Forward kinematics and proprioception from the contract alone (float64 NumPy, one robot)."""

from __future__ import annotations

import numpy as np

from wbm.deploy.contract import Contract
from wbm.robot import joints
from wbm.robot.schema import rot6d

_TIPS = tuple(f"tip_{f}" for f in joints.FINGERS)


def _quat_to_mat(quat: np.ndarray) -> np.ndarray:
    w, x, y, z = quat
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


class Kinematics:
    """The contract's tree, ready to be evaluated once a step.

    Links are visited in order (parents first); the links that lead to no frame are left out.
    """

    def __init__(self, contract: Contract) -> None:
        tree, frames = contract.data["tree"], contract.data["frames"]
        wanted = {frames[n]["link"] for n in ("ee", "camera", "lidar", "base", *_TIPS)}
        for i in range(len(tree) - 1, 0, -1):
            if i in wanted:
                wanted.add(tree[i]["parent"])
        self._links = []
        for i in sorted(wanted - {0}):
            link = tree[i]
            axis = np.array(link["axis"])
            skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
            self._links.append(
                (i, link["parent"], np.array(link["pos"]), _quat_to_mat(np.array(link["quat"])), link["type"], axis, skew, skew @ skew, link["joint"])
            )
        self._frames = {n: (f["link"], np.array(f["pos"]), _quat_to_mat(np.array(f["quat"]))) for n, f in frames.items() if f["link"] in wanted}
        self._num_links = len(tree)

    def frames(self, q: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """World pose (R_WF [3,3], p_WF [3]) of every frame at joint positions `q` [32]."""
        rot: list[np.ndarray] = [np.eye(3)] * self._num_links
        pos: list[np.ndarray] = [np.zeros(3)] * self._num_links
        for i, parent, offset, local, kind, axis, skew, skew2, joint in self._links:
            r = rot[parent] @ local
            p = pos[parent] + rot[parent] @ offset
            if kind == "hinge":  # Rodrigues' formula
                r = r @ (np.eye(3) + np.sin(q[joint]) * skew + (1.0 - np.cos(q[joint])) * skew2)
            elif kind == "slide":
                p = p + r @ (axis * q[joint])
            rot[i], pos[i] = r, p
        return {n: (rot[link] @ r, pos[link] + rot[link] @ p) for n, (link, p, r) in self._frames.items()}


def proprioception(q: np.ndarray, qd: np.ndarray, frames: dict[str, tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The `proprio` field of one step, float32, in the order of `PROPRIO_LABELS`.

    Args:
        q: joint positions [32].
        qd: joint velocities [32]; the base's first two are velocities in the world.
        frames: `Kinematics.frames(q)`.
    """
    rot_b, pos_b = frames["base"]
    rot_e, pos_e = frames["ee"]
    c, s = np.cos(q[2]), np.sin(q[2])
    twist = (c * qd[0] + s * qd[1], -s * qd[0] + c * qd[1], qd[2])
    parts = [q[3:], twist, qd[3:]]
    for name in ("ee", "camera"):
        rot, pos = frames[name]
        parts += [rot_b.T @ (pos - pos_b), rot6d(rot_b.T @ rot)]
    parts += [rot_e.T @ (frames[name][1] - pos_e) for name in _TIPS]
    return np.concatenate(parts).astype(np.float32)

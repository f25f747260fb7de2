"""Forward kinematics and proprioception from the contract alone (float64 NumPy, one robot)."""

from __future__ import annotations

import numpy as np

from wbm.deploy.contract import Contract
from wbm.robot.proprio import FRAMES, proprioception, quat_to_mat
from wbm.robot.rotations import mat_to_quat


class Kinematics:
    """The contract's tree, ready to be evaluated once a step.

    Links are visited in order (parents first); the links that lead to no frame are left out.
    """

    def __init__(self, contract: Contract) -> None:
        tree, frames = contract.data["tree"], contract.data["frames"]
        wanted = {frames[n]["link"] for n in (*FRAMES, "lidar")}
        for i in range(len(tree) - 1, 0, -1):
            if i in wanted:
                wanted.add(tree[i]["parent"])
        self._links = []
        for i in sorted(wanted - {0}):
            link = tree[i]
            axis = np.array(link["axis"])
            skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
            self._links.append(
                (
                    i,
                    link["parent"],
                    np.array(link["pos"]),
                    quat_to_mat(np, np.array(link["quat"])),
                    link["type"],
                    axis,
                    skew,
                    skew @ skew,
                    link["joint"],
                )
            )
        self._frames = {
            n: (f["link"], np.array(f["pos"]), quat_to_mat(np, np.array(f["quat"])))
            for n, f in frames.items()
            if f["link"] in wanted
        }
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

    def proprio(self, q: np.ndarray, qd: np.ndarray, frames: dict[str, tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """The `proprio` field of one step, float32, by the function that training uses.

        Args:
            q: joint positions [32].
            qd: joint velocities [32]; the base's first two are velocities in the world.
            frames: `frames(q)`.
        """
        quat = np.array([[mat_to_quat(frames[n][0]) for n in FRAMES]])
        pos = np.array([[frames[n][1] for n in FRAMES]])
        return proprioception(np, q[None], qd[None], pos, quat)[0].astype(np.float32)

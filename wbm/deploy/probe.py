"""A driver without a robot: it starts at home and sees a wall, to time a policy and to try out a bundle."""

from __future__ import annotations

import time

import numpy as np

from wbm.deploy.contract import Contract
from wbm.deploy.driver import Command, DriverInfo, Reading


class Probe:
    """Follows its targets exactly.

    Args:
        contract: of the bundle to try.
        seed: of the points that it sees.
        real_time: wait for each period on the machine's clock, rather than count periods on a clock of its own.
    """

    def __init__(self, contract: Contract, seed: int = 0, real_time: bool = False) -> None:
        self._contract = contract
        self._begun = time.monotonic() if real_time else None
        self._rng = np.random.default_rng(seed)
        self._time = 0.0
        self.home()

    def home(self) -> None:
        """Stand at the home pose, at rest."""
        c = self._contract
        self._q, self._qd = np.clip(c.q_home, c.q_min, c.q_max), np.zeros(len(c.q_home))

    @property
    def info(self) -> DriverInfo:
        """Exactly what the contract asks for."""
        return DriverInfo(self._contract.joint_names, rate_hz=self._contract.schema.rate_hz)

    def now(self) -> float:
        """Time since the start, s."""
        return self._time if self._begun is None else time.monotonic() - self._begun

    def read(self) -> Reading:
        """The next reading, one period later."""
        self._time += self._contract.dt
        if self._begun is not None:
            time.sleep(max(0.0, self._time - self.now()))
            # A period that was missed altogether is skipped: late work is not made up for in a hurry.
            self._time = max(self._time, self.now() - self.now() % self._contract.dt)
        schema, rng = self._contract.schema, self._rng
        p, m = schema.num_depth_points, schema.num_lidar_points
        wall = np.column_stack([rng.uniform(-0.6, 0.6, p), rng.uniform(-0.4, 0.4, p), np.full(p, 1.2)])
        angle = rng.uniform(-np.pi, np.pi, m)
        room = np.column_stack([3 * np.cos(angle), 3 * np.sin(angle), rng.uniform(-0.2, 1.0, m)])
        return Reading(
            stamps=dict.fromkeys(("joints", "depth", "lidar"), self._time),
            joint_names=self._contract.joint_names,
            q=self._q.copy(),
            qd=self._qd.copy(),
            depth_xyz=wall.astype(np.float32),
            depth_rgb=rng.integers(0, 256, (p, 3), dtype=np.uint8),
            depth_valid=np.ones(p, np.uint8),
            depth_target=np.zeros(p, np.uint8),
            lidar_xyz=room.astype(np.float32),
            lidar_valid=np.ones(m, np.uint8),
        )

    def command(self, command: Command) -> None:
        """Be where the command says."""
        self._q, self._qd = command.q_target.copy(), command.qd_target.copy()

    def hold(self, reason: str) -> None:
        """Stand still."""
        self._qd = np.zeros_like(self._qd)

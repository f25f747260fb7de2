"""The simulator as a robot: a bundle's runtime, safety filter included, in the loop of an evaluation."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from wbm.deploy.bundle import Bundle
from wbm.deploy.driver import Reading
from wbm.deploy.faults import Refused
from wbm.deploy.kinematics import Kinematics
from wbm.deploy.runtime import PolicyRuntime

if TYPE_CHECKING:
    from wbm.envs.grasp_env import GraspEnv
    from wbm.envs.perception import Sight


class RuntimeDriver:
    """Acts in all environments through one runtime each; an episode runner's driver (see `wbm.envs.episodes.Driver`).

    The readings are what a robot would deliver: clouds in the sensors' own frames, stamps on the episode's clock.
    A refused reading holds the last command, as on a robot.

    Args:
        bundle: the policy.
        num_envs: number of environments.
        withheld: fields of the observation that are given as zeros.

    Attributes:
        refusals: how often a reading or a target was refused in an episode, by its number and by name.
    """

    needs_sight = True

    def __init__(self, bundle: Bundle, num_envs: int, withheld: Collection[str] = ()) -> None:
        self._withheld = frozenset(withheld)
        self._runtimes = [PolicyRuntime(bundle) for _ in range(num_envs)]
        self._kinematics = Kinematics(bundle.contract)
        self._dt, self._names = bundle.contract.dt, bundle.contract.joint_names
        self._episode = np.full(num_envs, -1)
        self._target = np.zeros((num_envs, len(self._names)))
        self.refusals: defaultdict[int, Counter[str]] = defaultdict(Counter)

    def step(self, env: GraspEnv, sight: Sight | None) -> tuple[Tensor, Tensor, Tensor, dict]:
        """One policy step of every environment; returns what `GraspEnv.step_targets` returns."""
        assert sight is not None
        targets = self.targets(
            env.state.q.double().cpu().numpy(),
            env.state.qd.double().cpu().numpy(),
            {n: (v * 0 if n in self._withheld else v).cpu().numpy() for n, v in sight.obs.items()},
            env.episode.cpu().numpy(),
            env.elapsed.cpu().numpy(),
        )
        return env.step_targets(torch.as_tensor(targets, dtype=torch.float32, device=env.device))

    def targets(
        self, q: np.ndarray, qd: np.ndarray, obs: dict[str, np.ndarray], episode: np.ndarray, elapsed: np.ndarray
    ) -> np.ndarray:
        """Joint targets [N,32].

        Args:
            q, qd: measured joints [N,32].
            obs: the schema's observation [N, ...], with clouds in the base frame.
            episode: number of the episode that runs in each environment [N]; a new one resets the runtime.
            elapsed: policy steps since its start [N].
        """
        for i, runtime in enumerate(self._runtimes):
            if episode[i] != self._episode[i]:
                runtime.reset()
                self._episode[i], self._target[i] = episode[i], q[i]
            runtime.set_embedding(obs["text"][i])
            now = float(elapsed[i]) * self._dt
            try:
                reading = self._reading(q[i], qd[i], {k: v[i] for k, v in obs.items()}, now)
                self._target[i] = runtime.step(reading, now).q_target
            except Refused as refused:
                self.refusals[int(episode[i])][refused.fault.value] += 1
                runtime.recover()
        return self._target

    def _reading(self, q: np.ndarray, qd: np.ndarray, obs: dict[str, np.ndarray], now: float) -> Reading:
        frames = self._kinematics.frames(q)
        rot_wb, pos_wb = frames["base"]

        def in_sensor(frame: str, points_b: np.ndarray) -> np.ndarray:
            rot_ws, pos_ws = frames[frame]
            return (points_b @ rot_wb.T + pos_wb - pos_ws) @ rot_ws

        return Reading(
            stamps=dict.fromkeys(("joints", "depth", "lidar"), now),
            joint_names=self._names,
            q=q,
            qd=qd,
            depth_xyz=in_sensor("camera", obs["depth_xyz"]),
            depth_rgb=obs["depth_rgb"],
            depth_valid=obs["depth_valid"],
            depth_target=obs["depth_target"],
            lidar_xyz=in_sensor("lidar", obs["lidar_xyz"]),
            lidar_valid=obs["lidar_valid"],
        )

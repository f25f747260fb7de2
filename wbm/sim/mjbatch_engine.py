"""MuJoCo C on a thread pool (mjbatch): the engine on CPUs."""

from __future__ import annotations

import mjbatch
import mujoco
import numpy as np
import torch

from wbm.sim.simulation import Simulation, env_ids


class MjBatchSimulation(Simulation):
    """Torch tensors that share memory with the arrays which mjbatch binds.

    State is float64 inside; the float32 state tensors are copied in only where an element changed, so untouched state
    keeps its full precision between steps. Model fields keep MuJoCo's own types, because `set_const` writes those.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, threads: int) -> None:
        self.model, self.num_envs, self.device = model, num_envs, "cpu"
        self._batch = mjbatch.Batch(model, num_envs, threads)
        self._fields: dict[str, torch.Tensor] = {}
        self._states: dict[str, torch.Tensor] = {}
        self.qpos, self.qvel = self.state("qpos"), self.state("qvel")
        self.ctrl, self.sensordata = self.state("ctrl"), self.state("sensordata")
        self._batch.forward()

    def field(self, name: str) -> torch.Tensor:
        if name not in self._fields:
            self._require(self.model, name)
            self._fields[name] = torch.from_numpy(self._batch.expand(name))
        return self._fields[name]

    def state(self, name: str) -> torch.Tensor:
        if name not in self._states:
            is_real = np.asarray(self._require(mujoco.MjData(self.model), name)).dtype == np.float64
            self._states[name] = torch.from_numpy(self._batch.bind(name, np.float32 if is_real else None))
        return self._states[name]

    def step(self, count: int = 1) -> None:
        self._batch.step(nstep=count)

    def reset(self, ids: torch.Tensor) -> None:
        self._batch.reset(env_ids(ids))

    def forward(self, ids: torch.Tensor) -> None:
        self._batch.forward(env_ids(ids))

    def set_const(self, ids: torch.Tensor) -> None:
        self._batch.set_const(env_ids(ids))

    def save_state(self) -> dict[str, torch.Tensor]:
        return {"state": torch.from_numpy(self._batch.bind("state")).clone(), "sensordata": self.sensordata.clone()}

    def load_state(self, state: dict[str, torch.Tensor]) -> None:
        rows = torch.from_numpy(self._batch.bind("state"))
        # Writes that wait in the float32 tensors would land on top of the rows: a call takes them away first. A second
        # call brings the tensors to the rows; it moves the solver's warm start, so the rows are written once more.
        self._batch.forward()
        rows.copy_(state["state"])
        self._batch.forward()
        rows.copy_(state["state"])
        self.sensordata.copy_(state["sensordata"])

    @staticmethod
    def _require(owner, name: str):
        value = getattr(owner, name, None)
        if not isinstance(value, np.ndarray):
            raise ValueError(f"{type(owner).__name__} has no array field {name!r}")
        return value

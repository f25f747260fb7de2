"""MuJoCo Warp: the engine on GPUs. Its CPU device is for tests; MuJoCo C is several times faster there."""

from __future__ import annotations

import copy

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp

from wbm.sim.simulation import Simulation, env_ids

CONTACTS = 160
"""Contacts of one environment for which there is room, on average over all."""

ROWS = 640
"""Constraint rows of one environment, at most."""

_STATE = ("qpos", "qvel", "act", "ctrl", "qacc_warmstart", "time")
_UNUSED = ("dof_M0",)  # MuJoCo C's name; nothing in MuJoCo Warp's step reads it


class MujocoWarpSimulation(Simulation):
    """Torch tensors that share memory with MuJoCo Warp's arrays: nothing is copied, nothing goes through the host.

    A model field has one value for all environments until `field` asks for it; geometry types and collision bits always
    do, so scenes need `SceneModelConfig(slots="mesh")`. All numbers are float32. On a GPU a step is one captured graph.

    Args:
        model: the template.
        num_envs: N.
        device: Warp's and torch's name of the device, `cuda` or `cpu`.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, device: str) -> None:
        self.model, self.num_envs, self.device = model, num_envs, device
        self._device = wp.get_device(device)
        with wp.ScopedDevice(self._device):
            self._m = mjw.put_model(_without_midphase(model))
            self._d = mjw.make_data(model, nworld=num_envs, nconmax=CONTACTS, njmax=ROWS)
        self._fields: dict[str, torch.Tensor] = {}
        self._states: dict[str, torch.Tensor] = {}
        self._graph: wp.Graph | None = None
        self._static = torch.as_tensor(np.flatnonzero(model.geom_bodyid == 0), device=device)
        self.qpos, self.qvel = self.state("qpos"), self.state("qvel")
        self.ctrl, self.sensordata = self.state("ctrl"), self.state("sensordata")
        self._run(mjw.forward)

    def field(self, name: str) -> torch.Tensor:
        if name not in self._fields:
            template = getattr(self.model, name, None)
            if not isinstance(template, np.ndarray):
                raise ValueError(f"MjModel has no array field {name!r}")
            shape = (self.num_envs, *template.shape)
            if name in _UNUSED:
                self._fields[name] = torch.as_tensor(template, dtype=torch.float32, device=self.device).repeat(
                    self.num_envs, *[1] * template.ndim
                )
            else:
                self._fields[name] = wp.to_torch(self._expand(name)).view(shape)
        return self._fields[name]

    def _expand(self, name: str) -> wp.array:
        """Give every environment its own values of a model field."""
        shared = getattr(self._m, name, None)
        if not isinstance(shared, wp.array) or shared.shape[:1] != (1,):
            raise ValueError(f"sim.engine=mujoco_warp has one value of {name} for all environments")
        values = np.repeat(shared.numpy(), self.num_envs, axis=0)
        own = wp.array(values, dtype=shared.dtype, device=self._device)
        setattr(self._m, name, own)
        self._graph = None  # it reads the old array
        return own

    def state(self, name: str) -> torch.Tensor:
        if name not in self._states:
            array = getattr(self._d, name, None)
            template = getattr(mujoco.MjData(self.model), name, None)
            if not isinstance(array, wp.array) or not isinstance(template, np.ndarray):
                raise ValueError(f"sim.engine=mujoco_warp has no array field {name!r} of MjData")
            self._states[name] = wp.to_torch(array).view(self.num_envs, *template.shape)
        return self._states[name]

    def step(self, count: int = 1) -> None:
        if self._device.is_cuda and self._graph is None:
            self._run(mjw.step)  # compiles and loads what a capture must find loaded
            count -= 1
            with wp.ScopedDevice(self._device), wp.ScopedCapture() as capture:
                mjw.step(self._m, self._d)
            self._graph = capture.graph
        for _ in range(count):
            if self._graph is not None:
                wp.capture_launch(self._graph)
            else:
                self._run(mjw.step)

    def reset(self, ids: torch.Tensor) -> None:
        mask = np.zeros(self.num_envs, dtype=bool)
        mask[env_ids(ids)] = True
        chosen = wp.array(mask, dtype=bool, device=self._device)
        self._run(lambda m, d: mjw.reset_data(m, d, chosen))

    def forward(self, ids: torch.Tensor) -> None:
        self._place_static()
        self._for_some(ids, mjw.forward)

    def _place_static(self) -> None:
        """Move the world body's geoms to their environments' places, which MuJoCo Warp computes but once."""
        pos, quat = self._fields.get("geom_pos"), self._fields.get("geom_quat")
        if pos is None or quat is None:
            return
        wp.to_torch(self._d.geom_xpos)[:, self._static] = pos[:, self._static]
        w, x, y, z = quat[:, self._static].unbind(-1)
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        mats = torch.stack([torch.stack(row, -1) for row in rows], -2)
        wp.to_torch(self._d.geom_xmat)[:, self._static] = mats

    def set_const(self, ids: torch.Tensor) -> None:
        kept = self.save_state()
        self._for_some(ids, mjw.set_const)
        self.load_state(kept)

    def save_state(self) -> dict[str, torch.Tensor]:
        return {name: tensor.clone() for name, tensor in self._state_tensors().items()}

    def load_state(self, state: dict[str, torch.Tensor]) -> None:
        for name, tensor in self._state_tensors().items():
            tensor.copy_(state[name])

    def _state_tensors(self) -> dict[str, torch.Tensor]:
        names = dict.fromkeys((*_STATE, *self._states))
        return {name: wp.to_torch(getattr(self._d, name)) for name in names}

    def _for_some(self, ids: torch.Tensor, function) -> None:
        """Call a function that works on all environments, and undo it in all but `ids`."""
        others = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        others[ids.to(self.device)] = False
        tensors = self._state_tensors()
        kept = {name: tensor[others] for name, tensor in tensors.items()}
        self._run(function)
        for name, tensor in tensors.items():
            tensor[others] = kept[name]

    def _run(self, function) -> None:
        with wp.ScopedDevice(self._device):
            function(self._m, self._d)


def _without_midphase(model: mujoco.MjModel) -> mujoco.MjModel:
    """The same model without the flag that switches MuJoCo C's midphase off: there is none here to switch off."""
    plain = copy.copy(model)
    plain.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
    return plain

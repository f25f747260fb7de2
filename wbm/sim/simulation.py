"""One interface over the batched physics engines."""

from __future__ import annotations

from abc import ABC, abstractmethod

import mujoco
import numpy as np
import torch

from wbm.sim.config import SimConfig

_INTEGRATOR = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "discrete": mujoco.mjtIntegrator.mjINT_DISCRETE,
}
_CONE = {"elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC, "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL}


def apply_options(model: mujoco.MjModel, cfg: SimConfig) -> None:
    """Write time step, integrator, solver and contact options of `cfg` into `model`, in place.

    `condim` is written to every geom: MuJoCo takes the larger of a pair's two, so one value has to hold for both.
    """
    model.opt.timestep = cfg.dt
    model.opt.integrator = _INTEGRATOR[cfg.integrator]
    model.opt.cone = _CONE[cfg.cone]
    model.opt.impratio = cfg.impratio
    model.opt.iterations = cfg.iterations
    model.opt.ls_iterations = cfg.ls_iterations
    model.opt.tolerance = cfg.tolerance
    model.geom_condim[:] = cfg.condim


class Simulation(ABC):
    """N copies of one model with live state tensors and per-environment model fields.

    Attributes:
        model: the template `MjModel` (names, ids, sizes); writes to it do not reach the simulations.
        num_envs: N.
        qpos: [N, nq] generalised positions, m and rad, free joints as position and quaternion w x y z.
        qvel: [N, nv] velocities, m/s and rad/s.
        ctrl: [N, nu] actuator commands.
        sensordata: [N, nsensordata]; one physics step behind `qpos` after `step`, current after `forward`.

    The tensors stay the same objects for the simulation's life. Write to them before a call, read after it.
    """

    model: mujoco.MjModel
    num_envs: int
    device: str
    qpos: torch.Tensor
    qvel: torch.Tensor
    ctrl: torch.Tensor
    sensordata: torch.Tensor

    @abstractmethod
    def field(self, name: str) -> torch.Tensor:
        """Live per-environment values [N, ...] of an `MjModel` field, seeded from the template.

        Raises:
            ValueError: the engine cannot vary this field.
        """

    @abstractmethod
    def state(self, name: str) -> torch.Tensor:
        """Live per-environment values [N, ...] of an `MjData` field such as `actuator_force`.

        Raises:
            ValueError: the engine does not offer this field.
        """

    @abstractmethod
    def step(self, count: int = 1) -> None:
        """Advance every environment by `count` physics steps."""

    @abstractmethod
    def reset(self, ids: torch.Tensor) -> None:
        """Return environments `ids` (sorted, unique) to the model's initial state; model fields are kept."""

    @abstractmethod
    def forward(self, ids: torch.Tensor) -> None:
        """Recompute what derives from the state of environments `ids`, without advancing time."""

    @abstractmethod
    def set_const(self, ids: torch.Tensor) -> None:
        """Recompute model constants of environments `ids` after masses, inertias or gains changed."""

    @abstractmethod
    def save_state(self) -> dict[str, torch.Tensor]:
        """Everything that the next step depends on, model fields apart, as copies."""

    @abstractmethod
    def load_state(self, state: dict[str, torch.Tensor]) -> None:
        """Restore `save_state`'s answer exactly; the environments' model fields must be as they were."""

    def sensor_slice(self, name: str) -> slice:
        """Columns of `sensordata` that belong to a sensor.

        Raises:
            KeyError: the model has no such sensor.
        """
        sensor = self.model.sensor(name)
        return slice(int(sensor.adr[0]), int(sensor.adr[0] + sensor.dim[0]))


def make_simulation(model: mujoco.MjModel, num_envs: int, cfg: SimConfig, device: str = "cpu") -> Simulation:
    """Build the engine that `cfg.engine` names; `model` is given `cfg`'s options first.

    Raises:
        ValueError: the engine cannot run on `device`, or is not available.
    """
    apply_options(model, cfg)
    if cfg.engine == "mjbatch":
        from wbm.sim.mjbatch_engine import MjBatchSimulation

        if device != "cpu":
            raise ValueError(f"sim.engine=mjbatch runs on the CPU, not on {device!r}")
        return MjBatchSimulation(model, num_envs, cfg.threads)
    try:
        from wbm.sim.mujoco_warp_engine import MujocoWarpSimulation
    except ModuleNotFoundError as error:
        raise ValueError("sim.engine=mujoco_warp needs MuJoCo Warp: pip install 'wbm[gpu]'") from error
    return MujocoWarpSimulation(model, num_envs, device)


def default_device(cfg: SimConfig) -> str:
    """Where environments of this engine live: on the GPU if the engine can use one and there is one."""
    return "cuda" if cfg.engine == "mujoco_warp" and torch.cuda.is_available() else "cpu"


def env_ids(ids: torch.Tensor) -> np.ndarray:
    """Environment ids as the sorted unique int array that the engines take."""
    return np.unique(ids.detach().cpu().numpy().astype(np.int64))

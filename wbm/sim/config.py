"""Physics settings: values only, so that the command line can read them without MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass, replace

INTEGRATORS = ("discrete", "implicitfast", "implicit", "euler")
CONES = ("elliptic", "pyramidal")
ENGINES = ("mjbatch", "mujoco_warp")


@dataclass(frozen=True)
class SimConfig:
    """How physics is stepped.

    Attributes:
        engine: `mjbatch` (MuJoCo C on a thread pool) or `mujoco_warp` (GPU; its CPU device serves parity tests).
        dt: physics step, s.
        decimation: physics steps in a policy step; `dt * decimation` is the policy's period.
        integrator: `discrete` (stable at 10 ms, MuJoCo C only), `implicitfast`, `implicit` or `euler`.
        cone: friction cone, `elliptic` or `pyramidal`.
        condim: contact dimensions of hand and objects: 3 sliding, 4 with torsion.
        impratio: frictional to normal constraint impedance; higher values slip less.
        iterations: solver iterations.
        ls_iterations: line-search iterations; implicitfast needs 50, with 10 grasps fail without a warning.
        tolerance: solver termination.
        threads: engine threads; 0 takes every logical CPU.
    """

    engine: str = "mjbatch"
    dt: float = 0.010
    decimation: int = 4
    integrator: str = "discrete"
    cone: str = "elliptic"
    condim: int = 3
    impratio: float = 5.0
    iterations: int = 10
    ls_iterations: int = 10
    tolerance: float = 1e-4
    threads: int = 1

    def __post_init__(self) -> None:
        for name, allowed in (("engine", ENGINES), ("integrator", INTEGRATORS), ("cone", CONES), ("condim", (3, 4, 6))):
            if getattr(self, name) not in allowed:
                raise ValueError(f"sim.{name} is {getattr(self, name)!r}; choose one of {allowed}")
        for name in ("dt", "impratio", "tolerance"):
            if not getattr(self, name) > 0:
                raise ValueError(f"sim.{name} must be positive, not {getattr(self, name)}")
        for name in ("decimation", "iterations", "ls_iterations"):
            if getattr(self, name) < 1:
                raise ValueError(f"sim.{name} must be at least 1, not {getattr(self, name)}")
        if self.threads < 0:
            raise ValueError(f"sim.threads must be 0 (all) or more, not {self.threads}")
        if self.engine == "mujoco_warp" and self.integrator == "discrete":
            raise ValueError(
                "sim.integrator=discrete exists in MuJoCo C only; use implicitfast with engine mujoco_warp"
            )
        if self.integrator != "discrete" and self.ls_iterations < 50:
            raise ValueError(
                f"sim.integrator={self.integrator} needs sim.ls_iterations >= 50, not {self.ls_iterations}"
            )

    @property
    def period(self) -> float:
        """Policy period, s."""
        return self.dt * self.decimation


TRAIN = SimConfig()
"""Coarse physics in which policies learn."""

EVALUATE = SimConfig(
    dt=0.004, decimation=10, integrator="implicitfast", condim=4, impratio=10.0, ls_iterations=50, tolerance=1e-6
)
"""Fine physics in which success is reported and rollouts are recorded."""


def evaluation_physics(cfg: SimConfig) -> SimConfig:
    """`EVALUATE` on the engine and threads of `cfg`."""
    return replace(EVALUATE, engine=cfg.engine, threads=cfg.threads)

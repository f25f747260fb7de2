"""The quadratic program of one environment in float64, and a solver of another kind for it (tests, benchmarks)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wbm.control.wbc import WholeBodyController


@dataclass(frozen=True)
class Program:
    """`min 1/2 x^T H x - g^T x + rho/2 |s|^2` subject to `low <= x <= high`, `A x + s >= b`, `s >= 0`.

    J velocities `x` and R slacks `s`, one for each pair of bodies within reach.
    """

    H: np.ndarray
    g: np.ndarray
    A: np.ndarray
    b: np.ndarray
    low: np.ndarray
    high: np.ndarray
    rho: float

    def solve(self) -> np.ndarray:
        """Velocities [J] by DAQP, a dual active-set method, with the slacks as variables.

        Raises:
            ImportError: `qpsolvers` or `daqp` is not installed.
            RuntimeError: no solution was found.
        """
        import qpsolvers

        rows, n = self.A.shape
        P = np.zeros((n + rows, n + rows))
        P[:n, :n], P[n:, n:] = self.H, self.rho * np.eye(rows)
        G = -np.hstack([self.A, np.eye(rows)]) if rows else None
        lower = np.concatenate([self.low.astype(float), np.zeros(rows)])
        upper = np.concatenate([self.high.astype(float), np.full(rows, np.inf)])
        linear = np.concatenate([-self.g, np.zeros(rows)])
        found = qpsolvers.solve_qp(P, linear, G, -self.b if rows else None, lb=lower, ub=upper, solver="daqp")
        if found is None:
            raise RuntimeError("DAQP found no solution of the controller's program")
        return found[:n]


def program(controller: WholeBodyController, env: int) -> Program:
    """The program that the controller's last `step` solved for one environment."""
    c = controller
    jac, vel, weight = (a.numpy()[env].astype(np.float64) for a in (c._jac, c._vel, c._weight))
    counts, starts = c._count.numpy()[env], c._region_start.numpy()
    used = np.concatenate([np.arange(s, s + k) for s, k in zip(starts[:-1], counts, strict=True)]).astype(int)
    wrench = np.concatenate([a.numpy()[env, used].astype(np.float64) for a in (c._moment, c._force)], axis=1)
    bits = c._tables.tree["group_mask"][:, None] >> np.arange(len(c.joints)) & 1
    side = c._side.numpy()[env, used]
    sign = bits[side[:, 0]] - np.where(side[:, 1:] >= 0, bits[side[:, 1]], 0)
    return Program(
        H=jac.T @ (weight[:, None] * jac) + np.diag(c._diag.numpy()[env].astype(np.float64)),
        g=jac.T @ (weight * vel) + c._rhs.numpy()[env].astype(np.float64),
        A=sign * (wrench @ c._screw.numpy()[env].astype(np.float64).T),
        b=c._bound.numpy()[env, used].astype(np.float64),
        low=c._low.numpy()[env].copy(),
        high=c._high.numpy()[env].copy(),
        rho=c.cfg.slack_weight,
    )

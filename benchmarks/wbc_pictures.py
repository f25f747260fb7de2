"""Draw the controller at work into `docs/images/wbc_*.png` (run from the repository root; no display is needed)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import warp as wp
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

from wbm.control.config import WbcConfig
from wbm.control.course import (
    BOX,
    NUM_OBSTACLES,
    PENETRATION,
    PLANE,
    Course,
    make_course,
    set_obstacles,
    set_target,
    start_states,
)
from wbm.control.gaze_trial import place_facing, settle
from wbm.control.wbc import WholeBodyController
from wbm.robot.joints import WBC
from wbm.robot.model import load_robot
from wbm.robot.rotations import quat_to_mat

OUT = Path("docs/images")
SOLVERS = ("qp", "paper")
SEED, NUM_ENVS, STEPS = 11, 64, 250
NUM_GAZES, GAZE_STEPS = 512, 300
BASE_RADIUS = 0.33  # m


@dataclass
class Run:
    """What one solver did: places of base and hand [T,N,2], smallest distances [T,N]."""

    base: np.ndarray
    hand: np.ndarray
    distance: np.ndarray


def run(solver: str, course: Course, q: np.ndarray) -> Run:
    """Close the loop over the course from joints `q` [N,32]."""
    c = WholeBodyController(load_robot(), NUM_ENVS, NUM_OBSTACLES, WbcConfig(solver=solver))
    set_obstacles(c, course)
    q = q.astype(np.float32)
    c.q.assign(q)
    c.reset()
    base, hand, distance = [], [], []
    for k in range(STEPS):
        set_target(c, course, k * c.cfg.dt)
        c.step()
        base.append(q[:, :2].copy())
        hand.append(c.frame_pos.numpy()[:, c.frame_names.index("ee"), :2].copy())
        distance.append(c.min_distance.numpy().copy())
        q[:, WBC] = c.q_target.numpy()
        c.q.assign(q)
    return Run(*(np.array(x) for x in (base, hand, distance)))


def footprint(axes: Axes, course: Course, env: int) -> None:
    """Obstacles from above, higher ones darker."""
    for kind, size, pos, quat in zip(
        course.type[env], course.size[env], course.pos[env], course.quat[env], strict=True
    ):
        if kind == PLANE:
            continue
        style = {"color": plt.get_cmap("YlGnBu")(0.15 + 0.5 * min(pos[2], 1.4) / 1.4), "alpha": 0.8, "lw": 0}
        if kind == BOX:
            corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size[:2]
            rot = quat_to_mat(quat / np.linalg.norm(quat))
            axes.add_patch(Polygon(corners @ rot[:2, :2].T + pos[:2], **style))
        else:
            axes.add_patch(Circle(tuple(pos[:2]), size[0], **style))


def draw_course() -> None:
    """One course for both solvers: of those that start among the obstacles, where the paper's equations touch most."""
    c = WholeBodyController(load_robot(), NUM_ENVS, NUM_OBSTACLES)
    course = make_course(NUM_ENVS, SEED)
    set_obstacles(c, course)
    q = start_states(c.robot, c, SEED)
    runs = {solver: run(solver, course, q) for solver in SOLVERS}
    touched = (runs["paper"].distance < -PENETRATION).sum(axis=0)
    env = int(np.argmax(np.where(np.linalg.norm(q[:, :2], axis=1) < 2.0, touched, -1)))
    fig, axes = plt.subplots(1, 2, figsize=(12, 6.2), dpi=90, sharex=True, sharey=True)
    for ax, solver in zip(axes, SOLVERS, strict=True):
        r = runs[solver]
        footprint(ax, course, env)
        ax.add_patch(Circle(tuple(r.base[0, env]), BASE_RADIUS, fill=False, color="#4c78a8", ls=":"))
        ax.add_patch(Circle(tuple(r.base[-1, env]), BASE_RADIUS, fill=False, color="#4c78a8"))
        ax.plot(*r.base[:, env].T, color="#4c78a8", lw=2, label="base")
        ax.plot(*r.hand[:, env].T, color="#f58518", lw=2, label="hand")
        target = np.array([course.target(k * c.cfg.dt)[0][env, :2] for k in range(STEPS)])
        ax.plot(*target.T, ".", color="#54a24b", ms=2, label="the hand's target (jumps after 5 s)")
        hit = r.distance[:, env] < -PENETRATION
        if hit.any():
            ax.plot(*r.hand[hit, env].T, "x", color="#e45756", ms=6, label="something penetrates > 1 mm")
        ax.set_title(
            f"{solver}: smallest distance {1e3 * r.distance[:, env].min():.0f} mm, "
            f"{int(hit.sum())} of {STEPS} steps in collision",
            fontsize=10,
        )
        ax.set_aspect("equal")
        ax.set_xlabel("x (m)")
        ax.legend(fontsize=8, loc="best")
    axes[0].set_ylabel("y (m)")
    shown = [x[:, env] for r in runs.values() for x in (r.base, r.hand)]
    shown.append(course.pos[env, course.type[env] != PLANE, :2])
    every = np.concatenate(shown)
    axes[0].set_xlim(every[:, 0].min() - 0.7, every[:, 0].max() + 0.7)
    axes[0].set_ylim(every[:, 1].min() - 0.7, every[:, 1].max() + 0.7)
    fig.tight_layout()
    fig.savefig(OUT / "wbc_course.png", metadata={"Software": None})


def draw_gaze() -> None:
    """Gaze error over time from uniformly random headings and necks."""
    fig, axes = plt.subplots(1, 2, figsize=(12, 4.2), dpi=90, sharey=True)
    for ax, solver in zip(axes, SOLVERS, strict=True):
        c = WholeBodyController(load_robot(), NUM_GAZES, 0, WbcConfig(solver=solver))
        error = np.degrees(settle(c, place_facing(c, SEED), GAZE_STEPS))
        t = c.cfg.dt * np.arange(len(error))
        ax.semilogy(t, error[:, ::16], color="#bab0ac", lw=0.5)
        for p, color in ((50, "#4c78a8"), (90, "#f58518"), (99, "#e45756")):
            ax.semilogy(t, np.percentile(error, p, axis=1), color=color, lw=2, label=f"{p} % of {NUM_GAZES} are below")
        ax.axhline(2.0, color="black", lw=0.8, ls="--")
        ax.set_title(f"{solver}: {int((error[-1] > 2).sum())} above 2 degrees after {t[-1]:.0f} s", fontsize=10)
        ax.set_xlabel("time (s)")
        ax.set_ylim(1e-2, 200)
        ax.legend(fontsize=8, loc="upper right")
    axes[0].set_ylabel("gaze error (degrees)")
    fig.tight_layout()
    fig.savefig(OUT / "wbc_gaze.png", metadata={"Software": None})


if __name__ == "__main__":
    wp.config.log_level = wp.LOG_ERROR
    OUT.mkdir(parents=True, exist_ok=True)
    draw_course()
    draw_gaze()

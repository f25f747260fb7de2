"""Benchmark of the controller: speed, what it costs by size, exactness, and closed loops beside the paper's equations.

Times are processor time on one thread, so that other work on the machine adds little.
"""

from __future__ import annotations

import importlib.util
import time
from typing import Any

import numpy as np
import warp as wp

from wbm.control.bench_mink import measure_mink
from wbm.control.config import WbcConfig
from wbm.control.course import NUM_OBSTACLES, Course, make_course, run_course, set_target, start_states
from wbm.control.gaze_trial import hand_error, place_facing, place_reachable, settle
from wbm.control.program import program
from wbm.control.wbc import WholeBodyController
from wbm.robot.joints import ARM, BASE, NECK, WBC
from wbm.robot.model import load_robot

SIZES = (1, 64, 1024, 4096)
OBSTACLES = (0, 4, 8, 16, 32)
EPISODE = 250  # steps; two targets
SEED = 7


def bench_wbc(
    steps: int = 256_000, sizes: tuple[int, ...] = SIZES, envs: int = 1024, samples: int = 400, peers: bool = True
) -> dict[str, Any]:
    """Everything that `wbm bench wbc` reports.

    Args:
        steps: closed-loop control steps of `qp` on the obstacle course, and a quarter as many of `paper`.
        sizes: numbers of environments to time.
        envs: environments side by side in the closed loops and in the costs by size.
        samples: programs that are solved again in float64.
        peers: measure mink and DAQP beside the controller.

    Raises:
        ValueError: a number is out of range.
        RuntimeError: a peer is not installed.
    """
    if min(steps, envs, samples, *sizes) < 1:
        raise ValueError("bench wbc: steps, sizes, envs and samples must be at least 1")
    missing = [name for name in ("mink", "qpsolvers", "daqp") if importlib.util.find_spec(name) is None]
    if peers and missing:
        raise RuntimeError(
            f"bench wbc: {', '.join(missing)} is not installed: pip install 'wbm[bench]', or go without (peers=false)"
        )
    wp.config.log_level = wp.LOG_ERROR
    per_env = {n: speed(n) for n in sizes}
    out: dict[str, Any] = {"us_per_env": {str(n): us for n, us in per_env.items()}}
    out["us_per_env_by_obstacles"] = {str(m): speed(envs, obstacles=m) for m in OBSTACLES}
    out["us_per_env_by_joints"] = {str(len(joints)): speed(envs, joints=joints) for joints in _joint_sets()}
    out |= exactness(samples, peers)
    if peers:
        # mink solves one environment at a time; the controller is meant for a thousand.
        out["ratio_vs_mink"] = out["mink_us"] / per_env[min(sizes, key=lambda n: abs(n - 1024))]
        out["ratio_vs_mink_fewest_envs"] = out["mink_us"] / per_env[min(sizes)]
    return out | closed_loops(steps, envs)


def _joint_sets() -> list[np.ndarray]:
    base, arm, neck = (np.arange(part.start, part.stop) for part in (BASE, ARM, NECK))
    return [base, np.r_[base, neck], np.r_[base, arm], WBC]


def speed(num_envs: int, obstacles: int = NUM_OBSTACLES, joints: np.ndarray = WBC, rounds: int = 2) -> float:
    """Microseconds an environment and step over an episode of the course, with constraints active as they come.

    Args:
        num_envs: N.
        obstacles: of the course's 16 the first so many; beyond 16 those of a second course are added.
        joints: controlled joints.
        rounds: times that the same episode is run; each step's fastest time counts.
    """
    c = WholeBodyController(load_robot(), num_envs, obstacles, joints=joints)
    course = _crowd(num_envs, obstacles)
    _load(c, course)
    q_start = start_states(c.robot, c, SEED) if obstacles <= NUM_OBSTACLES else _starts(num_envs)
    steps = EPISODE if num_envs >= 64 else 4 * EPISODE
    best = np.full(steps, np.inf)
    for _ in range(rounds):
        q = q_start.astype(np.float32)
        c.q.assign(q)
        c.reset()
        for k in range(steps):
            set_target(c, course, k * c.cfg.dt)
            start = time.process_time()
            c.step()
            best[k] = min(best[k], time.process_time() - start)
            q[:, joints] = c.q_target.numpy()
            c.q.assign(q)
    return float(best.mean()) / num_envs * 1e6


def _starts(num_envs: int) -> np.ndarray:
    """Start states of the 16-obstacle course, for one with more obstacles."""
    c = WholeBodyController(load_robot(), num_envs, NUM_OBSTACLES)
    _load(c, make_course(num_envs, SEED))
    return start_states(c.robot, c, SEED)


def _crowd(num_envs: int, obstacles: int) -> Course:
    course, more = make_course(num_envs, SEED), make_course(num_envs, SEED + 1)
    arrays = {
        name: np.concatenate([getattr(course, name), getattr(more, name)], axis=1)[:, :obstacles]
        for name in ("type", "size", "pos", "quat")
    }
    rest = {name: getattr(course, name) for name in ("goal_pos", "goal_quat", "sway", "rate")}
    return Course(**arrays, **rest)


def _load(c: WholeBodyController, course: Course) -> None:
    for name in ("type", "size", "pos", "quat"):
        kind = np.int32 if name == "type" else np.float32
        if getattr(course, name).size:
            getattr(c, f"obstacle_{name}").assign(np.ascontiguousarray(getattr(course, name), dtype=kind))


def exactness(samples: int, peers: bool, num_envs: int = 64) -> dict[str, Any]:
    """The same programs in float64, and mink's time for the same problems (keys as in the report).

    Args:
        samples: programs, spread evenly over environments and an episode.
        peers: whether DAQP and mink take part.
        num_envs: environments of the course.
    """
    c = WholeBodyController(load_robot(), num_envs, NUM_OBSTACLES)
    course = make_course(num_envs, SEED)
    _load(c, course)
    q = start_states(c.robot, c, SEED).astype(np.float32)
    c.q.assign(q)
    c.reset()
    errors, moments, targets, active = [], [], [], []
    per_moment = max(1, samples // (EPISODE // 10))
    for k in range(EPISODE):
        set_target(c, course, k * c.cfg.dt)
        c.step()
        if k % 10 == 5:
            moments.append(q.copy())
            targets.append(course.target(k * c.cfg.dt))
            qd = c.qd.numpy()
            for env in np.linspace(0, num_envs - 1, per_moment).astype(int) if peers else ():
                p = program(c, env)
                errors.append(np.abs(p.solve() - qd[env]).max())
                active.append(int((p.A @ qd[env] < p.b + 1e-6).sum()))
        q[:, WBC] = c.q_target.numpy()
        c.q.assign(q)
    out: dict[str, Any] = {
        "spheres": len(c.spheres),
        "obstacles": NUM_OBSTACLES,
        "obstacle_pairs": len(c.spheres) * NUM_OBSTACLES,
        "self_pairs": len(c.pairs),
    }
    if peers:
        mink = measure_mink(c, course, np.array(moments)[::5], np.arange(0, num_envs, 8), targets[::5])
        out |= {
            "qdot_error_p50": float(np.percentile(errors, 50)),
            "qdot_error_p99": float(np.percentile(errors, 99)),
            "qdot_error_max": float(np.max(errors)),
            "programs_compared": len(errors),
            "programs_with_active_dampers": int(np.count_nonzero(active)),
            "mink_us": mink.us,
            "mink_obstacle_pairs": mink.obstacle_pairs,
            "mink_self_pairs": mink.self_pairs,
            "mink_solves": mink.solves,
            "mink_without_solution": mink.failed,
        }
    return out


def closed_loops(steps: int, envs: int) -> dict[str, Any]:
    """The obstacle course with both solvers, the gaze from everywhere, and static errors (keys as in the report)."""
    out: dict[str, Any] = {}
    for solver, share in (("qp", 1), ("paper", 4)):
        wanted = max(EPISODE, steps // share)
        side_by_side = min(envs, max(1, wanted // EPISODE))
        c = WholeBodyController(load_robot(), side_by_side, NUM_OBSTACLES, WbcConfig(solver=solver))
        tally = run_course(c, SEED, -(-wanted // (side_by_side * EPISODE)), EPISODE)
        out |= {
            f"steps_{solver}": tally.steps,
            f"episodes_{solver}": tally.episodes,
            f"collisions_{solver}": tally.colliding_episodes,
            f"colliding_share_{solver}": tally.colliding_episodes / tally.episodes,
            f"penetrating_steps_{solver}": tally.colliding_steps,
            f"deepest_penetration_mm_{solver}": max(0.0, -1e3 * tally.deepest),
            f"limit_violations_{solver}": tally.limit_violations,
            f"worst_violation_{solver}": list(tally.worst),
            f"nan_{solver}": tally.nan,
            f"iterations_{solver}": tally.iterations / tally.steps,
        }
    out |= {"limit_violations": out["limit_violations_qp"], "nan": out["nan_qp"]}
    c = WholeBodyController(load_robot(), 512, 0)
    start_and_end = settle(c, place_facing(c, SEED), 2 * EPISODE, every=2 * EPISODE)
    gaze = np.degrees(start_and_end)
    out |= {
        "gaze_starts": 512,
        "gaze_deg_start_max": float(gaze[0].max()),
        "gaze_deg_p50": float(np.percentile(gaze[-1], 50)),
        "gaze_deg_p99": float(np.percentile(gaze[-1], 99)),
        "gaze_above_2_deg": int((gaze[-1] > 2.0).sum()),
    }
    settle(c, place_reachable(c, SEED), 2 * EPISODE, every=2 * EPISODE)
    away, angle = hand_error(c)
    exact = (away < 1e-3) & (angle < np.radians(0.1))
    out |= {
        "static_error_mm_p50": 1e3 * float(np.percentile(away, 50)),
        "static_error_mm_p95": 1e3 * float(np.percentile(away, 95)),
        "static_error_deg_p50": float(np.degrees(np.percentile(angle, 50))),
        "static_error_deg_p95": float(np.degrees(np.percentile(angle, 95))),
        "static_exact_share": float(exact.mean()),
    }
    return out

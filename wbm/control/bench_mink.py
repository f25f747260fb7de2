"""mink on the controller's own problem: same robot, tasks, limits and collision pairs, one environment at a time."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from wbm.control.course import PLANE, Course
from wbm.control.wbc import WholeBodyController
from wbm.robot.joints import BASE, WBC
from wbm.robot.model import FIXED, SLIDE, RobotModel, forward_kinematics
from wbm.robot.spheres import sphere_positions

SOLVER = "daqp"


@dataclass
class MinkCost:
    """What mink took.

    Attributes:
        us: microseconds of processor time a solve, kinematics included.
        obstacle_pairs, self_pairs: pairs of geoms that it watches.
        solves: how many were timed; failed: solves for which it found no solution.
    """

    us: float
    obstacle_pairs: int
    self_pairs: int
    solves: int
    failed: int


def measure_mink(
    c: WholeBodyController, course: Course, q: np.ndarray, envs: np.ndarray, target: Sequence[tuple], repeats: int = 3
) -> MinkCost:
    """Time mink at the joints of some environments.

    Args:
        c: whose robot, spheres, pairs, weights, gains and limits are used.
        course: obstacles.
        q: [K,N,32] joints at K moments.
        envs: [E] environments to look at.
        target: for each of the K moments hand position [N,3], orientation [N,4] and point to look at [N,3].
        repeats: timings of which the fastest counts for each problem.
    """
    spent, failed, pairs = [], 0, (0, 0)
    for env in envs:
        problem = _Problem(c, course, int(env))
        pairs = problem.pairs
        for k in range(len(q)):
            problem.aim(*(part[env] for part in target[k]))
            best = np.inf
            for _ in range(repeats):
                start = time.process_time()
                solved = problem.solve(q[k, env, WBC])
                best = min(best, time.process_time() - start)
            spent.append(best)
            failed += not solved
    return MinkCost(float(np.mean(spent)) * 1e6, *pairs, len(spent), failed)


class _Problem:
    """One environment as mink sees it."""

    def __init__(self, c: WholeBodyController, course: Course, env: int) -> None:
        import mink

        self.mink, self.dt = mink, c.cfg.dt
        weights, gains = c.cfg.weights, c.cfg.gains
        model = _model(c, course, env)
        self.configuration = mink.Configuration(model)
        self.hand = mink.FrameTask(
            "ee", "site", weights.ee_position**0.5, weights.ee_rotation**0.5, gain=gains.ee_position * self.dt
        )
        self.gaze = mink.LookAtTask("camera", "site", cost=weights.gaze**0.5, gain=gains.gaze * self.dt)
        posture = mink.PostureTask(model, np.r_[np.zeros(3), np.full(13, weights.posture**0.5)])
        posture.set_target(c.robot.q_home[WBC])
        damping = mink.DampingTask(model, np.r_[np.full(3, weights.base**0.5), np.full(13, weights.damping**0.5)])
        self.tasks: list[Any] = [self.hand, self.gaze, posture, damping]
        rolling = {s for s, link in enumerate(c.spheres.link) if not _driven(c.robot, int(link))}
        obstacle_pairs = [
            (
                [f"sphere_{s}" for s in range(len(c.spheres)) if not (kind == PLANE and s in rolling)],
                [f"obstacle_{k}"],
            )
            for k, kind in enumerate(course.type[env])
        ]
        self_pairs = [([f"sphere_{a}"], [f"sphere_{b}"]) for a, b in c.pairs]
        avoid = [
            mink.CollisionAvoidanceLimit(
                model,
                pairs,
                gain=gains.gamma,
                minimum_distance_from_collisions=keep,
                collision_detection_distance=keep + reach,
            )
            for pairs, keep, reach in (
                (obstacle_pairs, gains.safe_obstacle, c.cfg.reach),
                (self_pairs, gains.safe_self, c.cfg.reach_self),
            )
        ]
        self.pairs = (len(avoid[0].geom_id_pairs), len(avoid[1].geom_id_pairs))
        speed = {c.robot.joint_names[j]: float(c.robot.qd_max[j]) for j in WBC}
        self.limits = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, speed), *avoid]

    def aim(self, pos: np.ndarray, quat: np.ndarray, look: np.ndarray) -> None:
        """Set the targets of hand and gaze."""
        self.hand.set_target(self.mink.SE3(np.r_[quat / np.linalg.norm(quat), pos]))
        self.gaze.set_target(look)

    def solve(self, q: np.ndarray) -> bool:
        """Kinematics and one solve at joints `q` [16]; whether there was a solution."""
        self.configuration.update(q)
        try:
            self.mink.solve_ik(self.configuration, self.tasks, self.dt, SOLVER, damping=1e-3, limits=self.limits)
        except self.mink.NoSolutionFound:
            return False
        return True


def _driven(robot: RobotModel, link: int) -> bool:
    """Whether a joint other than the base's moves the link."""
    while link > 0:
        if robot.joint_type[link] != FIXED and robot.joint_index[link] >= BASE.stop:
            return True
        link = int(robot.parent[link])
    return False


def _model(c: WholeBodyController, course: Course, env: int) -> mujoco.MjModel:
    """The 16-joint robot with the controller's spheres as its geoms (the hand's, held at home), and the obstacles."""
    robot = c.robot
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    bodies = {0: spec.worldbody}
    for i in range(1, len(robot.link_names)):
        moves = robot.joint_type[i] != FIXED
        if int(robot.parent[i]) not in bodies or (moves and robot.joint_index[i] not in WBC):
            continue
        body = bodies[int(robot.parent[i])].add_body(
            name=robot.link_names[i], pos=robot.link_pos[i], quat=robot.link_quat[i], mass=1.0, inertia=[0.01] * 3
        )
        body.explicitinertial = True
        bodies[i] = body
        if moves:
            j = int(robot.joint_index[i])
            kind = mujoco.mjtJoint.mjJNT_SLIDE if robot.joint_type[i] == SLIDE else mujoco.mjtJoint.mjJNT_HINGE
            body.add_joint(
                name=robot.joint_names[j], type=kind, axis=robot.joint_axis[i], range=[robot.q_min[j], robot.q_max[j]]
            ).limited = mujoco.mjtLimited.mjLIMITED_TRUE
    for name in ("ee", "camera"):
        frame = robot.frames[name]
        bodies[frame.link].add_site(name=name, pos=frame.pos, quat=frame.quat)
    _add_spheres(c, bodies)
    for k in range(course.type.shape[1]):
        kind = mujoco.mjtGeom(int(course.type[env, k]))
        size = [0.0, 0.0, 0.1] if kind == mujoco.mjtGeom.mjGEOM_PLANE else course.size[env, k]
        spec.worldbody.add_geom(
            name=f"obstacle_{k}", type=kind, size=size, pos=course.pos[env, k], quat=course.quat[env, k]
        )
    return spec.compile()


def _add_spheres(c: WholeBodyController, bodies: dict[int, Any]) -> None:
    robot = c.robot
    model_at_home = sphere_positions(robot, c.spheres, robot.q_home[None])[0]
    rot, pos = forward_kinematics(robot, robot.q_home)
    for s, link in enumerate(c.spheres.link):
        home = int(link)
        while home not in bodies:
            home = int(robot.parent[home])
        at = rot[home].T @ (model_at_home[s] - pos[home])
        bodies[home].add_geom(
            name=f"sphere_{s}", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[float(c.spheres.radius[s]), 0, 0], pos=at
        )

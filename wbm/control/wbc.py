"""The whole-body controller: 16 joint velocities a step for many environments, inside every limit."""

# Warp kernels and vectors have no useful static types.
# pyright: reportArgumentType=false

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
import warp as wp

from wbm.control.config import WbcConfig
from wbm.control.tables import build_tables, neck_pan
from wbm.kernels import (
    distance,
    kinematics,
    wbc_assemble,
    wbc_dampers,
    wbc_integrate,
    wbc_objectives,
    wbc_paper,
    wbc_qp,
)
from wbm.robot.joints import BASE, NECK, WBC
from wbm.robot.model import RobotModel
from wbm.robot.spheres import SphereSet, robot_spheres, self_pairs

SELF_CAPACITY = 48
CANDIDATES_PER_SPHERE = 2
BASE_JOINTS = np.arange(BASE.start, BASE.stop)
YAW_LEVER = 0.35  # m, about the robot's radius: turning the base costs what moving its rim costs


class WholeBodyController:
    """Equations (1) to (4) made safe: weighted least squares within exact limits, dampers against collision.

    Inputs are live arrays that the caller fills; `step` runs one captured graph; outputs are live arrays. N
    environments, M obstacles, S spheres in the order of `spheres`, F frames in the order of `frame_names`.

    Inputs:
        q [N,32] measured joints; ee_pos [N,3], ee_quat [N,4] (w x y z), ee_lin_vel [N,3], ee_ang_vel [N,3] target of
        the hand and its feed-forward, world; gaze_point [N,3], gaze_weight [N] (factor on the gaze's weight);
        q_posture [N,16]; obstacle_type [N,M] (-1 unused), obstacle_size [N,M,3], obstacle_pos [N,M,3],
        obstacle_quat [N,M,4]; sphere_margin [N,S] (m, added to a sphere's safety distance against obstacles;
        -inf switches it off); weights [N,W] and gains [N,K] with the columns `weight_names` and `gain_names`.

    Outputs:
        qd [N,16] velocities; q_target [N,16] their integral, inside the position limits; ctrl [N,16] position
        commands that make up for the actuators' lag, inside the limits; frame_pos [N,F,3], frame_quat [N,F,4] at `q`;
        min_distance [N] the smallest distance to an obstacle or itself, m (1e6 when nothing is within reach).

    A non-finite value in a target switches that target off or is clamped; the outputs stay finite.
    """

    weight_names = wbc_objectives.WEIGHT_NAMES
    gain_names = wbc_objectives.GAIN_NAMES

    def __init__(
        self,
        robot: RobotModel,
        num_envs: int,
        num_obstacles: int,
        cfg: WbcConfig | None = None,
        device: str = "cpu",
        spheres: SphereSet | None = None,
        pairs: np.ndarray | None = None,
        joints: np.ndarray = WBC,
    ) -> None:
        """Allocate arrays and capture the graphs.

        Args:
            robot: the kinematic tree with limits.
            num_envs: N >= 1.
            num_obstacles: M >= 0 slots for obstacles in each environment.
            cfg: settings; defaults if left out.
            device: "cpu" or a CUDA device.
            spheres: collision spheres; the robot's own if left out.
            pairs: self-collision pairs [P,2] of spheres; the robot's own if left out.
            joints: indices of the controlled joints [J], at most 16, those of the base first; the rest stay still.

        Raises:
            ValueError: a count is out of range, or the joints do not begin with the base's.
        """
        if num_envs < 1:
            raise ValueError(f"controller: num_envs is {num_envs}, give at least 1")
        if num_obstacles < 0:
            raise ValueError(f"controller: num_obstacles is {num_obstacles}, give 0 or more")
        if not len(BASE_JOINTS) <= len(joints) <= len(WBC) or (joints[: len(BASE_JOINTS)] != BASE_JOINTS).any():
            raise ValueError(f"controller: joints are {list(joints)}, give the base's three and up to 13 more")
        self.joints = np.asarray(joints)
        self.robot, self.num_envs, self.num_obstacles = robot, num_envs, num_obstacles
        self.cfg = cfg or WbcConfig()
        self.device = wp.get_device(device)
        self.spheres = robot_spheres(robot) if spheres is None else spheres
        self.pairs = self_pairs(robot, self.spheres) if pairs is None else np.asarray(pairs)
        self._tables = build_tables(robot, self.spheres, self.pairs, self.joints)
        self.frame_names = self._tables.frame_names
        self._allocate_tables()
        self._allocate_inputs()
        self._allocate_state()
        self._kinematics_graph = self._capture(self._launch_kinematics)
        self._step_graph = self._capture(self._launch_step)
        self.reset()
        self.qd.zero_()

    def step(self) -> None:
        """Compute `qd`, `q_target`, `ctrl`, frames and `min_distance` from the inputs; one graph launch."""
        wp.capture_launch(self._step_graph)

    def forward_kinematics(self) -> None:
        """Fill `frame_pos` and `frame_quat` at `q`, and nothing else."""
        wp.capture_launch(self._kinematics_graph)

    def reset(self, env_ids: Sequence[int] | np.ndarray | None = None) -> None:
        """Forget the previous velocity and target: the next step starts at rest from the measured joints.

        Args:
            env_ids: environments to reset; all if left out.
        """
        if env_ids is None:
            self._fresh.fill_(1)
            return
        ids = np.asarray(env_ids, dtype=np.int64).ravel()
        if len(ids) == 0:
            return
        if self.device.is_cpu:
            self._fresh.numpy()[ids] = 1
        else:
            wp.to_torch(self._fresh)[ids.tolist()] = 1

    def _array(self, shape: tuple[int, ...], dtype: type, value: float = 0.0) -> wp.array:
        out = wp.zeros(shape, dtype=dtype, device=self.device)
        if value:
            out.fill_(value)
        return out

    def _upload(self, value: np.ndarray, dtype: type) -> wp.array:
        return wp.array(np.ascontiguousarray(value), dtype=dtype, device=self.device)

    def _allocate_tables(self) -> None:
        t, robot, cfg = self._tables, self.robot, self.cfg
        self._tree = t.upload(self.device)
        self._block = self._upload(t.block, wp.vec4i)
        self._pair = self._upload(t.pair, wp.vec2i)
        self._num_groups = len(t.tree["group_start"]) - 1
        sizes = np.diff(t.tree["group_start"]) * CANDIDATES_PER_SPHERE
        start = np.r_[0, np.cumsum(np.r_[sizes, SELF_CAPACITY])].astype(np.int32)
        self._region_start = self._upload(start, wp.int32)
        self._num_candidates = int(start[-1])
        limits = wbc_assemble.Limits()
        limits.joint = self._upload(self.joints.astype(np.int32), wp.int32)
        for name, value in (
            ("q_min", robot.q_min[self.joints]),
            ("q_max", robot.q_max[self.joints]),
            ("speed", robot.qd_max[self.joints]),
            ("acceleration", robot.qdd_max[self.joints]),
            ("base_scale", np.r_[1.0, 1.0, YAW_LEVER, np.zeros(len(self.joints) - 3)]),
        ):
            setattr(limits, name, self._upload(value.astype(np.float32), wp.float32))
        limits.dt = cfg.dt
        limits.lead_time = cfg.lead_time
        limits.from_target = int(cfg.integrate == "target")
        self._limits = limits
        frames = wbc_assemble.Frames()
        frames.ee, frames.camera = (self.frame_names.index(n) for n in ("ee", "camera"))
        frames.ee_mask, frames.camera_mask = (t.frame_mask[n] for n in ("ee", "camera"))
        frames.base = self.frame_names.index("base")
        frames.yaw = 2
        frames.pan = int(np.append(np.flatnonzero(NECK.start == self.joints), -1)[0])
        frames.pan_mount, frames.pan_zero = neck_pan(robot)
        self._frames = frames

    def _allocate_inputs(self) -> None:
        n, m, cfg = self.num_envs, self.num_obstacles, self.cfg
        self.q = self._upload(np.tile(self.robot.q_home, (n, 1)).astype(np.float32), wp.float32)
        self.ee_pos, self.ee_lin_vel, self.ee_ang_vel = (self._array((n,), wp.vec3) for _ in range(3))
        self.ee_quat = self._upload(np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)).astype(np.float32), wp.vec4)
        self.gaze_point = self._array((n,), wp.vec3)
        self.gaze_weight = self._array((n,), wp.float32, 1.0)
        self.q_posture = self._upload(np.tile(self.robot.q_home[self.joints], (n, 1)).astype(np.float32), wp.float32)
        self.obstacle_type = self._array((n, m), wp.int32, distance.NO_OBSTACLE)
        self.obstacle_size = self._array((n, m), wp.vec3)
        self.obstacle_pos = self._array((n, m), wp.vec3)
        self.obstacle_quat = self._upload(
            np.tile(np.float32([1.0, 0.0, 0.0, 0.0]), (n, m, 1)).reshape(n, m, 4), wp.vec4
        )
        self.sphere_margin = self._array((n, len(self.spheres)), wp.float32)
        weights, gains = asdict(cfg.weights), asdict(cfg.gains)
        if cfg.solver == "paper":  # its equations know of neither
            weights |= {"look": 0.0, "face": 0.0}
        self.weights = self._upload(np.tile(np.float32([weights[k] for k in self.weight_names]), (n, 1)), wp.float32)
        self.gains = self._upload(np.tile(np.float32([gains[k] for k in self.gain_names]), (n, 1)), wp.float32)
        targets = wbc_assemble.Targets()
        for name in ("ee_pos", "ee_quat", "ee_lin_vel", "ee_ang_vel", "gaze_point", "gaze_weight", "q_posture"):
            setattr(targets, name, getattr(self, name))
        targets.weights, targets.gains = self.weights, self.gains
        self._targets = targets

    def _allocate_state(self) -> None:
        n, joints, rows = self.num_envs, len(self.joints), wbc_objectives.ROWS
        bodies, frames, spheres = len(self._tables.tree["body_parent"]), len(self.frame_names), len(self.spheres)
        groups, c = self._num_groups, self._num_candidates
        a = self._array
        self.qd, self.q_target, self.ctrl = (a((n, joints), wp.float32) for _ in range(3))
        self.frame_pos, self.frame_quat = a((n, frames), wp.vec3), a((n, frames), wp.vec4)
        self.min_distance = a((n,), wp.float32)
        self.iterations = a((n,), wp.int32)
        self._fresh = a((n,), wp.int32, 1)
        self._body_rot, self._body_pos = a((n, bodies), wp.mat33), a((n, bodies), wp.vec3)
        self._screw = a((n, joints), wp.spatial_vector)
        self._sphere_pos, self._ball = a((n, spheres), wp.vec3), a((n, groups), wp.vec4)
        self._obstacle_rot = a((n, self.num_obstacles), wp.mat33)
        self._obstacle_ball = a((n, self.num_obstacles), wp.vec4)
        self._count, self._nearest = a((n, groups + 1), wp.int32), a((n, groups + 1), wp.float32)
        self._force, self._moment = a((n, c), wp.vec3), a((n, c), wp.vec3)
        self._gap, self._bound, self._side = a((n, c), wp.float32), a((n, c), wp.float32), a((n, c), wp.vec2i)
        self._jac = a((n, rows, joints), wp.float32)
        self._vel, self._weight = a((n, rows), wp.float32), a((n, rows), wp.float32)
        self._diag, self._rhs = a((n, joints), wp.float32), a((n, joints), wp.float32)
        self._q_from, self._qd_from = a((n, joints), wp.float32), a((n, joints), wp.float32)
        self._low, self._high, self._x = (a((n, joints), wp.float64) for _ in range(3))
        self._twist = a((n, groups), wp.spatial_vectord)
        self._lack, self._rate = a((n, c), wp.float64), a((n, c), wp.float64)
        dampers = wbc_dampers.Dampers()
        dampers.region_start, dampers.count, dampers.screw = self._region_start, self._count, self._screw
        dampers.force, dampers.moment, dampers.bound, dampers.side = self._force, self._moment, self._bound, self._side
        self._dampers = dampers

    def _capture(self, launch) -> wp.Graph:
        launch()  # compiles and loads the kernels, which a capture must not do
        with wp.ScopedCapture(self.device) as capture:
            launch()
        return capture.graph  # pyright: ignore[reportReturnType]

    def _run(self, kernel: wp.Kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def _launch_kinematics(self) -> None:
        self._run(
            kinematics.forward_kinematics,
            self.num_envs,
            [self._tree, self.q],
            [self._body_rot, self._body_pos, self.frame_pos, self.frame_quat],
        )

    def _launch_distances(self) -> None:
        n, m, groups = self.num_envs, self.num_obstacles, self._num_groups
        tree, cfg = self._tree, self.cfg
        placed = [self._obstacle_rot, self._obstacle_ball, self.sphere_margin]
        placed += [self.gains, cfg.reach, cfg.dt, self._region_start]
        pairs = [self._block, self._pair, self.gains, cfg.reach_self, cfg.dt, self._region_start]
        found = [self._count, self._nearest, self._force, self._moment, self._gap, self._bound, self._side]
        self._run(
            kinematics.place_spheres,
            n,
            [tree, self._body_rot, self._body_pos],
            [self._screw, self._sphere_pos, self._ball],
        )
        self._run(
            distance.place_obstacles,
            (n, m),
            [tree, self._body_pos, self.obstacle_type, self.obstacle_size, self.obstacle_pos, self.obstacle_quat],
            [self._obstacle_rot, self._obstacle_ball],
        )
        self._run(
            distance.obstacle_candidates,
            (n, groups),
            [tree, self._sphere_pos, self._ball, self.obstacle_type, self.obstacle_size, *placed],
            found,
        )
        self._run(
            distance.self_candidates,
            n,
            [tree, self._sphere_pos, self._ball, *pairs],
            found,
        )

    def _launch_step(self) -> None:
        self._launch_kinematics()
        self._launch_distances()
        n, limits = self.num_envs, self._limits
        tasks = [self._jac, self._vel, self._weight]
        self._run(
            wbc_assemble.bound_velocities,
            n,
            [limits, self.q, self.q_target, self.qd, self._fresh],
            [self._q_from, self._qd_from, self._low, self._high],
        )
        pose = [self._body_pos, self.frame_pos, self.frame_quat, self._screw]
        self._run(
            wbc_assemble.assemble_tasks,
            n,
            [self._tree, self._frames, self._targets, limits, self.q, self._qd_from, *pose],
            [*tasks, self._diag, self._rhs],
        )
        if self.cfg.solver == "paper":
            self._launch_paper(pose, tasks)
        else:
            self._launch_qp(tasks)
        self._run(
            wbc_integrate.integrate,
            n,
            [self._x, self._low, self._high, self._q_from, limits.q_min, limits.q_max, limits.dt, self.cfg.lag],
            [self.qd, self.q_target, self.ctrl, self._fresh],
        )

    def _launch_qp(self, tasks: list[wp.array]) -> None:
        problem = [*tasks, self._diag, self._rhs, self._low, self._high, self._dampers, self._nearest]
        self._run(
            wbc_qp.solve_qp,
            self.num_envs,
            [self._tree, *problem, self.cfg.slack_weight, self.cfg.iterations, self._qd_from],
            [self._twist, self._lack, self._rate, self._x, self.iterations, self.min_distance],
        )

    def _launch_paper(self, pose: list[wp.array], tasks: list[wp.array]) -> None:
        found = [self._region_start, self._count, self._nearest, self._force, self._moment, self._gap, self._side]
        self._run(
            wbc_paper.paper_tasks, self.num_envs, [self._tree, self._frames, self._targets, self._qd_from, *pose], tasks
        )
        self._run(
            wbc_paper.paper_repulsion,
            self.num_envs,
            [self._tree, self._targets, self._screw, *found, self.cfg.reach, self.cfg.distance_floor],
            [self._diag, self._rhs, self.min_distance],
        )
        self._run(
            wbc_paper.solve_paper,
            self.num_envs,
            [*tasks, self._diag, self._rhs, self._q_from, self._limits],
            [self._low, self._high, self._x],
        )

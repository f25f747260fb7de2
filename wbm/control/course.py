"""A randomised obstacle course for the controller: table, shelf, clutter, targets that move and jump.

Tests, the benchmark and the pictures of the documentation all run this course, closed loop, with joints that follow
their targets perfectly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wbm.control.wbc import WholeBodyController
from wbm.robot.joints import ARM, BASE, NECK, WBC
from wbm.robot.model import RobotModel

PLANE, SPHERE, CAPSULE, CYLINDER, BOX = 0, 2, 3, 5, 6
NUM_OBSTACLES = 16
START_DISTANCE = 0.02
PENETRATION = 1e-3
LIMIT_TOLERANCE = 1e-6
SWITCH_TIME = 5.0


@dataclass(frozen=True)
class Course:
    """Obstacles [N,16] and the numbers from which targets follow; all lengths in m, angles in rad."""

    type: np.ndarray
    size: np.ndarray
    pos: np.ndarray
    quat: np.ndarray
    goal_pos: np.ndarray  # [N,K,3] centres of the target's motion, one for each SWITCH_TIME
    goal_quat: np.ndarray  # [N,K,4]
    sway: np.ndarray  # [N,K,3] amplitude
    rate: np.ndarray  # [N,K] rad/s

    def target(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Hand position [N,3], orientation [N,4] and point to look at [N,3] at time t (s)."""
        k = int(t / SWITCH_TIME) % self.goal_pos.shape[1]
        pos = self.goal_pos[:, k] + self.sway[:, k] * np.sin(self.rate[:, k, None] * t)
        return pos, self.goal_quat[:, k], pos - np.array([0.0, 0.0, 0.03])


def make_course(num_envs: int, seed: int, num_goals: int = 2) -> Course:
    """Draw the courses: floor, a table with two legs, a shelf of four boards, eight pieces of clutter.

    Args:
        num_envs: N.
        seed: of all random numbers.
        num_goals: targets an episode; each lasts SWITCH_TIME.
    """
    rng = np.random.default_rng(seed)
    n = num_envs
    kind = np.full((n, NUM_OBSTACLES), BOX, dtype=np.int32)
    size = np.zeros((n, NUM_OBSTACLES, 3))
    pos = np.zeros((n, NUM_OBSTACLES, 3))
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (n, NUM_OBSTACLES, 1))
    kind[:, 0] = PLANE
    height = rng.uniform(0.45, 0.8, n)
    half = np.stack([rng.uniform(0.25, 0.4, n), rng.uniform(0.4, 0.8, n)], axis=1)
    centre = np.stack([1.1 + half[:, 0], rng.uniform(-0.2, 0.2, n)], axis=1)
    size[:, 1] = np.c_[half, np.full(n, 0.02)]
    pos[:, 1] = np.c_[centre, height - 0.02]
    for i, side in ((2, -1.0), (3, 1.0)):
        size[:, i] = np.c_[half[:, 0] * 0.8, np.full(n, 0.03), height / 2 - 0.02]
        pos[:, i] = np.c_[centre[:, 0], centre[:, 1] + side * (half[:, 1] - 0.05), height / 2 - 0.02]
    _shelf(rng, n, size, pos)
    _clutter(rng, n, kind, size, pos, quat, centre, half, height)
    return Course(kind, size, pos, quat, *_goals(rng, n, num_goals, centre, half, height, pos))


def _shelf(rng: np.random.Generator, n: int, size: np.ndarray, pos: np.ndarray) -> None:
    """Boards at three heights and a back, beside the table on the left."""
    y = rng.uniform(1.5, 1.8, n)
    x = rng.uniform(0.2, 0.6, n)
    for i, z in enumerate((0.4, 0.8, 1.2)):
        size[:, 4 + i] = (0.45, 0.15, 0.012)
        pos[:, 4 + i] = np.c_[x, y, z + rng.uniform(-0.05, 0.05, n)]
    size[:, 7] = (0.45, 0.012, 0.65)
    pos[:, 7] = np.c_[x, y + 0.16, np.full(n, 0.65)]


def _clutter(rng, n, kind, size, pos, quat, centre, half, height) -> None:
    """Four things on the table, two hanging in the air, two standing on the floor."""
    for i in range(8, 16):
        kind[:, i] = rng.choice([SPHERE, CAPSULE, CYLINDER, BOX], n)
        size[:, i] = rng.uniform(0.025, 0.09, (n, 3))
        yaw = rng.uniform(-np.pi, np.pi, n)
        quat[:, i] = np.c_[np.cos(yaw / 2), np.zeros(n), np.zeros(n), np.sin(yaw / 2)]
        if i < 12:
            pos[:, i, :2] = centre + rng.uniform(-0.9, 0.9, (n, 2)) * half
            pos[:, i, 2] = height + 0.07
        elif i < 14:
            pos[:, i] = rng.uniform([0.6, -0.9, 0.7], [1.6, 0.9, 1.4], (n, 3))
            quat[:, i] = rng.normal(size=(n, 4))
        else:
            kind[:, i] = np.where(rng.random(n) < 0.5, CYLINDER, BOX)
            size[:, i] = np.c_[rng.uniform(0.05, 0.15, n), rng.uniform(0.1, 0.4, n), rng.uniform(0.1, 0.4, n)]
            pos[:, i] = np.c_[rng.uniform(0.2, 1.0, n), rng.uniform(-1.6, -0.6, n), np.full(n, 0.3)]


def _goals(rng, n, num_goals, centre, half, height, pos):
    """Half of the goals over the table with the palm down, the rest at the shelf, in the clutter or out of reach."""
    goal = np.zeros((n, num_goals, 3))
    quat = np.zeros((n, num_goals, 4))
    for k in range(num_goals):
        choice = rng.random(n)
        spot = np.c_[centre + rng.uniform(-0.8, 0.8, (n, 2)) * half, height + rng.uniform(0.03, 0.3, n)]
        shelf = pos[:, 5] + rng.uniform([-0.4, -0.25, 0.05], [0.4, 0.0, 0.3], (n, 3))
        clutter = pos[np.arange(n), rng.integers(8, 16, n)]
        far = rng.uniform([-2.0, -2.0, 0.1], [2.5, 2.0, 1.6], (n, 3))
        goal[:, k] = np.select(
            [c[:, None] for c in (choice < 0.5, choice < 0.75, choice < 0.9)], [spot, shelf, clutter], far
        )
        yaw = rng.uniform(-np.pi, np.pi, n)
        down = np.c_[np.zeros(n), np.cos(yaw / 2), np.sin(yaw / 2), np.zeros(n)]
        level = np.c_[np.cos(yaw / 2), np.zeros(n), np.zeros(n), np.sin(yaw / 2)] @ _TO_SIDE.T
        quat[:, k] = np.where((choice < 0.6)[:, None], down, level)
    sway = rng.uniform(-0.15, 0.15, (n, num_goals, 3))
    return goal, quat, sway, rng.uniform(0.3, 2.0, (n, num_goals))


# Right multiplication by a quarter turn about y, which lays the approach axis level.
_TO_SIDE = np.sqrt(0.5) * np.array([[1, 0, -1, 0], [0, 1, 0, -1], [1, 0, 1, 0], [0, 1, 0, 1]], dtype=float)


def set_obstacles(controller: WholeBodyController, course: Course) -> None:
    """Copy a course's obstacles into the controller's live arrays."""
    for name in ("type", "size", "pos", "quat"):
        target = getattr(controller, f"obstacle_{name}")
        target.assign(np.ascontiguousarray(getattr(course, name), dtype=np.int32 if name == "type" else np.float32))


def start_states(robot: RobotModel, controller: WholeBodyController, seed: int, tries: int = 60) -> np.ndarray:
    """Collision-free joints [N,32]: a random place and heading of the base, the arm and neck near home."""
    rng = np.random.default_rng(seed)
    n = controller.num_envs
    q = np.tile(robot.q_home, (n, 1))
    open_envs = np.arange(n)
    for attempt in range(tries):
        m = len(open_envs)
        spread = 0.25 if attempt < tries // 2 else 0.0
        q[open_envs, BASE] = np.c_[rng.uniform(-1.2, 0.5, m), rng.uniform(-1.0, 0.8, m), rng.uniform(-np.pi, np.pi, m)]
        for part in (ARM, NECK):
            noise = rng.uniform(-spread, spread, (m, part.stop - part.start))
            q[open_envs, part] = np.clip(robot.q_home[part] + noise, robot.q_min[part], robot.q_max[part])
        controller.q.assign(q.astype(np.float32))
        controller.reset()
        controller.step()
        open_envs = np.flatnonzero(controller.min_distance.numpy() < START_DISTANCE)
        if len(open_envs) == 0:
            break
    # A course that leaves no room near it is started from farther back.
    q[open_envs, BASE] = np.array([-3.0, -3.0, 0.0])
    return q


@dataclass
class Tally:
    """What happened over the control steps of a course.

    `worst` holds the largest violation of position, velocity and acceleration limits (rad, rad/s, rad/s per step).
    """

    steps: int = 0
    episodes: int = 0
    colliding_steps: int = 0
    colliding_episodes: int = 0
    nan: int = 0
    limit_violations: int = 0
    worst: tuple[float, float, float] = (0.0, 0.0, 0.0)
    deepest: float = 0.0
    iterations: int = 0

    def add(self, controller: WholeBodyController, qd_before: np.ndarray, hit: np.ndarray) -> None:
        """Count one step; `hit [N]` marks the environments that have collided in this episode and is updated."""
        robot, dt = controller.robot, controller.cfg.dt
        qd = controller.qd.numpy().astype(np.float64)
        target = controller.q_target.numpy().astype(np.float64)
        distance = controller.min_distance.numpy()
        low, high, speed, acc = (getattr(robot, k)[WBC] for k in ("q_min", "q_max", "qd_max", "qdd_max"))
        over = (
            np.maximum(target - high, low - target),
            np.abs(qd) - speed,
            np.abs(qd - qd_before) - acc * dt,
        )
        self.nan += int((~np.isfinite(qd) | ~np.isfinite(target)).any(axis=1).sum())
        self.limit_violations += int(sum((x > LIMIT_TOLERANCE).sum() for x in over))
        self.worst = tuple(max(w, float(x.max())) for w, x in zip(self.worst, over, strict=True))
        deep = distance < -PENETRATION
        hit |= deep
        self.colliding_steps += int(deep.sum())
        self.deepest = min(self.deepest, float(distance.min()))
        self.steps += len(qd)
        self.iterations += int(controller.iterations.numpy().sum())


def run_course(
    controller: WholeBodyController, seed: int, episodes: int, steps: int, tally: Tally | None = None
) -> Tally:
    """Run episodes of a new course each, all environments at once.

    Args:
        controller: with 16 obstacle slots; its joints follow `q_target` perfectly.
        seed: of courses and start states.
        episodes: courses in turn.
        steps: control steps an episode.
        tally: continues this count.
    """
    tally = tally or Tally()
    for episode in range(episodes):
        course = make_course(controller.num_envs, seed * 1000 + episode)
        set_obstacles(controller, course)
        q = start_states(controller.robot, controller, seed * 1000 + episode).astype(np.float32)
        controller.q.assign(q)
        controller.reset()
        before = np.zeros((controller.num_envs, len(WBC)))
        hit = np.zeros(controller.num_envs, dtype=bool)
        for k in range(steps):
            set_target(controller, course, k * controller.cfg.dt)
            controller.step()
            tally.add(controller, before, hit)
            before = controller.qd.numpy().astype(np.float64)
            q[:, WBC] = controller.q_target.numpy()
            controller.q.assign(q)
        tally.episodes += controller.num_envs
        tally.colliding_episodes += int(hit.sum())
    return tally


def set_target(controller: WholeBodyController, course: Course, t: float) -> None:
    """Write the course's target at time t (s) into the controller."""
    pos, quat, look = course.target(t)
    for array, value in ((controller.ee_pos, pos), (controller.ee_quat, quat), (controller.gaze_point, look)):
        array.assign(np.ascontiguousarray(value, dtype=np.float32))

"""Pre-grasp starts: the planner's own comes first; starts off the way are clear, bounded and repeatable.

Distances of the controller are float32: compared with float64 spheres at 1e-4 m.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.env_world import world
from wbm.control.base_path import Obstacles
from wbm.control.config import WbcConfig
from wbm.envs import pregrasp
from wbm.envs.actions import HAND_CLOSED
from wbm.envs.config import EnvConfig, ScatterConfig
from wbm.envs.pregrasp import NECK_ASIDE, ROOMY, StartBank, scatter_starts, solve_starts
from wbm.robot import joints
from wbm.robot.model import load_robot
from wbm.robot.spheres import robot_spheres, self_pairs, sphere_positions


def test_the_first_of_a_scene_is_given_out_as_a_copy():
    bank = StartBank(torch.arange(2 * 3 * 32, dtype=torch.float32).view(2, 3, 32), torch.tensor([3, 1]))
    first = bank.first(torch.tensor([1, 0, 1]))
    assert first[:, 0].tolist() == [96.0, 0.0, 96.0]
    first.zero_()
    assert float(bank.q[1, 0, 5]) == 101.0


class ScriptedSolver:
    """In place of the controller: candidates succeed, with more or less room, as a random generator has it."""

    rng: np.random.Generator
    tried: list[tuple[int, float, bool, float, bool]]
    """Scene, mark in the joints, good, room, and whether the base stands where the planner's own does."""

    def __init__(self, table, robot, cfg, size, device):
        self.table, self.size = table, size

    def solve(self, scenes, pos, quat, base, iterations):
        count = len(scenes)
        assert count <= self.size
        own = (base == self.table.base[scenes]).all(1)
        good = torch.from_numpy(self.rng.random(count) < 0.6)
        room = torch.from_numpy(self.rng.uniform(0.006, 0.03, count).astype("f4"))
        q = torch.zeros(count, joints.NUM_JOINTS)
        for i in range(count):
            q[i] = len(self.tried)
            self.tried.append((int(scenes[i]), float(q[i, 0]), bool(good[i]), float(room[i]), bool(own[i])))
        return q, good, room


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), keep=st.integers(1, 3), batch=st.sampled_from([3, 64]))
def test_the_planners_own_comes_first_where_it_has_room_else_the_roomiest(monkeypatch, seed, keep, batch):
    table = world()[0].table  # made once and kept, so never with the scripted solver
    monkeypatch.setattr(pregrasp, "_Solver", ScriptedSolver)
    ScriptedSolver.rng, ScriptedSolver.tried = np.random.default_rng(seed), []
    cfg = replace(EnvConfig(), starts_per_scene=keep)
    try:
        bank = solve_starts(table, load_robot(), WbcConfig(), cfg, "top_down", seed, batch=batch)
    except ValueError:
        assert not any(good for _, _, good, _, _ in ScriptedSolver.tried)
        return
    for scene in range(table.count):
        tries = [t for t in ScriptedSolver.tried if t[0] == scene]
        assert [own for *_, own in tries] == [True] + [False] * (len(tries) - 1)
        kept = [t for t in tries if t[2]][:keep]
        assert int(bank.count[scene]) == len(kept)
        if kept:
            best = next((t for t in kept if t[4] and t[3] > ROOMY), max(kept, key=lambda t: t[3]))
            marks = bank.q[scene, : len(kept), 0].tolist()
            assert marks[0] == best[1] and sorted(marks) == sorted(t[1] for t in kept)
            assert float(bank.clearance[scene]) == max(t[3] for t in kept)
        else:
            assert float(bank.clearance[scene]) == -np.inf


def test_candidates_do_not_depend_on_those_that_are_solved_beside_them(monkeypatch):
    cfg = replace(EnvConfig(), starts_per_scene=2)
    banks = []
    for few, batch in (((16, 96), 512), ((40,), 512), ((3,), 3)):
        monkeypatch.setattr(pregrasp, "FEW", few)
        banks.append(solve_starts(world()[0].table, load_robot(), WbcConfig(), cfg, "top_down", batch=batch))
    for other in banks[1:]:
        assert torch.equal(banks[0].q, other.q) and torch.equal(banks[0].count, other.count)
        assert torch.equal(banks[0].clearance, other.clearance)


def clearance(scene: int, q: np.ndarray) -> float:
    """Distance of the robot's spheres from the scene's obstacles and of its pairs from each other, float64, m."""
    robot, t = load_robot(), world()[0].table
    spheres = robot_spheres(robot)
    at = sphere_positions(robot, spheres, q.astype(np.float64)[None])[0]
    rows = (t.obstacle_type, t.obstacle_size, t.obstacle_pos, t.obstacle_quat)
    obstacles = Obstacles(*(r[scene].numpy().astype(np.float64) for r in rows))
    a, b = self_pairs(robot, spheres).T
    apart = np.linalg.norm(at[a] - at[b], axis=1) - spheres.radius[a] - spheres.radius[b]
    return float(min((obstacles.distance(at) - spheres.radius).min(), apart.min()))


def test_scattered_starts_are_clear_bounded_and_repeatable():
    binding, starts = world()
    robot, cfg = load_robot(), ScatterConfig()
    goal, begin = starts.q[:, 0], binding.table.q_start

    def scatter(seed: int, batch: int = 512) -> torch.Tensor:
        return scatter_starts(binding.table, robot, WbcConfig(), cfg, goal, seed, batch=batch)

    out = scatter(7)
    assert torch.equal(out, scatter(7, batch=3)) and not torch.equal(out, scatter(8))
    assert out.shape == (binding.table.count, cfg.per_scene, 32)
    bound = np.zeros(32)
    bound[:2], bound[2], bound[joints.ARM], bound[joints.NECK] = cfg.base, cfg.yaw, cfg.arm, cfg.neck
    body = np.r_[joints.WBC]
    placed = (out != begin.unsqueeze(1)).any(-1)
    assert float(placed.float().mean()) > 0.9
    for scene, place in placed.nonzero().tolist():
        q, a, b = (x.numpy().astype(np.float64) for x in (out[scene, place], begin[scene], goal[scene]))
        opened = q.copy()
        opened[joints.HAND] = b[joints.HAND]
        assert clearance(scene, opened) > cfg.clearance - 1e-4
        assert (q >= robot.q_min - 1e-6).all() and (q <= robot.q_max + 1e-6).all()
        open_to_closed = np.asarray(HAND_CLOSED) - b[joints.HAND]
        grip = (q - b)[joints.HAND] / np.where(np.abs(open_to_closed) > 1e-6, open_to_closed, np.inf)
        assert grip.min() >= -1e-5 and grip.max() <= 1.0 + 1e-5 and np.ptp(grip[np.abs(open_to_closed) > 1e-6]) < 1e-4
        # There is one place on the way from which every joint is within its offset.
        way = (b - a)[body]
        moving = np.abs(way) > 1e-6
        ends = ((q - a)[body] + np.array([[-1.0], [1.0]]) * (bound[body] + 1e-5))[:, moving] / way[moving]
        assert max(ends.min(0).max(), 0.0) <= min(ends.max(0).min(), 1.0)
    assert len(torch.unique(out.view(-1, 32), dim=0)) == int(placed.sum()) + int((~placed).any(1).sum())


def test_where_nothing_is_clear_enough_a_scattered_start_is_the_scenes_own():
    binding, starts = world()
    cfg = ScatterConfig(per_scene=2, clearance=2e6)  # more than the controller says where nothing is near
    out = scatter_starts(binding.table, load_robot(), WbcConfig(), cfg, starts.q[:, 0], rounds=2)
    assert torch.equal(out, binding.table.q_start.unsqueeze(1).expand(-1, 2, -1))


def test_the_gaze_starts_aside_as_far_as_the_neck_turns():
    standard = load_robot()
    low, high = standard.q_min.copy(), standard.q_max.copy()
    low[joints.NECK], high[joints.NECK] = -0.5, 0.5
    for robot in (standard, replace(standard, q_min=low, q_max=high)):
        home = pregrasp._Solver(world()[0].table, robot, WbcConfig(), 2, "cpu").home.numpy()
        expected = np.clip(NECK_ASIDE, robot.q_min[joints.NECK], robot.q_max[joints.NECK])
        np.testing.assert_allclose(home[joints.NECK], expected, rtol=1e-6)
        np.testing.assert_allclose(home[joints.ARM], robot.q_home[joints.ARM], rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [({"per_scene": 0}, "per_scene must be at least 1"), ({"arm": -0.1}, "no offset negative")],
)
def test_impossible_scatter_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        ScatterConfig(**change)

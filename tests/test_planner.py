"""Pre-grasps, the choice among them, and the base's way around a box that stands in it."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.env_world import scenes, world
from wbm.control.base_path import MARGIN, BaseMap, Obstacles, base_path
from wbm.control.config import WbcConfig
from wbm.control.planner import COMFORT, GRASPS, SIDE_ROOM, Target, choose_grasp, fits, pregrasp_poses
from wbm.envs import whole_body
from wbm.envs.binding import SceneBinding
from wbm.envs.config import EnvConfig
from wbm.envs.outcome import FORBIDDEN
from wbm.envs.pregrasp import StartBank
from wbm.envs.rotations import quat_to_mat
from wbm.envs.whole_body import CONTACT, WholeBodyEnv
from wbm.envs.world import WorldConfig, find_starts
from wbm.robot import joints
from wbm.robot.config import MjcfOptions
from wbm.robot.model import load_robot
from wbm.scenes.bank import SceneBank
from wbm.sim.config import SimConfig

BOX = 6


def target(half=(0.05, 0.02, 0.1), yaw=0.3, heading=0.1, ceiling=np.inf) -> Target:
    def row(*x):
        return torch.tensor([x], dtype=torch.float32)

    quat = row(np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2))
    angle = np.arange(180) * np.pi / 180 - yaw
    width = row(*(2 * half[0] * np.abs(np.cos(angle)) + 2 * half[1] * np.abs(np.sin(angle))))
    return Target(row(1.0, 0.2, 0.8), quat, row(*half), width, row(heading)[0], row(0.8 - half[2])[0], row(ceiling)[0])


def test_a_top_down_grasp_closes_across_the_narrow_side_and_points_away_from_the_base():
    pos, quat = pregrasp_poses(target(), "top_down", 0.06, torch.tensor([0.5]))
    mat = quat_to_mat(quat)[0]
    torch.testing.assert_close(pos[0], torch.tensor([1.0, 0.2, 0.8 + 0.1 + 0.06]))
    torch.testing.assert_close(mat[:, 2], torch.tensor([0.0, 0.0, -1.0]), atol=1e-6, rtol=0)
    narrow = torch.tensor([-np.sin(0.3), np.cos(0.3), 0.0], dtype=torch.float32)
    assert abs(float(mat[:, 0] @ narrow)) > 0.9999
    away = torch.tensor([np.cos(0.1), np.sin(0.1), 0.0], dtype=torch.float32)
    assert float(mat[:, 0] @ away) >= 0.0


@pytest.mark.parametrize("swing", [0.0, 0.5, 1.0])
def test_a_side_grasp_is_level_and_comes_from_where_the_base_stands(swing):
    pos, quat = pregrasp_poses(target(), "side", 0.06, torch.tensor([swing]))
    mat = quat_to_mat(quat)[0]
    heading = 0.1 + 1.2 * (swing - 0.5)
    ahead = torch.tensor([np.cos(heading), np.sin(heading), 0.0], dtype=torch.float32)
    torch.testing.assert_close(mat[:, 2], ahead, atol=1e-6, rtol=0)
    torch.testing.assert_close(mat[:, 1], torch.tensor([0.0, 0.0, 1.0]), atol=1e-6, rtol=0)
    offset = torch.tensor([1.0, 0.2, 0.8]) - pos[0]
    assert float(offset @ ahead) > 0.06 + 0.05
    torch.testing.assert_close(offset, ahead * (offset @ ahead), atol=1e-5, rtol=0)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_top_down_grasp_takes_the_cheapest_width_of_float64(seed):
    """Boxes from long to nearly square: width against what closing across the heading costs."""
    rng = np.random.default_rng(seed)
    half = (0.04 + rng.uniform(0.0, 0.03) * rng.integers(2), 0.04, 0.05)
    heading, yaw = rng.uniform(-np.pi, np.pi, 2)
    box = target(half, yaw, heading)
    closing = quat_to_mat(pregrasp_poses(box, "top_down", 0.06, torch.tensor([0.5]))[1])[0, :, 0].double().numpy()

    def cost(angle):
        width = 2 * (half[0] * np.abs(np.cos(angle - yaw)) + half[1] * np.abs(np.sin(angle - yaw)))
        return width + COMFORT * np.sin(angle - heading) ** 2

    every = np.linspace(0.0, np.pi, 180, endpoint=False)
    taken = cost(np.arctan2(closing[1], closing[0]))
    assert taken == pytest.approx(cost(every).min(), abs=1e-6)
    assert closing @ [np.cos(heading), np.sin(heading), 0.0] >= -1e-6  # away from the base


@pytest.mark.parametrize("heading", [-2.0, 0.0, 0.7, 3.1])
def test_a_round_thing_is_closed_upon_along_the_heading(heading):
    round_thing = replace(target(heading=heading), width=torch.full((1, 180), 0.07))
    closing = quat_to_mat(pregrasp_poses(round_thing, "top_down", 0.06, torch.tensor([0.5]))[1])[0, :, 0]
    ahead = torch.tensor([np.cos(heading), np.sin(heading), 0.0], dtype=torch.float32)
    assert float(closing @ ahead) > np.cos(np.radians(0.51))  # the nearest of 180 directions


@pytest.mark.parametrize("half_height", [0.03, 0.099, 0.101, 0.2])
def test_a_side_grasp_keeps_room_below_the_hand(half_height):
    pos, _ = pregrasp_poses(target(half=(0.03, 0.03, half_height)), "side", 0.06, torch.tensor([0.5]))
    assert float(pos[0, 2]) == pytest.approx(max(0.8, 0.8 - half_height + SIDE_ROOM), abs=1e-6)


def test_geometry_rules_grasps_out():
    assert bool(fits(target(), "top_down", 0.06)) and bool(fits(target(), "side", 0.06))
    assert not bool(fits(target(ceiling=1.0), "top_down", 0.06))
    assert not bool(fits(target(half=(0.05, 0.02, 0.02)), "side", 0.06))


def test_the_preferred_grasp_is_taken_unless_the_other_has_far_more_room():
    none = -torch.inf
    clearance = torch.tensor([[0.02, 0.005, none, none, 0.2], [0.06, 0.06, 0.01, none, 0.2]])
    assert choose_grasp(clearance, torch.tensor([0, 0, 0, 0, 1])).tolist() == [0, 1, 1, -1, 1]


def fenced(bank: SceneBank) -> SceneBank:
    """The same tables with a board before and behind every target, lower than a hand from above needs."""
    arrays = {k: getattr(bank, k).copy() for k in ("support_pos", "support_size", "support_quat", "support_count")}
    for row in range(len(bank)):
        for side in (-1.0, 1.0):
            k = int(arrays["support_count"][row])
            target = bank.object_pos[row, 0]
            arrays["support_pos"][row, k] = [target[0] + side * 0.17, target[1], bank.surface_z[row] + 0.06]
            arrays["support_size"][row, k] = [0.01, 0.5, 0.06]
            arrays["support_quat"][row, k] = [1.0, 0.0, 0.0, 0.0]
            arrays["support_count"][row] = k + 1
    return replace(bank, **arrays)


def test_a_hint_that_cannot_be_followed_gives_way_to_another_grasp():
    model, bank = scenes()
    bank = fenced(bank)
    bank = replace(bank, approach=np.full(len(bank), GRASPS.index("side")))
    cfg = WorldConfig(MjcfOptions(), SimConfig(), WbcConfig(), replace(EnvConfig(), starts_per_scene=1))
    binding = SceneBinding(model, bank, bank.where("train")[:2])
    with pytest.raises(ValueError, match="no scene has a reachable pre-grasp"):
        find_starts(binding, cfg, 0, "cpu")
    starts, chosen = find_starts(binding, cfg, 0, "cpu", GRASPS)
    assert chosen.tolist() == [GRASPS.index("top_down")] * 2 and starts.count.tolist() == [1, 1]


def boxes(*rows) -> Obstacles:
    """Upright boxes from (x, y, z, half x, half y, half z)."""
    at = np.array(rows, dtype=float).reshape(-1, 6)
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (len(at), 1))
    return Obstacles(np.full(len(at), BOX), at[:, 3:], at[:, :3], quat)


def test_the_path_goes_around_what_blocks_it_and_only_then():
    robot = load_robot()
    start, goal = np.zeros(2), np.array([3.0, 0.0])
    aside = BaseMap(robot, robot.q_home, 0.0, boxes((1.2, 2.0, 0.4, 0.2, 0.3, 0.4)))
    assert len(base_path(aside, start, goal)) == 0
    between = BaseMap(robot, robot.q_home, 0.0, boxes((1.5, 0.1, 0.4, 0.2, 0.5, 0.4)))
    corners = base_path(between, start, goal)
    assert len(corners) >= 2 and np.linalg.norm(corners[-1] - goal) < 0.1
    way = np.concatenate([start[None], corners])
    for a, b in pairwise(way):
        assert between.free_line(a, b)
    assert corners[:, 1].min() < 0.1 - 0.5 - MARGIN  # the nearer way round is on the right
    wall = BaseMap(robot, robot.q_home, 0.0, boxes((1.5, 0.0, 0.4, 0.2, 9.0, 0.4)))
    assert len(base_path(wall, start, goal)) == 0


def test_distances_of_every_primitive():
    identity = np.array([[1.0, 0.0, 0.0, 0.0]])
    point = np.array([[0.5, 0.0, 0.5]])
    for kind, size, expected in (
        (2, (0.1, 0, 0), np.sqrt(0.5) - 0.1),
        (3, (0.1, 0.2, 0), np.hypot(0.5, 0.3) - 0.1),
        (5, (0.1, 0.2, 0), np.hypot(0.4, 0.3)),
        (BOX, (0.1, 0.2, 0.3), np.hypot(0.4, 0.2)),
        (0, (0, 0, 0), np.inf),
        (-1, (0, 0, 0), np.inf),
    ):
        one = Obstacles(np.array([kind]), np.array([size]), np.zeros((1, 3)), identity)
        assert one.distance(point)[0] == pytest.approx(expected)


def blocked_world() -> tuple[SceneBinding, StartBank]:
    """The small world with a box on the floor between every start and its table."""
    binding, starts = world()
    bank, rows = binding.bank, binding.scenes
    arrays = {
        k: getattr(bank, k).copy() for k in ("support_pos", "support_size", "support_quat", "support_count", "q_start")
    }
    for row, q in zip(rows, starts.q[:, 0].numpy(), strict=True):
        k = int(arrays["support_count"][row])
        yaw = float(q[2])
        ahead = np.array([np.cos(yaw), np.sin(yaw)])
        arrays["q_start"][row, :3] = [*(q[:2] - 2.6 * ahead), yaw]
        arrays["support_pos"][row, k] = [*(q[:2] - 1.25 * ahead), 0.35]
        arrays["support_size"][row, k] = [0.12, 0.35, 0.35]
        arrays["support_quat"][row, k] = [np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]
        arrays["support_count"][row] = k + 1
    return SceneBinding(binding.scene_model, replace(bank, **arrays), rows), starts


def approach(seconds: float = 16.0) -> tuple[bool, bool]:
    """Whether all hands arrive at their pre-grasps, and whether any episode ends in a forbidden contact before."""
    binding, starts = blocked_world()
    cfg = replace(EnvConfig(), approach_s=seconds)
    sim = SimConfig()
    env = WholeBodyEnv(binding, starts, load_robot(), cfg, sim, WbcConfig(), 2)
    env.reset()
    still = torch.zeros(2, env.num_actions)
    arrived, hit = torch.zeros(2, dtype=torch.bool), False
    for _ in range(round(seconds / env.period)):
        _, _, done, info = env.step(still)
        arrived |= (env.phase == CONTACT) & ~done
        hit |= bool(((info["outcome"] == FORBIDDEN) & ~arrived).any())
        if bool(arrived.all()) or hit:
            break
    return bool(arrived.all()), hit


def test_an_episode_arrives_around_a_box_where_the_straight_way_does_not(monkeypatch):
    assert approach() == (True, False)
    monkeypatch.setattr(whole_body, "base_path", lambda *_: np.zeros((0, 2)))
    arrived, _ = approach()
    assert not arrived


def test_detours_leave_the_hand_alone():
    """The joints of the hand are commanded as ever while the base takes its way."""
    binding, starts = blocked_world()
    env = WholeBodyEnv(binding, starts, load_robot(), EnvConfig(), SimConfig(), WbcConfig(), 1)
    env.reset()
    for _ in range(10):
        env.step(torch.zeros(1, env.num_actions))
    assert int(env._corners[0]) > 0
    torch.testing.assert_close(env.ctrl[:, joints.HAND], env._goal_q[:, joints.HAND].to(env.ctrl), atol=0.02, rtol=0)

"""Partial observability: what counts as seen, what is remembered, and that the ablations change only what they say."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
import warp as wp

from tests.env_world import make, scenes
from wbm.envs.config import ActionConfig, EnvConfig
from wbm.envs.perception import MIN_TARGET_PIXELS, Perception
from wbm.envs.seen import LABELS
from wbm.envs.seen_config import SeenConfig
from wbm.envs.seen_env import SeenEnv
from wbm.envs.whole_body import CONTACT
from wbm.robot import joints
from wbm.robot.model import load_robot
from wbm.robot.schema import PolicySchema
from wbm.sensors.config import DepthConfig, SensorsConfig

ARMS = {
    "full": ActionConfig(),
    "no_active_vision": ActionConfig(neck="fixed"),
    "joint_space": ActionConfig(term="joint"),
}


def seen_env(arm: str = "full", num_envs: int = 4, **changes) -> SeenEnv:
    cfg = EnvConfig(start="whole_body", observe="seen", action=ARMS[arm], **changes)
    env = make(num_envs, cfg, kind=SeenEnv)
    assert isinstance(env, SeenEnv)
    return env


def test_a_few_rays_agree_with_a_whole_depth_image() -> None:
    env = seen_env("joint_space", 6)
    model, bank = scenes()
    sensors = replace(SensorsConfig(), depth=DepthConfig())
    camera = Perception(load_robot(), model.objects, bank.select(env.binding.scenes), sensors, PolicySchema(), 6)
    env.reset()
    camera.begin(torch.arange(6), env.scene, env.episode, torch.zeros(6, PolicySchema().text_dim))
    generator = torch.Generator().manual_seed(1)
    both = torch.zeros(2, 2)
    for _ in range(12):
        # The neck looks anywhere and the arm hangs anywhere: in view, out of view and hidden all happen.
        q = env.state.q.float().clone()
        spread = torch.tensor([0.5] * 7 + [0.9] * 6)
        at = [*range(3, 10), *range(26, 32)]
        q[:, at] += spread * torch.randn(6, 13, generator=generator)
        sight = camera.observe(q, q * 0, env.object_poses().float(), q * 0, env.elapsed)
        shown = sight.target_pixels >= MIN_TARGET_PIXELS
        valid = torch.from_numpy(camera.camera.ok.numpy()) > 0  # not with the camera inside the arm
        seen = env.sightline.look(q, env.state.obj_pos_w, env.state.obj_quat, env.state.obj_half)
        for a, b in zip(shown[valid].long(), seen[valid].long(), strict=True):
            both[a, b] += 1
    assert both[0].sum() > 10 and both[1].sum() > 10, "both cases occur"
    assert both.diag().sum() / both.sum() >= 0.9, both


def test_an_obstacle_in_the_way_hides_the_target() -> None:
    env = seen_env(num_envs=2)
    env.reset()
    s = env.state
    look = lambda: env.sightline.look(s.q, s.obj_pos_w, s.obj_quat, s.obj_half).tolist()
    for _ in range(15):
        env.step(torch.zeros(2, env.num_actions))
    s = env.state
    assert look() == [True, True]
    eye = env.sightline.links.frames(["camera"])[0][:, 0]
    kind, size, pos, quat = env.obstacles
    kind[0, -1], size[0, -1], quat[0, -1] = 6, 0.06, torch.tensor([1.0, 0, 0, 0])
    pos[0, -1] = 0.5 * (eye[0] + s.obj_pos_w[0])
    assert look() == [False, True]


def test_out_of_sight_the_last_pose_is_kept_and_ages() -> None:
    env = seen_env(num_envs=2)
    env.reset()
    for _ in range(15):
        env.step(torch.zeros(2, env.num_actions))
    assert bool(env.belief.seen.all())
    torch.testing.assert_close(env.belief.pos, env.state.obj_pos_w)
    at = env.observe.labels.index
    assert env.obs[:, at("seen")].tolist() == [1, 1] and env.obs[:, at("seen_age")].tolist() == [0, 0]
    before = env.belief.pos.clone()
    env.sightline.look = lambda *_: torch.tensor([True, False])
    env.sim.qpos[:, env.binding.target_qpos.start] += 0.05  # somebody moves both objects
    for _ in range(5):
        env.step(torch.zeros(2, env.num_actions))
    assert float((env.belief.pos[0] - before[0]).norm()) > 0.03
    assert torch.equal(env.belief.pos[1], before[1])
    assert env.obs[:, at("seen")].tolist() == [1, 0]
    assert float(env.obs[1, at("seen_age")]) == pytest.approx(5 * env.period / env.cfg.seen.memory_s)
    # The gaze follows what is known, the reward what is true.
    torch.testing.assert_close(env.gaze, env.known.obj_pos_w)
    assert float((env.state.obj_pos_w[1] - env.known.obj_pos_w[1]).norm()) > 0.03


def test_an_episode_starts_with_a_hint_that_is_off_by_no_more_than_it_says() -> None:
    env = seen_env(num_envs=8, seen=SeenConfig(hint_error=0.1))
    env.sightline.look = lambda *_: torch.zeros(8, dtype=torch.bool)
    env.reset()
    error = env.belief.pos - env.reader.start_pos
    assert bool((error[:, :2].norm(dim=-1) <= 0.1).all()) and float(error[:, :2].norm(dim=-1).max()) > 0.03
    assert bool((error[:, 2] == 0).all())
    assert env.obs[:, env.observe.labels.index("seen_age")].tolist() == [1.0] * 8


@pytest.mark.parametrize("arm", ARMS)
def test_restored_environment_continues_bit_for_bit(arm) -> None:
    torch.manual_seed(0)
    env, other = (seen_env(arm, 3, episode_s=1.2, approach_s=1.0) for _ in range(2))
    env.reset()
    actions = 0.5 * torch.randn(80, 3, env.num_actions)
    for action in actions[:45]:
        env.step(action)
    other.load_state_dict(env.state_dict())
    assert torch.equal(other.obs, env.obs)
    for action in actions[45:]:
        a, b = env.step(action), other.step(action)
        for left, right in zip(a[:3], b[:3], strict=True):
            assert torch.equal(left, right)
    assert env.next_episode > 3


def test_the_arms_differ_only_in_what_they_are_named_for() -> None:
    envs = {arm: seen_env(arm, 2) for arm in ARMS}
    obs = {arm: env.reset() for arm, env in envs.items()}
    home = torch.tensor(load_robot().q_home[joints.NECK], dtype=torch.float32)
    shared = envs["full"].observe.labels[: -len(LABELS)][:100]
    for arm, env in envs.items():
        assert env.observe.labels[:100] == shared and env.observe.labels[-len(LABELS) :] == LABELS
        torch.testing.assert_close(obs[arm][:, :100], obs["full"][:, :100])
        assert torch.equal(env.scene, envs["full"].scene)
    full, fixed, joint = envs.values()
    assert joint.num_actions == joints.NUM_JOINTS and bool((joint.phase == CONTACT).all())
    for _ in range(30):
        for env in envs.values():
            env.step(torch.zeros(2, env.num_actions))
    torch.testing.assert_close(fixed.ctrl[:, joints.NECK], home.expand(2, 6))
    assert float((full.ctrl[:, joints.NECK] - home).abs().max()) > 0.05
    fixed.step_targets(torch.zeros(2, 32))
    torch.testing.assert_close(fixed.ctrl[:, joints.NECK], home.expand(2, 6))
    # Without a controller nothing moves the robot but the policy.
    moved = lambda env: float((env.state.q[:, :2] - env.binding.table.q_start[env.scene][:, :2]).norm(dim=-1).min())
    assert moved(full) > 0.1 > moved(joint)
    assert joint.limit_steps == full.limit_steps


def test_settings_are_checked() -> None:
    for bad in ({"rays": 8}, {"hint_error": -1.0}, {"min_range": 4.0}, {"hfov_deg": 180.0}):
        with pytest.raises(ValueError, match=r"env\.seen"):
            SeenConfig(**bad)
    with pytest.raises(ValueError, match=r"env\.observe"):
        EnvConfig(observe="guess")


def test_the_kernel_leaves_no_count_unwritten() -> None:
    env = seen_env(num_envs=2)
    env.reset()
    s, line = env.state, env.sightline
    line._count.fill_(99)
    line.look(s.q, s.obj_pos_w + 100.0, s.obj_quat, s.obj_half)
    assert wp.to_torch(line._count).tolist() == [0, 0]

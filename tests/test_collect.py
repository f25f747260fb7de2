"""Injected noise against the process that it is said to be, and what a recorded episode says was executed."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.env_world import make
from wbm.envs.collect import injected_noise, noise_level
from wbm.envs.config import EnvConfig
from wbm.envs.episodes import EpisodeRunner, Frame
from wbm.envs.perception import Sight
from wbm.envs.relabel import DemonstrationDriver, RelabelDriver
from wbm.envs.rollout_config import NoiseConfig
from wbm.envs.whole_body import CONTACT, FREE, WholeBodyEnv
from wbm.robot import joints
from wbm.robot.schema import PolicySchema, to_target

SCHEMA = PolicySchema()
FREE_NOISE = 3.0


def test_an_episodes_noise_depends_on_seed_and_number_alone():
    draw = injected_noise(NoiseConfig(levels=(1.0,)), 5)
    together = draw(np.array([3, 9]), 60)
    np.testing.assert_array_equal(draw(np.array([9]), 60)[0], together[1])
    assert (together[0] != together[1]).any()
    assert (injected_noise(NoiseConfig(levels=(1.0,)), 6)(np.array([3]), 60)[0] != together[0]).any()


def test_the_recorded_level_is_the_injected_one_and_level_0_is_silent():
    cfg = NoiseConfig(levels=(0.0, 1.0), spell=0.0)
    episodes = np.arange(40)
    noise = injected_noise(cfg, 2)(episodes, 4)
    levels = np.array([noise_level(cfg, 2, int(e)) for e in episodes])
    assert set(levels) == {0.0, 1.0}
    np.testing.assert_array_equal((noise != 0.0).all((1, 2)), levels == 1.0)
    np.testing.assert_array_equal((noise == 0.0).all((1, 2)), levels == 0.0)


def drive(cfg: NoiseConfig, episodes: int, steps: int) -> np.ndarray:
    """What entered the process in each step [K,T,32]: x' - correlation x, in float64."""
    x = injected_noise(cfg, 0)(np.arange(episodes), steps).astype(np.float64)
    return x - cfg.correlation * np.concatenate([np.zeros_like(x[:, :1]), x[:, :-1]], axis=1)


def test_noise_without_pauses_is_the_process_with_its_scales():
    cfg = NoiseConfig(levels=(1.5,), spell=0.0)
    entered = drive(cfg, 20, 200)
    assert (np.abs(entered[:, :, :3]).max(-1) > 1e-6).all()
    for scale, group in zip(cfg.scale, (joints.BASE, joints.ARM, joints.HAND, joints.NECK), strict=True):
        # 12,000 and more samples: the deviation's own is below 0.7 %
        assert entered[..., group].std() == pytest.approx(cfg.innovation * 1.5 * scale, rel=0.03)
        assert abs(entered[..., group].mean()) < 0.03 * cfg.innovation * 1.5 * scale


def test_in_a_pause_nothing_enters_any_joint_and_spells_have_their_length():
    cfg = NoiseConfig(levels=(1.0,), spell=8.0)
    entered = np.abs(drive(cfg, 60, 400))
    silent = entered.max(-1) < 1e-7
    np.testing.assert_array_equal(silent, entered.min(-1) < 1e-9 + 1e-7 * silent)
    assert 0.45 < silent.mean() < 0.55
    switches = (silent[:, 1:] != silent[:, :-1]).mean()
    assert 1.0 / switches == pytest.approx(cfg.spell, rel=0.1)
    assert 0.2 < silent[:, 0].mean() < 0.8, "an episode may begin with either"


@pytest.mark.parametrize(
    "change", [{"spell": 0.5}, {"spell": -1.0}, {"innovation": -0.1}, {"scale": (0.1, -0.1, 0.1, 0.1)}, {"levels": ()}]
)
def test_impossible_noise_is_refused(change):
    with pytest.raises(ValueError, match=r"rollouts.noise"):
        replace(NoiseConfig(), **change)


def short(n: int) -> WholeBodyEnv:
    """Episodes of 12 steps, half of which start at the pre-grasp."""
    cfg = EnvConfig(start="whole_body", pregrasp_share=0.5, episode_s=0.24, approach_s=0.24, success_hold_s=0.04)
    return make(n, cfg, kind=WholeBodyEnv)


def record(env: WholeBodyEnv, driver, noise=None, free_noise: float = 1.0) -> tuple[list[Frame], list[torch.Tensor]]:
    """Frames, and the targets [N,32] that the simulation was given in each of them."""
    zeros = np.zeros(env.binding.table.count, dtype=int)
    runner = EpisodeRunner(env, SCHEMA, zeros, zeros, noise=noise, free_noise=free_noise)
    given, frames, step = [], [], env.sim.step

    def watched(count: int) -> None:
        given.append(env.sim.ctrl[:, :32].double().clone())
        step(count)

    env.sim.step = watched  # type: ignore[method-assign]
    runner.run(driver, 0, env.num_envs, frames.append)
    return frames, given


def targets(frame: Frame, action: torch.Tensor) -> np.ndarray:
    """Joint targets [N,32] of recorded actions, float64."""
    return to_target(np, frame.q.double().numpy(), action.double().numpy(), SCHEMA.action)


def test_noise_is_larger_in_free_space_and_only_what_is_executed_has_it():
    env = short(8)
    size = np.full(32, 1e-3)

    def noise(episodes: np.ndarray, steps: int) -> np.ndarray:
        return np.broadcast_to((1.0 + episodes)[:, None, None] * size, (len(episodes), steps, 32)).astype("f4")

    frames, given = record(env, DemonstrationDriver(lambda obs: torch.zeros(8, env.num_actions)), noise, FREE_NOISE)
    seen = {FREE: 0, CONTACT: 0}
    for frame, ctrl in zip(frames, given, strict=True):
        inside = ((frame.executed.abs() < SCHEMA.action.limit) & (frame.action.abs() < SCHEMA.action.limit)).numpy()
        np.testing.assert_allclose(targets(frame, frame.executed)[inside], ctrl.numpy()[inside], atol=2e-6)
        added = targets(frame, frame.executed) - targets(frame, frame.action)
        factor = np.where(frame.phase.numpy() == FREE, FREE_NOISE, 1.0) * (1.0 + frame.episode.numpy())
        inside[:, :2] &= inside[:, :1] & inside[:, 1:2]  # the base's are turned together
        np.testing.assert_allclose(added[inside], (factor[:, None] * size)[inside], atol=2e-6)
        for phase in seen:
            seen[phase] += int(inside[frame.phase.numpy() == phase].sum())
    assert min(seen.values()) > 100


class Told(RelabelDriver):
    """Without perception: the student is asked with nothing to see."""

    needs_sight = False

    def step(self, env, sight):
        return super().step(env, Sight({}, torch.zeros(env.num_envs), torch.zeros(env.num_envs, 3)))


def test_where_a_student_acts_its_own_action_is_executed_and_the_experts_recorded():
    env = short(4)
    wish = torch.full((4, 32), 0.25)
    driver = Told(lambda obs: wish, lambda obs: torch.zeros(4, env.num_actions), env, SCHEMA)
    loud = lambda episodes, steps: np.ones((len(episodes), steps, 32), np.float32)
    frames, given = record(env, driver, loud)
    low, high = env.robot.q_min, env.robot.q_max
    differs = 0.0
    for frame, ctrl in zip(frames, given, strict=True):
        expected = np.clip(targets(frame, wish), low, high)
        np.testing.assert_allclose(ctrl.numpy(), expected, atol=2e-6)  # no noise on top
        np.testing.assert_allclose(targets(frame, frame.executed), expected, atol=2e-6)
        differs = max(differs, float((frame.action - frame.executed).abs().max()))
    assert differs > 0.1

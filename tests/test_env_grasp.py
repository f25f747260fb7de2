"""The environment: episodes belong to their number, state can be restored, ablations change what they say only that."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch

from tests.env_world import make
from wbm.envs.config import ActionConfig, EnvConfig, RandomizationConfig, Range
from wbm.envs.observations import LABELS
from wbm.envs.outcome import DROPPED, FORBIDDEN, OUT_OF_REACH, RUNNING, SUCCESS, TIMEOUT, UNSTABLE
from wbm.envs.scripted import ScriptedGrasp
from wbm.learning.teacher_evaluation import evaluate_teacher
from wbm.robot import joints

OFF = RandomizationConfig(
    **{f.name: Range(0, 0, on=False) for f in fields(RandomizationConfig) if f.name != "scene"}, scene=False
)


def test_observation_has_a_label_for_every_entry() -> None:
    env = make(3)
    obs = env.reset()
    assert obs.shape == (3, len(env.observe.labels)) and len(set(env.observe.labels)) == obs.shape[1]
    assert bool(torch.isfinite(obs).all())
    at = env.observe.labels.index
    ee, obj = env.state.ee_pos_w, env.state.obj_pos_w
    expected = 6.0 * ((obj - ee).unsqueeze(1) @ env.state.ee_mat).squeeze(1)
    torch.testing.assert_close(obs[:, at("obj_pos_e/x") : at("obj_pos_e/x") + 3], expected)
    up = obs[:, at("up_e/x") : at("up_e/x") + 3]
    assert bool((up[:, 2] < -0.9).all()), "a top-down hand points down"
    assert bool((obs[:, at("height")].abs() < 0.02).all())


def test_an_episode_does_not_depend_on_its_environment() -> None:
    one, two = make(2), make(3)
    first = one.reset(first_episode=4)
    second = two.reset(first_episode=3)
    torch.testing.assert_close(first[0], second[1], atol=2e-5, rtol=1e-4)
    assert not torch.allclose(first[0], first[1], atol=1e-2)
    assert not torch.allclose(make(2, seed=1).reset(4)[0], first[0], atol=1e-2)


def test_the_previous_action_is_observed_in_every_step() -> None:
    env = make(3)
    env.reset()
    start = len(env.observe.labels) - env.num_actions
    for _ in range(4):
        action = 0.9 * torch.rand(3, env.num_actions)
        obs, _, done, _ = env.step(action)
        assert torch.equal(obs[~done, start:], action[~done])


def test_restored_environment_continues_bit_for_bit() -> None:
    torch.manual_seed(0)
    cfg = replace(EnvConfig(), episode_s=1.2)  # episodes end on the way
    env, other = make(3, cfg), make(3, cfg)
    env.reset()
    actions = 0.5 * torch.randn(50, 3, env.num_actions)
    for action in actions[:25]:
        env.step(action)
    other.load_state_dict(env.state_dict())
    assert torch.equal(other.obs, env.obs)
    for action in actions[25:]:
        a, b = env.step(action), other.step(action)
        for left, right in zip(a[:3], b[:3], strict=True):
            assert torch.equal(left, right)
    assert env.next_episode == other.next_episode > 3


def test_joint_space_differs_by_the_action_term_only() -> None:
    full = make(2)
    joint = make(2, EnvConfig(action=ActionConfig(term="joint")))
    a, b = full.reset(), joint.reset()
    n = len(LABELS)
    assert joint.action.labels == joints.JOINT_NAMES
    assert full.observe.labels[:n] == joint.observe.labels[:n] == LABELS
    torch.testing.assert_close(a[:, :n], b[:, :n])
    before = joint.state.q.clone()
    action = torch.zeros(2, 32)
    action[:, 4] = 1.0
    joint.step(action)
    moved = joint.ctrl - before
    assert bool((moved[:, 4] > 0.04).all())
    assert float(moved[:, [0, 1, 2, 3, 5, 26, 31]].abs().max()) < 1e-5


def test_a_fixed_neck_stays_and_nothing_else_is_fixed() -> None:
    gaze, fixed = make(2), make(2, EnvConfig(action=ActionConfig(neck="fixed")))
    for env in (gaze, fixed):
        env.reset()
        start = env.state.q[:, joints.NECK].clone()
        action = torch.zeros(2, env.num_actions)
        action[:, 2] = -1.0
        for _ in range(15):
            env.step(action)
        env.moved = (env.ctrl[:, joints.NECK] - start).abs().max()
        assert float((env.ctrl[:, joints.ARM] - env.posture[:, 3:10]).abs().max()) > 0.01
    assert float(fixed.moved) < 1e-6 < 1e-3 < float(gaze.moved)


def test_every_randomised_item_changes_what_it_should() -> None:
    watched = {
        "friction": ("geom_friction",),
        "mass": ("body_mass", "body_inertia"),
        "arm_gain": ("actuator_gainprm", "actuator_biasprm"),
        "hand_gain": ("actuator_gainprm", "actuator_biasprm"),
        "contact_time": ("geom_solref",),
    }
    names = sorted({n for group in watched.values() for n in group})

    def values(randomization: RandomizationConfig) -> dict[str, torch.Tensor]:
        env = make(2, EnvConfig(randomization=randomization))
        env.reset()
        return {n: env.sim.field(n).clone() for n in names} | {"q": env.state.q.clone()}

    base = values(OFF)
    for item, touched in watched.items():
        default = getattr(RandomizationConfig(), item)
        changed = values(replace(OFF, **{item: default}))
        for n in names:
            assert torch.equal(changed[n], base[n]) == (n not in touched), (item, n)
        assert torch.equal(changed["q"], base["q"])
    arm = values(replace(OFF, arm_gain=Range(2.0, 2.0)))["actuator_gainprm"] / base["actuator_gainprm"]
    assert bool((arm[:, joints.ARM, 0] == 2).all() and (arm[:, joints.HAND, 0] == 1).all())
    light, heavy = (values(replace(OFF, mass=Range(f, f)))["body_mass"] for f in (1.0, 3.0))
    changed = (heavy != light).nonzero()[:, 1]
    assert len(changed) and torch.allclose(heavy[:, changed], 3 * light[:, changed])
    hand = values(replace(OFF, start_hand=Range(-0.08, 0.08)))["q"] - base["q"]
    assert float(hand[:, joints.HAND].abs().max()) > 0.01 and float(hand[:, joints.ARM].abs().max()) == 0


def test_outcomes_of_made_up_states() -> None:
    env = make(1)
    env.reset()
    judge, start = env.outcome, env.reader.start_pos
    late, early = torch.tensor([True]), torch.tensor([False])

    def run(steps: int, end: torch.Tensor, **values) -> int:
        s = replace(env.state, **{k: torch.as_tensor(v) for k, v in values.items()})
        for _ in range(steps):
            judge.update(s, start, early)
        return int(judge.update(s, start, end))

    up = dict(height=[0.15], held=[1.0], holding=[1.0], lifted=[1.0], forbidden=[0.0])
    down = dict(height=[0.0], held=[0.0], holding=[0.0], lifted=[0.0], forbidden=[0.0])
    for expected, plays in {
        RUNNING: [(5, early, down)],
        TIMEOUT: [(5, late, down)],
        SUCCESS: [(30, late, up)],
        DROPPED: [(30, early, up), (0, early, down)],
        FORBIDDEN: [(0, early, down | {"forbidden": [1.0]})],
        OUT_OF_REACH: [(0, early, down | {"height": [-0.3]})],
        UNSTABLE: [(0, early, down | {"obj_lin_vel_w": [[100.0, 0, 0]]})],
    }.items():
        judge.reset(torch.tensor([0]))
        codes = [run(steps, end, **values) for steps, end, values in plays]
        assert codes[-1] == expected
    judge.reset(torch.tensor([0]))
    assert run(10, late, **up) == TIMEOUT, "held for less than a second"
    judge.reset(torch.tensor([0]))
    run(40, early, **up)
    assert run(0, late, **(up | {"holding": [0.0]})) == TIMEOUT, "no longer held at the end"


def test_scripted_grasp_lifts_some_objects() -> None:
    env = make(6)
    env.reset()
    policy = ScriptedGrasp(env.observe.labels, env.observe.scale, env.cfg.action, depth=0.055)
    result = evaluate_teacher(env, lambda obs: policy(obs, env.elapsed / env.max_steps), 12)
    assert result["success"] >= 0.15
    shares = [v for k, v in result.items() if k not in ("reward", "grip_force")]
    assert sum(shares) == pytest.approx(1.0)


def test_settings_are_checked() -> None:
    for bad in (
        {"start": "far"},
        {"episode_s": 0.5},
        {"starts_per_scene": 0},
        {"pregrasp_share": 2.0},
        {"finish_s": 0.2},
    ):
        with pytest.raises(ValueError, match=r"^env\."):
            EnvConfig(**bad)
    with pytest.raises(ValueError, match=r"env\.action\.term"):
        ActionConfig(term="torque")
    with pytest.raises(ValueError, match="swap"):
        Range(1.0, 0.0)

"""The student network. Oracles: NumPy float64, ONNX Runtime, and laws (order of points, frames, masks).

float32 network outputs are compared at 2e-5: sums over points in another order.
"""

import json

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from student_world import SCHEMA, make_episode

from wbm.learning.export import check_parity, export_onnx, random_observation
from wbm.learning.student import Student, StudentPolicy, count_parameters, load_student, save_student
from wbm.learning.student_config import AugmentConfig, DistillConfig, StudentConfig
from wbm.learning.tokens import local_shape, masked_max, masked_softmax, rotation_from_6d
from wbm.robot.schema import PROPRIO_LABELS, PolicySchema

TOLERANCE = 2e-5


def make_policy(schema=SCHEMA, **sizes):
    torch.manual_seed(0)
    network = Student(schema, StudentConfig(**sizes))
    with torch.no_grad():
        network.p_obj.weight.normal_(0.0, 0.1)  # starts at zero; would hide what it depends on
    return StudentPolicy(network)


def make_obs(num=4):
    episode = make_episode(3, num)
    obs = {f.name: np.asarray(episode[f.name]).astype(f.dtype) for f in SCHEMA.observation if f.name != "text"}
    return obs | {"text": np.repeat(episode["text"][:1], num, 0)}


def outputs(policy, obs):
    return {k: v.numpy() for k, v in policy.predict(obs).items()}


def test_default_has_the_size_of_the_recipe():
    assert 300_000 < count_parameters(Student(PolicySchema(), StudentConfig())) < 400_000


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_rotation_is_the_inverse_of_the_schemas(seed):
    q, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((5, 3, 3)))
    rot = q * np.sign(np.linalg.det(q))[:, None, None]
    columns = np.concatenate([rot[..., :, 0], rot[..., :, 1]], axis=-1)
    np.testing.assert_allclose(rotation_from_6d(torch.from_numpy(columns)).numpy(), rot, atol=1e-12)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.03, 0.1]))
def test_local_shape_against_numpy(seed, radius):
    rng = np.random.default_rng(seed)
    xyz, rgb = 0.2 * rng.random((1, 20, 3)), rng.random((1, 20, 3))
    valid = (rng.random((1, 20, 1)) > 0.3).astype(float)
    got = local_shape(*(torch.from_numpy(a) for a in (xyz, rgb, valid)), radius).numpy()[0]
    for i in range(20):
        if not valid[0, i, 0]:
            assert not got[i].any()
            continue
        weight = np.maximum(0.0, 1.0 - np.sum((xyz[0] - xyz[0, i]) ** 2, -1) / radius**2) * valid[0, :, 0]
        mean = weight @ xyz[0] / weight.sum()
        centred = (xyz[0] - mean) / radius
        cov = (weight[:, None, None] * centred[:, :, None] * centred[:, None, :]).sum(0) / weight.sum()
        want = [0.1 * weight.sum(), *(mean - xyz[0, i]) / radius]
        want += [cov[0, 0], cov[1, 1], cov[2, 2], cov[0, 1], cov[0, 2], cov[1, 2], *(weight @ rgb[0] / weight.sum())]
        np.testing.assert_allclose(got[i], want, atol=1e-9)
    # two metres from the origin, in float32
    far = local_shape(*(torch.from_numpy(a.astype("f4")) for a in (xyz + 2.0, rgb, valid)), radius).numpy()[0]
    np.testing.assert_allclose(far, got, atol=1e-3)


def test_pooling_of_nothing_is_zero():
    features, none = torch.rand(2, 5, 3), torch.zeros(2, 5, 1)
    assert not masked_max(features, none).any()
    assert not masked_softmax(torch.randn(2, 5, 4), none).any()
    some = torch.tensor([1.0, 0, 1, 0, 0]).view(1, 5, 1).expand(2, 5, 1)
    weights = masked_softmax(torch.randn(2, 5, 4), some)
    torch.testing.assert_close(weights.sum(1), torch.ones(2, 4))
    assert not weights[:, [1, 3, 4]].any()


def test_order_of_points_does_not_matter():
    policy, obs = make_policy(), make_obs()
    rng = np.random.default_rng(0)
    d, m = rng.permutation(SCHEMA.num_depth_points), rng.permutation(SCHEMA.num_lidar_points)
    moved = (
        obs
        | {k: obs[k][:, d] for k in obs if k.startswith("depth")}
        | {k: obs[k][:, m] for k in obs if k[:5] == "lidar"}
    )
    a, b = outputs(policy, obs), outputs(policy, moved)
    for name in ("action", "p_obj_b"):
        np.testing.assert_allclose(b[name], a[name], atol=TOLERANCE)
    np.testing.assert_allclose(b["target_logit"], a["target_logit"][:, d], atol=TOLERANCE)


def test_what_lies_in_points_that_are_not_valid_does_not_matter():
    policy, obs = make_policy(), make_obs()
    rng = np.random.default_rng(1)
    other = {k: v.copy() for k, v in obs.items()}
    for cloud in ("depth", "lidar"):
        gone = other[f"{cloud}_valid"] == 0
        gone[:, :5] = True
        for o in (obs, other):
            o[f"{cloud}_valid"] = (~gone).astype(np.uint8)
        other[f"{cloud}_xyz"][gone] = rng.standard_normal((gone.sum(), 3))
    other["depth_rgb"][other["depth_valid"] == 0] = 77
    other["depth_target"][other["depth_valid"] == 0] = 1
    a, b = outputs(policy, obs), outputs(policy, other)
    np.testing.assert_allclose(b["action"], a["action"], atol=TOLERANCE)
    np.testing.assert_allclose(b["p_obj_b"], a["p_obj_b"], atol=TOLERANCE)


def test_every_input_matters_and_every_switch_switches_it_off():
    rng = np.random.default_rng(2)
    changes = {
        "text": lambda v: rng.permutation(v.ravel()).reshape(v.shape),
        "depth_target": lambda v: np.roll(v, 20, axis=1),
        "prev_action": lambda v: v + 1.0,
        "lidar_xyz": lambda v: v + 0.5,
        "proprio": lambda v: v + 0.1,
        "depth_rgb": lambda v: 255 - v,
        "depth_xyz": lambda v: v + 0.05 * rng.standard_normal(v.shape).astype("f4"),
    }
    changes["qd"] = lambda v: v + np.array([label.startswith("qd/") for label in PROPRIO_LABELS])
    off = {"text": {"use_text": False}, "depth_target": {"use_mask": False}}
    off |= {"prev_action": {"use_prev_action": False}, "lidar_xyz": {"lidar_tokens": 0}, "qd": {"use_velocity": False}}
    fields = {"qd": "proprio"}
    for name, change in changes.items():
        obs, field = make_obs(), fields.get(name, name)
        changed = obs | {field: change(obs[field]).astype(obs[field].dtype)}
        policy = make_policy(use_prev_action=True, use_velocity=True)
        assert np.abs(outputs(policy, changed)["action"] - outputs(policy, obs)["action"]).max() > 1e-4, name
        if name in off:
            policy = make_policy(**off[name])
            np.testing.assert_array_equal(outputs(policy, changed)["action"], outputs(policy, obs)["action"], name)


def test_by_default_the_student_sees_neither_velocities_nor_its_last_action():
    rng, obs, policy = np.random.default_rng(3), make_obs(), make_policy()
    velocity = np.array([label.startswith("qd/") for label in PROPRIO_LABELS])
    assert velocity.sum() == 32
    proprio = obs["proprio"] + 9.0 * velocity * rng.standard_normal(obs["proprio"].shape)
    changed = obs | {"proprio": proprio.astype("f4"), "prev_action": obs["prev_action"] + np.float32(1.0)}
    np.testing.assert_array_equal(outputs(policy, changed)["action"], outputs(policy, obs)["action"])
    changed["proprio"] = (obs["proprio"] + 0.01 * ~velocity).astype("f4")
    assert np.abs(outputs(policy, changed)["action"] - outputs(policy, obs)["action"]).max() > 1e-5


def test_an_environment_does_not_see_its_neighbours_and_empty_clouds_are_harmless():
    policy = make_policy(chunk=3)
    obs = random_observation(SCHEMA, 5, seed=0)  # the last has no points, no mask and no instruction
    together = outputs(policy, obs)
    assert all(np.isfinite(v).all() for v in together.values())
    for i in range(5):
        alone = outputs(policy, {k: v[i : i + 1] for k, v in obs.items()})
        for name, value in alone.items():
            np.testing.assert_allclose(value[0], together[name][i], atol=TOLERANCE)
    assert together["action"].shape == (5, 3, 32)
    np.testing.assert_array_equal(policy.act(obs).numpy(), together["action"][:, 0])


def test_actions_are_clipped_to_the_schemas_limit():
    policy = make_policy()
    with torch.no_grad():
        policy.network.heads[1][2].bias.fill_(50.0)
    action = policy.act(make_obs()).numpy()
    assert (action[:, 3:10] == SCHEMA.action.limit).all()
    assert (np.abs(action) <= SCHEMA.action.limit).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda o: o.pop("proprio"), "'proprio' is missing"),
        (lambda o: o.update(extra=o["text"]), "'extra' is not in the schema"),
        (lambda o: o.update(depth_xyz=o["depth_xyz"][:, 1:]), r"'depth_xyz' has shape \(63, 3\), expected \(64, 3\)"),
        (lambda o: o.update(text=o["text"][0]), r"'text' has shape \(\)"),
    ],
)
def test_a_wrong_observation_is_refused_by_name(change, message):
    obs = make_obs()
    change(obs)
    with pytest.raises(ValueError, match=message):
        make_policy().act(obs)


def test_saved_and_loaded_it_acts_the_same(tmp_path):
    policy, obs = make_policy(chunk=2, width=32, heads=2), make_obs()
    save_student(tmp_path, policy.network, {"iterations": 7})
    loaded = load_student(tmp_path)
    np.testing.assert_array_equal(loaded.act_chunk(obs).numpy(), policy.act_chunk(obs).numpy())
    assert loaded.schema == SCHEMA and loaded.network.cfg == policy.network.cfg
    first = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    save_student(tmp_path / "again", policy.network, {"iterations": 7})
    assert first == {p.name: p.read_bytes() for p in (tmp_path / "again").iterdir()}


def test_another_version_or_other_sizes_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="holds no student"):
        load_student(tmp_path)
    save_student(tmp_path, make_policy().network)
    spec = json.loads((tmp_path / "student.json").read_text())
    for change, message in (
        ({"version": 9}, "has version 9"),
        ({"schema": spec["schema"] | {"version": 9}}, "schema version 9"),
        ({"config": spec["config"] | {"width": 48}}, "does not fit"),
        ({"config": spec["config"] | {"depth": 48}}, "does not fit"),
    ):
        (tmp_path / "student.json").write_text(json.dumps(spec | change))
        with pytest.raises(ValueError, match=message):
            load_student(tmp_path)
    (tmp_path / "student.json").write_text(json.dumps(spec))
    file = tmp_path / "student.safetensors"
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(ValueError, match="does not fit"):
        load_student(tmp_path)


@pytest.mark.parametrize("knows", [False, True])
def test_onnx_computes_the_same(knows):
    policy = make_policy(chunk=2, width=32, heads=2, point_width=16, use_velocity=knows, use_prev_action=knows)
    model = export_onnx(policy)
    assert check_parity(policy, model, num=7, seed=5) < 1e-5
    changed = make_policy(chunk=2, width=32, heads=2, point_width=16, use_velocity=knows, use_prev_action=knows)
    with torch.no_grad():
        changed.network.heads[3][2].bias.add_(0.01)
    assert check_parity(changed, model) > 5e-3, "the check must see a difference"


@pytest.mark.slow
def test_exported_twice_it_gives_the_same_bytes():
    policy = make_policy(width=32, heads=2, point_width=16)
    assert export_onnx(policy) == export_onnx(policy)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: StudentConfig(width=97), "student.width 97 must be a multiple"),
        (lambda: StudentConfig(chunk=0), r"student.chunk must lie in \[1, 8192\]"),
        (lambda: StudentConfig(use_text=False, use_mask=False), "both off"),
        (lambda: DistillConfig(lr=0.0), "distill.lr must be positive"),
        (lambda: DistillConfig(dagger_lr=0.0), "distill.dagger_lr must be positive"),
        (lambda: DistillConfig(val_share=1.0), "val_share"),
        (lambda: AugmentConfig(mask_drop=1.5), r"distill.augment.mask_drop must lie in \[0, 1\]"),
    ],
)
def test_impossible_settings_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()

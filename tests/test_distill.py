"""Distillation: the loss against NumPy float64, exact repetition, and a task that the student must really learn."""

import json
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from student_world import SCHEMA, make_episode, write_shards

from stages import distill as stage
from wbm.artifacts.episodes import EpisodeWriter
from wbm.control.config import WbcConfig
from wbm.envs.config import EnvConfig
from wbm.envs.rollout_config import NoiseConfig, RolloutsConfig
from wbm.envs.world import WorldConfig
from wbm.learning import dagger, workers
from wbm.learning.dataset import EpisodeDataset, to_tensors
from wbm.learning.distill import CHECKPOINT, distill, learning_rate, validate
from wbm.learning.distill_loss import distill_loss
from wbm.learning.rollouts import ShardJob
from wbm.learning.student import Student, StudentPolicy, load_student
from wbm.learning.student_config import AugmentConfig, DistillConfig, StudentConfig
from wbm.robot.config import MjcfOptions
from wbm.sensors.config import SensorsConfig
from wbm.sim.config import SimConfig

SMALL = StudentConfig(width=32, heads=2, layers=1, feedforward=64, point_width=32, attention_tokens=2, proprio_tokens=2)
SHORT = DistillConfig(
    iterations=12, batch_size=16, warmup=3, val_every=5, val_share=0.2, val_batches=1, checkpoint_every=4, threads=1
)


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    return write_shards(tmp_path_factory.mktemp("episodes"), episodes=260, shards=2, length=12)


def weights(result):
    return {k: v.numpy().copy() for k, v in result.network.state_dict().items()}


def assert_same(a, b):
    assert a.curve == b.curve
    wa, wb = weights(a), weights(b)
    assert wa.keys() == wb.keys()
    for name in wa:
        np.testing.assert_array_equal(wa[name], wb[name], err_msg=name)


def test_loss_against_numpy():
    rng = np.random.default_rng(0)
    size, chunk, points = 6, 2, 10
    cfg = DistillConfig(beta=0.4, neck_weight=0.3, contact_gain=2.0, p_obj_weight=50.0, p_obj_cap=2.0, mask_weight=0.7)
    out = {
        "action": 2 * rng.standard_normal((size, chunk, 32)),
        "target_logit": 2 * rng.standard_normal((size, points)),
    }
    batch = {"action": rng.standard_normal((size, chunk, 32)), "action_valid": np.ones((size, chunk))}
    batch["action_valid"][4:, 1] = 0.0
    batch["ee_distance"] = np.array([0.0, 0.1, 0.14, 0.16, 0.3, 1.0])
    batch["p_obj_b"] = rng.standard_normal((size, 3))
    out["p_obj_b"] = batch["p_obj_b"] + np.outer([0.0, 0.01, 0.05, 0.1, 0.3, 1.0], [0.6, 0.0, -0.8])
    batch["depth_valid"] = rng.integers(0, 2, (size, points))
    batch["target_label"] = rng.integers(0, 2, (size, points)) & batch["depth_valid"]

    want = 0.0
    near = 1.0 + 2.0 / (1.0 + np.exp(-(0.15 - batch["ee_distance"]) / 0.02))
    spans = {
        "base": (0, 3, np.ones(6)),
        "arm": (3, 10, near),
        "hand": (10, 26, near),
        "neck": (26, 32, np.full(6, 0.3)),
    }
    for first, last, weight in spans.values():
        e = np.abs(out["action"] - batch["action"])[..., first:last]
        huber = np.where(e < 0.4, 0.5 * e * e / 0.4, e - 0.2).mean(-1) * batch["action_valid"]
        want += (weight[:, None] * huber).sum() / 10.0
    want += np.mean([0.0, 50 * 0.01**2, 50 * 0.05**2, 50 * 0.1**2, 2.0 + 0.3 - 0.2, 2.0 + 1.0 - 0.2])
    p = 1.0 / (1.0 + np.exp(-out["target_logit"]))
    bce = -np.where(batch["target_label"] == 1, np.log(p), np.log(1.0 - p))
    want += 0.7 * (bce * batch["depth_valid"]).sum() / batch["depth_valid"].sum()

    got, figures = distill_loss(to_tensors(out, "cpu"), to_tensors(batch, "cpu"), cfg)
    assert float(got) == pytest.approx(want, rel=1e-6)
    assert float(figures["p_obj_m"]) == pytest.approx(0.05, abs=1e-6)


def test_learning_rate_schedule():
    cfg = DistillConfig(
        iterations=100, warmup=10, lr=1.0, lr_final=0.1, dagger_rounds=2, dagger_iterations=50, dagger_lr=0.5
    )
    rates = [learning_rate(i, cfg) for i in range(200)]
    assert rates[0] == pytest.approx(0.1) and rates[9] == pytest.approx(1.0) and rates[10] == pytest.approx(1.0)
    assert rates[55] == pytest.approx(0.55) and rates[99] == pytest.approx(0.1, abs=0.01)
    assert rates[100] == rates[150] == pytest.approx(0.5)
    assert all(a >= b for a, b in pairwise(rates[10:100]))


def test_the_same_bits_whatever_happens(shards, tmp_path):
    plain = distill(shards, SCHEMA, SMALL, SHORT, tmp_path / "a")
    assert [p["step"] for p in plain.curve] == [5.0, 10.0, 12.0]
    loaded = distill(shards, SCHEMA, SMALL, replace(SHORT, workers=2), tmp_path / "b")
    assert_same(plain, loaded)

    # Asked to stop after step 7: it goes on from there
    def stop(step, total, figures):
        if step == 7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        distill(shards, SCHEMA, SMALL, SHORT, tmp_path / "c", report=stop)
    assert torch.load(tmp_path / "c" / CHECKPOINT, weights_only=True)["step"] == 7
    steps = []
    resumed = distill(shards, SCHEMA, SMALL, SHORT, tmp_path / "c", report=lambda s, t, f: steps.append(s))
    assert steps == [8, 9, 10, 11, 12]
    assert_same(plain, resumed)

    # Killed after step 7 without being asked: it goes on from the checkpoint of step 4
    saved = {}

    def kill(step, total, figures):
        if step == 5:
            saved["bytes"] = (tmp_path / "d" / CHECKPOINT).read_bytes()

    distill(shards, SCHEMA, SMALL, SHORT, tmp_path / "d", report=kill)
    (tmp_path / "d" / CHECKPOINT).write_bytes(saved["bytes"])
    steps.clear()
    assert_same(plain, distill(shards, SCHEMA, SMALL, SHORT, tmp_path / "d", report=lambda s, t, f: steps.append(s)))
    assert steps[0] == 5

    # and other seeds give other weights
    other = distill(shards, SCHEMA, SMALL, replace(SHORT, seed=1), tmp_path / "e")
    assert any((weights(other)[k] != v).any() for k, v in weights(plain).items())


def test_a_checkpoint_of_another_configuration_is_refused(shards, tmp_path):
    distill(shards, SCHEMA, SMALL, SHORT, tmp_path)
    with pytest.raises(ValueError, match="another student or distill configuration"):
        distill(shards, SCHEMA, SMALL, replace(SHORT, lr=2e-3), tmp_path)


def test_dagger_rounds_add_episodes_and_resume_exactly(shards, tmp_path):
    cfg = replace(SHORT, dagger_rounds=2, dagger_iterations=3)
    with pytest.raises(ValueError, match="dagger_rounds needs"):
        distill(shards, SCHEMA, SMALL, cfg, tmp_path / "a")
    calls = []

    def collector(name):
        def collect(policy, round_number):
            folder = tmp_path / name / str(round_number)
            done = sorted(folder.glob("*.json"))
            calls.append((name, round_number, bool(done)))
            if done:
                return done
            # on-policy: the episodes depend on the student as it is at that moment
            obs = {f.name: np.zeros((1, *f.shape), f.dtype) for f in SCHEMA.observation}
            seed = int(np.abs(policy.act(obs).numpy()).sum() * 1e6) % 1000
            return write_shards(folder, 4, 1) if seed % 2 else write_shards(folder, 5, 1)

        return collect

    plain = distill(shards, SCHEMA, SMALL, cfg, tmp_path / "a", collect=collector("x"))
    assert calls == [("x", 1, False), ("x", 2, False)]
    assert plain.num_episodes > 0.8 * 260 + 6

    def stop(step, total, figures):
        if step == 17:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        distill(shards, SCHEMA, SMALL, cfg, tmp_path / "b", report=stop, collect=collector("y"))
    assert_same(plain, distill(shards, SCHEMA, SMALL, cfg, tmp_path / "b", collect=collector("y")))
    assert calls[-2:] == [("y", 1, True), ("y", 2, True)]


def test_it_learns_to_go_for_what_is_masked_or_named(shards, tmp_path):
    """Three coloured blobs; the action points at the one that the mask marks, the instruction names, or both do."""
    cfg = DistillConfig(
        iterations=300,
        batch_size=48,
        warmup=30,
        lr=3e-3,
        ema=0.97,
        val_every=350,
        checkpoint_every=350,
        val_share=0.0,
        threads=1,
        augment=AugmentConfig(point_dropout=0.1, mask_drop=0.45, text_drop=0.25),
    )
    result = distill(shards, SCHEMA, SMALL, cfg, tmp_path / "scratch")
    policy = StudentPolicy(result.network)
    fresh = write_shards(tmp_path / "fresh", episodes=40, shards=1, length=4, first_seed=10_000)
    batch = EpisodeDataset(fresh, SCHEMA, batch_size=128)[0, 0]
    obs = {f.name: batch[f.name] for f in SCHEMA.observation}
    nothing = {"text": np.zeros_like(obs["text"]), "depth_target": np.zeros_like(obs["depth_target"])}
    goal = batch["p_obj_b"]
    correct = {}
    for view, given in (("both", ()), ("mask", ("text",)), ("text", ("depth_target",)), ("neither", tuple(nothing))):
        out = policy.predict(obs | {k: nothing[k] for k in given})
        # blobs are 0.15 m or more apart: nearer than 7 cm is the right one
        correct[view] = float((np.linalg.norm(out["p_obj_b"].numpy() - goal, axis=-1) < 0.07).mean())
        if view != "neither":
            error = np.abs(out["action"].numpy()[:, 0, :6] - batch["action"][:, 0, :6]).mean()
            spread = np.abs(batch["action"][:, 0, :6] - batch["action"][:, 0, :6].mean(0)).mean()
            assert error < 0.35 * spread, view
    assert correct["both"] > 0.9 and correct["mask"] > 0.9 and correct["text"] > 0.9, correct
    assert correct["neither"] < 0.5, "nothing tells the target: right once in three times at most, and by luck"

    figures = validate(result.network, EpisodeDataset(fresh, SCHEMA, batch_size=64), replace(cfg, val_batches=2))
    assert figures["val_text_p_obj_m"] < 0.05
    assert figures["val_both_loss"] < 0.5


def test_stage_publishes_a_student_that_acts(shards, tmp_path):
    messages = []

    class Task:
        def __enter__(self):
            return self

        def __exit__(self, *_):
            return None

        def update(self, n, **figures):
            messages.append((n, figures))

    draft = SimpleNamespace(path=tmp_path / "out", scratch=tmp_path / "scratch", metrics={}, seeds={})
    draft.path.mkdir()
    (tmp_path / "shards").symlink_to(shards[0].parent)
    cfg = SimpleNamespace(seed=3, student=SMALL, distill=SHORT)
    inputs = {"rollouts": SimpleNamespace(path=tmp_path)}
    progress = SimpleNamespace(task=lambda name, total: Task())
    assert stage.name(cfg) == "main"
    stage.run(cfg, inputs, draft, progress)
    assert sum(n for n, _ in messages) == 12
    assert sorted(p.name for p in draft.path.iterdir()) == ["curve.json", "student.json", "student.safetensors"]
    assert json.loads((draft.path / "curve.json").read_text())[-1]["step"] == 12.0
    assert draft.seeds == {"distill": 3} and draft.metrics["episodes"] == 208
    expected = distill(shards, SCHEMA, SMALL, replace(SHORT, seed=3), tmp_path / "other")
    policy = load_student(draft.path)
    episode = make_episode(5, 2)
    obs = {f.name: np.asarray(episode[f.name]) for f in SCHEMA.observation}
    obs = {k: v.astype(SCHEMA.field_named(k).dtype) for k, v in obs.items()}
    np.testing.assert_array_equal(policy.act(obs).numpy(), StudentPolicy(expected.network).act(obs).numpy())


def test_a_round_of_dagger_is_taken_up_where_it_was_interrupted(tmp_path, monkeypatch):
    made, stop_after = [], [1]

    def make(module, jobs, workers):
        assert module == "wbm.learning.dagger"
        for job in jobs:
            made.append(job)
            writer = EpisodeWriter(job.shard.folder, SCHEMA, job.shard.shard)
            writer.add(make_episode(job.shard.shard, 3))
            writer.close()
            if job.shard.shard in stop_after:
                raise KeyboardInterrupt  # the shard is whole, but nobody could note it
            yield job.shard.shard

    monkeypatch.setattr(workers, "run_jobs", make)
    cfg = SimpleNamespace(
        seed=3,
        robot=MjcfOptions(),
        sim=SimConfig(),
        wbc=WbcConfig(),
        env=EnvConfig(),
        sensors=SensorsConfig(),
        rollouts=RolloutsConfig(),
        distill=replace(SHORT, dagger_rounds=2, dagger_episodes=200),
    )
    inputs = {"assets": SimpleNamespace(path=tmp_path / "a"), "teacher/side": SimpleNamespace(path=tmp_path / "t")}
    policy = StudentPolicy(Student(SCHEMA, SMALL))
    with pytest.raises(KeyboardInterrupt):
        stage._collect(cfg, inputs, tmp_path / "round-2", policy, 2)
    assert [job.shard.shard for job in made] == [0, 1]
    stop_after.clear()
    paths = stage._collect(cfg, inputs, tmp_path / "round-2", policy, 2)
    assert [job.shard.shard for job in made] == [0, 1, 1, 2], "what is noted is not made again, what is not is"
    assert len(paths) == 3 and stage._collect(cfg, inputs, tmp_path / "round-2", policy, 2) == paths
    assert len(made) == 4
    job = made[-1]
    assert job.number == 2 and job.shard.teachers == {"side": tmp_path / "t"} and job.shard.assets == tmp_path / "a"
    assert 3 * job.shard.rollouts.episodes >= 200 > 3 * (job.shard.rollouts.episodes - 1)
    acts = load_student(job.student).network.state_dict()
    assert all(torch.equal(v, acts[k]) for k, v in policy.network.state_dict().items())


def test_rounds_of_dagger_differ_in_their_episodes_and_inject_no_noise(tmp_path, monkeypatch):
    class Asked(Exception):
        pass

    def world(job):
        raise Asked(job)

    monkeypatch.setattr(dagger, "RolloutWorld", world)
    monkeypatch.setattr(dagger, "_world", None)
    settings = WorldConfig(MjcfOptions(), SimConfig(), WbcConfig(), EnvConfig())
    rollouts = RolloutsConfig(pregrasp_share=0.3, scatter_share=0.5)
    shard = ShardJob(0, tmp_path, tmp_path, {}, settings, SensorsConfig(), rollouts, seed=7)
    seeds = {shard.seed}
    for number in (1, 2):
        with pytest.raises(Asked) as asked:
            dagger.work(dagger.RoundJob(shard, tmp_path, number))
        where = asked.value.args[0]
        assert where.rollouts == replace(rollouts, pregrasp_share=0.0, noise=NoiseConfig(levels=(0.0,)))
        seeds.add(where.seed)
    assert len(seeds) == 3

"""Episode store and dataset. Oracles: what was written, the Zarr library, NumPy. Clouds: float16's rounding."""

import json
import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from student_world import SCHEMA, embed, make_episode, write_shards

from wbm.artifacts.episode_layout import SHARD_STEPS, StepField, StepLayout
from wbm.artifacts.episode_reader import EpisodeReader, shard_paths
from wbm.artifacts.episodes import EpisodeWriter
from wbm.learning.augment import augment, rng_of
from wbm.learning.dataset import EpisodeDataset
from wbm.learning.student_config import AugmentConfig

HALF = 2.0**-11  # relative rounding of float16
ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    return write_shards(tmp_path_factory.mktemp("episodes"), episodes=30, shards=3, length=21)


def same(a, b):
    return a.keys() == b.keys() and all(np.array_equal(a[k], b[k]) for k in a)


def test_a_whole_episode_comes_back(shards):
    reader = EpisodeReader(shards[1], SCHEMA)
    assert [e.seed for e in reader.episodes] == list(range(1, 30, 3))
    for number in (0, 7):
        want, got = make_episode(reader.episodes[number].seed, 21), reader.read_episode(number)
        assert got.keys() == want.keys()
        for name, value in want.items():
            if name.endswith("_xyz"):
                np.testing.assert_allclose(got[name], value, rtol=HALF, atol=1e-7)
            elif isinstance(value, np.ndarray):
                expected = value.astype(got[name].dtype)
                np.testing.assert_array_equal(got[name], expected, err_msg=name)
            else:
                assert got[name] == value


def test_rows_agree_with_the_zarr_library(shards):
    reader = EpisodeReader(shards[0], SCHEMA)
    array = zarr.open_group(str(shards[0].with_suffix(".zarr")), mode="r")["steps"]
    everything = np.asarray(array[:])
    assert everything.shape == (reader.num_steps, reader.layout.row_bytes)
    for start, stop in ((0, 1), (5, 19), (7, 9), (reader.num_steps - 1, reader.num_steps), (0, reader.num_steps)):
        np.testing.assert_array_equal(reader.rows(start, stop), everything[start:stop])
    assert StepLayout.from_list(array.attrs["fields"]).fields == reader.layout.fields


def test_an_episode_may_cross_shard_files(tmp_path):
    small = SCHEMA.with_points(8, 4)
    writer = EpisodeWriter(tmp_path, small, 0)
    lengths = [1500, 1501, 1502, 700]
    for seed, length in enumerate(lengths):
        writer.add(make_episode(seed, length, small))
    reader = EpisodeReader(writer.close(), small)
    assert reader.num_steps == sum(lengths) > SHARD_STEPS
    np.testing.assert_array_equal(reader.read_episode(2)["action"], make_episode(2, 1502, small)["action"].astype("f4"))


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 9), st.lists(st.integers(1, 19), min_size=1, max_size=3), st.integers(0, 2**32 - 1))
def test_packing_is_reversible(length, sizes, seed):
    rng = np.random.default_rng(seed)
    fields, steps = [], {}
    for i, size in enumerate(sizes):
        for stored, dtype in (("bits", "uint8"), ("uint8", "uint8"), ("float32", "float32")):
            name = f"{stored}{i}"
            fields.append(StepField(name, (size,), dtype, stored))
            values = rng.integers(0, 2 if stored == "bits" else 256, (length, size))
            steps[name] = (values * 0.37 if dtype == "float32" else values).astype(dtype)
    layout = StepLayout(tuple(fields))
    assert same(layout.unpack(layout.pack(steps)), steps)


def test_a_sample_costs_at_most_3_5_kilobytes(tmp_path):
    from wbm.learning.bench import _write_synthetic
    from wbm.robot.schema import PolicySchema

    path = _write_synthetic(tmp_path, PolicySchema(), 0, 4)
    size = sum(p.stat().st_size for p in path.with_suffix(".zarr").rglob("*") if p.is_file())
    reader = EpisodeReader(path)
    index = 16 * SHARD_STEPS // 8  # a shard file's index is as large for few steps as for many
    assert (size - index - reader.embeddings.nbytes) / reader.num_steps < 3600


# What must be refused


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: e.pop("proprio"), "'proprio' is missing"),
        (lambda e: e.pop("instructions"), "'instructions' is missing"),
        (lambda e: e.update(depth_xyz=e["depth_xyz"][:, :-1]), "'depth_xyz' has shape"),
        (lambda e: e.update(text=e["text"][:, :-1]), "'text' has shape"),
        (lambda e: e["action"].__setitem__((3, 4), np.nan), "'action' holds values that are not finite"),
        (
            lambda e: e["lidar_xyz"].__setitem__((0, 0, 0), 1e6),
            "'lidar_xyz' holds values that are not finite as float16",
        ),
        (lambda e: e.update(start="middle"), "start is 'middle'"),
    ],
)
def test_a_bad_episode_is_refused_by_name_and_leaves_nothing(tmp_path, change, message):
    writer = EpisodeWriter(tmp_path, SCHEMA, 0)
    episode = make_episode(0)
    change(episode)
    with pytest.raises(ValueError, match=message):
        writer.add(episode)
    assert writer.num_steps == writer.num_episodes == 0


def test_an_unfinished_shard_is_not_seen_and_is_made_anew(tmp_path):
    writer = EpisodeWriter(tmp_path, SCHEMA, 0)
    writer.add(make_episode(0))
    with pytest.raises(FileNotFoundError, match="no complete shard"):
        shard_paths(tmp_path)
    again = EpisodeWriter(tmp_path, SCHEMA, 0)
    again.add(make_episode(1))
    assert EpisodeReader(again.close()).episodes[0].seed == 1
    with pytest.raises(FileExistsError, match="complete already"):
        EpisodeWriter(tmp_path, SCHEMA, 0)


def test_damage_is_found(tmp_path):
    (path,) = write_shards(tmp_path, episodes=3, shards=1)
    data = path.with_suffix(".zarr") / "steps" / "c" / "0" / "0"
    good = data.read_bytes()
    reader = EpisodeReader(path)
    reader.read(0, 60)
    data.write_bytes(good[:100] + bytes([good[100] ^ 1]) + good[101:])  # within the first chunk
    with pytest.raises(ValueError, match="damaged at steps 0"):
        EpisodeReader(path).read(0, 60)
    data.write_bytes(good[:-20] + bytes([good[-20] ^ 1]) + good[-19:])  # within the shard's index
    with pytest.raises(ValueError, match="damaged shard index"):
        EpisodeReader(path).read(0, 1)
    data.write_bytes(good[:-1])
    with pytest.raises(ValueError, match="bytes, its index says"):
        EpisodeReader(path)
    data.unlink()
    with pytest.raises(FileNotFoundError, match="missing"):
        EpisodeReader(path)
    index = json.loads(path.read_text())
    path.write_text(json.dumps(index | {"files": {"../../etc/passwd": 1}}))
    with pytest.raises(ValueError, match="outside its folder"):
        EpisodeReader(path)
    path.write_text(json.dumps(index | {"format": 99}))
    with pytest.raises(ValueError, match="format 99"):
        EpisodeReader(path)


def test_another_schema_is_refused(shards):
    with pytest.raises(ValueError, match=r"another policy schema .*version differ"):
        EpisodeDataset(shards, replace(SCHEMA, version=2))
    with pytest.raises(ValueError, match=r"another policy schema .*fields differ"):
        EpisodeDataset(shards, SCHEMA.with_points(65, 32))


def test_a_full_disk_is_an_error_and_leaves_no_shard(tmp_path):
    code = (
        "import resource, signal; from student_world import *\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, (20000, {resource.RLIM_INFINITY}))\n"
        f"write_shards({str(tmp_path)!r} and Path({str(tmp_path)!r}), 6, 1)\n"
    )
    env = {"PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}", "PATH": "/usr/bin:/bin"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env)
    assert done.returncode == 1
    assert "cannot write" in done.stderr.splitlines()[-1]
    assert not list(tmp_path.glob("*.json*"))
    (path,) = write_shards(tmp_path, 6, 1)  # the same place can be used again
    assert len(EpisodeReader(path).episodes) == 6


# Random windows


def test_windows_are_what_was_written(shards):
    data = EpisodeDataset(shards, SCHEMA, batch_size=64, chunk=5)
    batch = data[0, 0]
    goals, episodes = [make_episode(s, 1)["p_obj_b"][0] for s in range(30)], {}
    for i in range(64):
        # the object's position identifies the episode, the proprioceptive state the step
        seed = next(s for s, goal in enumerate(goals) if np.allclose(goal, batch["p_obj_b"][i], atol=1e-6))
        episode = episodes.setdefault(seed, make_episode(seed, 21))
        step = int(np.argmin(np.abs(episode["proprio"] - batch["proprio"][i]).sum(-1)))
        count = min(5, 21 - step)
        np.testing.assert_array_equal(batch["action"][i, :count], episode["action"][step : step + count].astype("f4"))
        assert batch["action_valid"][i].tolist() == [1.0] * count + [0.0] * (5 - count)
        assert not batch["action"][i, count:].any()
        np.testing.assert_array_equal(batch["depth_rgb"][i], episode["depth_rgb"][step])
        np.testing.assert_array_equal(batch["target_label"][i], episode["depth_target"][step])
        assert any(np.array_equal(batch["text"][i], embed(s)) for s in episode["instructions"])
    assert len(episodes) > 15
    assert (batch["action_valid"].sum(1) < 5).any()


def test_batches_do_not_depend_on_workers_or_on_where_one_starts(shards):
    data = EpisodeDataset(shards, SCHEMA, batch_size=16, seed=3, augmentation=AugmentConfig())
    count = data.batches_per_epoch + 3  # into the second epoch
    alone = list(data.batches(0, count))
    for workers in (1, 2):
        for a, b in zip(alone, data.batches(0, count, workers), strict=True):
            assert same({k: v.numpy() for k, v in a.items()}, {k: v.numpy() for k, v in b.items()})
    later = next(iter(data.batches(count - 1, count)))
    assert same({k: v.numpy() for k, v in later.items()}, {k: v.numpy() for k, v in alone[-1].items()})
    distinct = {b["proprio"].numpy().tobytes() for b in alone}
    assert len(distinct) == count
    other = EpisodeDataset(shards, SCHEMA, batch_size=16, seed=4, augmentation=AugmentConfig())
    assert not np.array_equal(other[0, 0]["proprio"], alone[0]["proprio"].numpy())


def test_shares(shards):
    goals = lambda d: {tuple(p) for i in range(40) for p in d[0, i]["p_obj_b"].round(5).tolist()}
    common = {"batch_size": 32, "val_share": 0.2}
    train, val = EpisodeDataset(shards, SCHEMA, **common), EpisodeDataset(shards, SCHEMA, held_out=True, **common)
    assert (train.num_episodes, val.num_episodes, train.num_left_out) == (24, 6, 6)
    assert len(goals(train)) == 24 and len(goals(val)) == 6 and not goals(train) & goals(val)
    assert EpisodeDataset(shards, SCHEMA, data_share=0.5).num_episodes == 15
    assert EpisodeDataset(shards, SCHEMA, max_noise=0.5).num_episodes == 15  # noise is 1 in every other one
    with pytest.raises(ValueError, match="no held-out episodes"):
        EpisodeDataset(shards, SCHEMA, held_out=True)
    # a third of the episodes start at the pre-grasp; a share of 1 takes them alone
    only = goals(EpisodeDataset(shards, SCHEMA, batch_size=32, pregrasp_share=1.0))
    assert only == {tuple(make_episode(s, 1)["p_obj_b"][0].astype("f4").round(5).tolist()) for s in range(0, 30, 3)}


def test_every_window_is_as_likely(shards):
    data = EpisodeDataset(shards, SCHEMA, batch_size=512, pregrasp_share=0.0)
    episodes, steps = data._pick(rng_of(0, 0, 0), 0, 63_000)
    counts = np.bincount(episodes * 21 + steps, minlength=630)
    assert counts.shape == (630,)
    assert 630 - 5 * 36 < ((counts - 100.0) ** 2 / 100.0).sum() < 630 + 5 * 36  # chi-squared, 5 sigma


# What is done to observations


def test_augmentation_keeps_its_laws(shards):
    data = EpisodeDataset(shards, SCHEMA, batch_size=2000)
    before, after = data[0, 0], data[0, 0]
    cfg = AugmentConfig(mask_drop=0.3, text_drop=0.4, cloud_dropout=0.1, mask_spill=0.0, mask_swap=0.0)
    augment(after, cfg, rng_of(1, 0, 0))
    for name in ("action", "p_obj_b", "target_label", "proprio", "prev_action", "ee_distance"):
        np.testing.assert_array_equal(after[name], before[name])
    for name in ("depth", "lidar"):
        valid = after[f"{name}_valid"] != 0
        assert not (valid & (before[f"{name}_valid"] == 0)).any()
        assert not after[f"{name}_xyz"][~valid].any()
        empty = (~valid).all(1).mean()
        assert abs(empty - 0.1) < 4 * np.sqrt(0.1 * 0.9 / 2000)
    assert not (after["depth_target"] & ~after["depth_valid"] & 1).any()
    assert not (after["depth_target"] & (1 - before["depth_target"])).any()
    seen = (after["depth_valid"] & before["depth_target"]).any(1)
    no_mask, no_text = ~after["depth_target"].any(1), ~after["text"].any(1)
    assert not (no_text & no_mask & seen).any(), "the target must always be told by one or the other"
    assert abs(no_text.mean() - 0.7 * 0.4) < 4 * np.sqrt(0.28 * 0.72 / 2000)
    assert abs(no_mask[seen].mean() - 0.3) < 0.06
    scatter = (after["lidar_xyz"] - before["lidar_xyz"])[after["lidar_valid"] != 0]
    assert abs(scatter.std() - cfg.lidar_noise) < 0.02 * cfg.lidar_noise


def test_a_swapped_mask_lies_on_another_thing_and_the_instruction_stays(shards):
    after = EpisodeDataset(shards, SCHEMA, batch_size=400)[0, 0]
    truth = after["target_label"].copy()
    cfg = AugmentConfig(mask_drop=0.0, text_drop=0.5, mask_swap=1.0, depth_noise=0.0, cloud_dropout=0.0)
    augment(after, cfg, rng_of(0, 0, 0))
    given = after["depth_target"] != 0
    swapped = after["text"].any(1)
    assert 150 < swapped.sum() < 250
    overlap = (given & (truth != 0)).sum(1) / np.maximum(given.sum(1), 1)
    assert given[swapped].any(1).all()
    assert overlap[swapped].mean() < 0.05  # blobs are well apart; a patch on the table may touch the target
    assert (overlap[~swapped] > 0.5).mean() > 0.9

"""Scenes: settled, apart, reachable, with free start poses; same seed, same scenes."""

from dataclasses import replace

import numpy as np
import pytest
from scenes_small import SCENES, small_bank, small_model, small_objects

from benchmarks.scenes_at_rest import at_rest
from wbm.robot import joints, spheres
from wbm.robot.rotations import rotate
from wbm.scenes import generate
from wbm.scenes.bank import SIDE, SceneBank
from wbm.scenes.config import KINDS, ScenesConfig
from wbm.scenes.layout import draw_layout
from wbm.scenes.placement import draw_scene, self_clearance
from wbm.sim.config import EVALUATE, TRAIN


def test_bank_has_what_was_asked_for():
    bank = small_bank()
    for kind in range(len(KINDS)):
        assert len(bank.where("train", (kind,))) == SCENES.count
        assert len(bank.where("test", (kind,))) == SCENES.test_count
    objects = small_objects()
    for split in ("train", "val", "test"):
        chosen = bank.object[bank.where(split)]
        assert (objects.split[chosen[chosen >= 0]] == split).all()


@pytest.mark.parametrize("cfg", [TRAIN, EVALUATE], ids=["train", "evaluate"])
def test_nothing_moves_in_a_second_and_no_start_touches(cfg):
    for row in at_rest(small_model(), small_bank(), cfg, seconds=1.0, threads=2):
        assert row["scenes"] > 0, row
        assert row["largest_move_mm"] < 5.0, row
        assert row["moved_or_fell"] == 0 and row["starts_in_contact"] == 0, row


def test_objects_stand_apart_and_on_the_surface():
    bank, objects = small_bank(), small_objects()
    for k in range(len(bank)):
        clouds = [
            bank.object_pos[k, i] + rotate(bank.object_quat[k, i], objects.points[o].astype(float))
            for i, o in enumerate(bank.object[k])
            if o >= 0
        ]
        for cloud in clouds:
            assert cloud[:, 2].min() > bank.surface_z[k] - 2e-3
            assert cloud[:, 2].min() < bank.surface_z[k] + 0.02
            assert cloud[:, 2].max() < bank.ceiling_z[k]
        for i in range(len(clouds)):
            for j in range(i):
                gap = np.linalg.norm(clouds[i][:, None] - clouds[j], axis=2).min()
                assert gap > 0.01


def test_starts_are_free_in_front_and_within_limits():
    bank, robot = small_bank(), small_model().robot
    assert (bank.q_start >= robot.q_min).all() and (bank.q_start <= robot.q_max).all()
    for k in range(len(bank)):
        offset = bank.q_start[k, :2] - bank.base_grasp[k, :2]
        ahead = np.array([np.cos(bank.base_grasp[k, 2]), np.sin(bank.base_grasp[k, 2])])
        assert SCENES.start_distance[0] - 1e-9 <= -(offset @ ahead) <= SCENES.start_distance[1] + 1e-9
        to_target = bank.object_pos[k, 0, :2] - bank.base_grasp[k, :2]
        assert np.linalg.norm(to_target) == pytest.approx(SCENES.grasp_reach, abs=0.02)
        assert self_clearance(robot, bank.q_start[k]) > 0
    assert len(np.unique(bank.q_start[:, joints.ARM].round(6), axis=0)) == len(bank)
    assert len(spheres.robot_spheres(robot)) <= 64


def test_hints_follow_the_scene():
    bank = small_bank()
    assert (bank.approach[bank.kind == KINDS.index("shelf")] == SIDE).all()
    assert (bank.approach[bank.kind == KINDS.index("bin")] != SIDE).all()


def test_same_seed_same_scenes(monkeypatch, tmp_path):
    monkeypatch.setenv("WBM_CACHE", str(tmp_path / "a"))
    cfg = ScenesConfig(count=2, test_count=0, kinds=("bin",))
    first = generate.generate_scenes(small_model(), cfg, 4)
    kept = generate.generate_scenes(small_model(), cfg, 4)
    monkeypatch.setenv("WBM_CACHE", str(tmp_path / "b"))
    fresh = generate.generate_scenes(small_model(), cfg, 4)
    other = generate.generate_scenes(small_model(), cfg, 5)
    for name in SceneBank.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(first, name), getattr(fresh, name), err_msg=name)
        np.testing.assert_array_equal(getattr(first, name), getattr(kept, name), err_msg=name)
    assert not np.array_equal(first.q_start, other.q_start)


def test_moving_scenes_are_dropped():
    """A ball dropped from a height, or tipped over, is not a settled scene."""
    bank, scenes = small_bank(), small_model()
    pos = bank.object_pos.copy()
    pos[1, 0, 2] += 0.05
    spoiled = SceneBank(**{**bank.__dict__, "object_pos": pos}).select(np.arange(3))
    assert len(generate.settle(scenes, spoiled, SCENES)) == 2


@pytest.mark.parametrize("kind", KINDS)
def test_layouts_keep_their_promises(kind):
    cfg = ScenesConfig()
    rng = np.random.default_rng(0)
    for _ in range(50):
        layout = draw_layout(kind, rng, cfg)
        assert 1 <= len(layout.pos) <= 8 and (layout.size > 0).all()
        tops = layout.pos[:, 2] + layout.size[:, 2]
        bottoms = layout.pos[:, 2] - layout.size[:, 2]
        assert bottoms.min() >= -1e-9
        assert np.isclose(tops, layout.surface_z).any()
        assert (layout.high > layout.low).all() and (layout.target_high > layout.target_low).all()
        assert (layout.target_low >= layout.low).all() and (layout.target_high <= layout.high).all()
        if kind == "table":
            assert 0.40 <= layout.surface_z <= 0.75
            low = bottoms < layout.surface_z - 0.06
            assert (layout.pos[low, 0] - layout.size[low, 0]).min() >= 0.30  # the base drives partly under
        if kind == "shelf":
            assert 0.30 - 1e-9 <= layout.ceiling_z - layout.surface_z <= 0.40
            assert (tops < layout.surface_z - 0.1).any()
        if kind == "bin":
            assert (layout.high - layout.low >= [0.339, 0.279]).all()
            walls = tops[tops > layout.surface_z + 1e-6] - layout.surface_z
            assert len(walls) == 4 and (walls >= 0.08).all() and (walls <= 0.14).all()


def test_bank_round_trip(tmp_path):
    bank = small_bank()
    bank.save(tmp_path / "scenes.npz")
    again = SceneBank.load(tmp_path / "scenes.npz")
    for name in SceneBank.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(bank, name), getattr(again, name))
    np.savez(tmp_path / "other.npz", kind=bank.kind)
    with pytest.raises(ValueError, match="lacks"):
        SceneBank.load(tmp_path / "other.npz")


@pytest.mark.parametrize(
    "bad",
    [
        {"kinds": ("moon",)},
        {"count": 0},
        {"distractors": (2, 1)},
        {"distractors": (0, 9)},
        {"table_height": (0.7, 0.4)},
    ],
)
def test_bad_settings_are_refused(bad):
    with pytest.raises(ValueError, match="scenes"):
        ScenesConfig(**bad)


def test_impossible_scenes_say_so():
    objects = small_objects()
    wide = replace(objects, width=np.full(len(objects), 0.5))
    with pytest.raises(ValueError, match=r"none of the .* train objects can be a target in a bin scene"):
        draw_scene("bin", np.arange(5), "train", wide, small_model().robot, SCENES, np.random.default_rng(0))

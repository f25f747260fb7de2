"""Procedural objects: enough of them, distinct, graspable, split by object and by family."""

import numpy as np
import pytest
from scenes_small import small_objects

from wbm.scenes import parts
from wbm.scenes.config import ObjectsConfig
from wbm.scenes.families import FAMILIES
from wbm.scenes.objects import ObjectSet, stack_objects
from wbm.scenes.procedural import COLORS, draw_objects


@pytest.fixture(scope="module")
def entries():
    return draw_objects(ObjectsConfig(count=1003), 5)


def test_at_least_ten_families_and_a_thousand_distinct_objects(entries):
    assert len(FAMILIES) >= 10
    assert {e.family for e in entries} == set(FAMILIES)
    assert len({e.name for e in entries}) == len(entries) >= 1000
    sizes = {tuple(np.round(np.concatenate(parts.bounds(e.parts)), 6)) for e in entries}
    assert len(sizes) > 990


def test_every_object_can_be_grasped(entries):
    for entry in entries:
        low, high = parts.bounds(entry.parts)
        extent = np.sort(high - low)
        assert 0.03 - 1e-9 <= extent[0] <= 0.12 and extent[2] <= 0.22, entry.name
        assert 0.03 <= min(high[0] - low[0], high[1] - low[1]) <= 0.12, entry.name
        assert low[2] == pytest.approx(0.0, abs=1e-9), entry.name
        assert 0.05 <= entry.mass <= 0.4
        assert 1 <= len(entry.parts) <= parts.MAX_PARTS
    common = [min(np.diff(np.array(parts.bounds(e.parts)), axis=0)[0, :2]) for e in entries if e.split == "train"]
    assert np.mean([0.035 <= w <= 0.085 for w in common]) > 0.7


def test_words(entries):
    assert {e.color for e in entries} == set(COLORS)
    assert {e.size_word for e in entries} >= {"tall", "flat", "small", "large", ""}
    tall = next(e for e in entries if e.size_word == "tall")
    low, high = parts.bounds(tall.parts)
    assert high[2] > 1.8 * max(high[:2] - low[:2])


def test_splits_are_disjoint_and_hold_out_families(entries):
    cfg = ObjectsConfig()
    assert len(cfg.held_out) >= 2
    for entry in entries:
        assert (entry.family in cfg.held_out) <= (entry.split == "test")
    shares = {s: np.mean([e.split == s for e in entries]) for s in ("train", "val", "test")}
    assert shares["train"] > 0.6 and shares["val"] > 0.03 and shares["test"] > 0.15


def test_an_object_depends_on_seed_and_index_alone():
    few, many = draw_objects(ObjectsConfig(count=20), 9), draw_objects(ObjectsConfig(count=40), 9)
    other = draw_objects(ObjectsConfig(count=20), 10)
    for a, b, c in zip(few, many, other, strict=False):
        assert a.name == b.name and a.mass == b.mass and a.split == b.split
        np.testing.assert_array_equal(parts.bounds(a.parts), parts.bounds(b.parts))
        assert not np.allclose(parts.bounds(a.parts), parts.bounds(c.parts))


def test_save_and_load_are_exact(tmp_path):
    objects = small_objects()
    objects.save(tmp_path / "objects.npz")
    again = ObjectSet.load(tmp_path / "objects.npz")
    for name in objects.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(objects, name), getattr(again, name))
    objects.save(tmp_path / "twice.npz")
    assert (tmp_path / "objects.npz").read_bytes() == (tmp_path / "twice.npz").read_bytes()
    np.savez(tmp_path / "other.npz", name=objects.name)
    with pytest.raises(ValueError, match="lacks"):
        ObjectSet.load(tmp_path / "other.npz")


def test_unknown_families_are_refused():
    with pytest.raises(ValueError, match="teapot"):
        draw_objects(ObjectsConfig(count=4, families=("teapot",)), 0)


@pytest.mark.parametrize(
    "bad",
    [
        {"source": "download"},
        {"source": "meshes"},
        {"count": 1},
        {"test_share": 0.9, "val_share": 0.2},
        {"density": (5.0, 1.0)},
        {"mass": (0.0, 1.0)},
        {"max_hulls": 9},
        {"max_hull_vertices": 3},
    ],
)
def test_bad_settings_are_refused(bad):
    with pytest.raises(ValueError, match="objects"):
        ObjectsConfig(**bad)


def test_hollow_families_are_hollow():
    """A point in the middle of a mug or bowl, above its floor, is inside none of its parts."""
    rng = np.random.default_rng(0)
    for noun in ("mug", "bowl"):
        draft = FAMILIES[noun](rng)
        high = parts.bounds(draft.parts)[1]
        probe = np.array([[0.0, 0.0, 0.6 * high[2]]])
        assert not any(parts.inside(p, probe)[0] for p in draft.parts)
    entries = [e for e in draw_objects(ObjectsConfig(count=17), 0) if e.noun in ("mug", "bowl")]
    assert stack_objects(entries).has_mesh().all()

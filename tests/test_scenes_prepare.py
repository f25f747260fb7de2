"""The stage prepare-assets from end to end, small; its artifact, its pictures and its loader."""

from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
import pytest
from PIL import Image

from stages import prepare_assets
from wbm.robot.config import MjcfOptions
from wbm.scenes.assets import Assets, load_assets
from wbm.scenes.config import ObjectsConfig, ScenesConfig
from wbm.scenes.instructions import Texts


@dataclass
class Config:
    robot: MjcfOptions = field(default_factory=MjcfOptions)
    objects: ObjectsConfig = field(default_factory=lambda: ObjectsConfig(count=34))
    scenes: ScenesConfig = field(default_factory=lambda: ScenesConfig(count=2, test_count=1))
    seed: int = 2


@dataclass
class Draft:
    path: Path
    metrics: dict = field(default_factory=dict)


class Progress:
    def __init__(self):
        self.described = []

    def track(self, iterable, description, total=None):
        self.described.append(description)
        yield from iterable


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    monkeypatch = pytest.MonkeyPatch()
    monkeypatch.setenv("WBM_CACHE", str(tmp_path_factory.mktemp("cache")))
    drafts = []
    for name in ("first", "second"):
        drafts.append(Draft(tmp_path_factory.mktemp(name)))
        progress = Progress()
        prepare_assets.run(Config(), {}, drafts[-1], progress)
        assert progress.described == ["objects", "scenes"]
    monkeypatch.undo()
    return drafts


def test_metrics_and_files(made):
    draft = made[0]
    assert draft.metrics["objects"] == 34 and draft.metrics["objects_skipped"] == 0
    assert draft.metrics["scenes_train"] == 6 and draft.metrics["scenes_test"] == 3
    names = {"instructions.npz", "objects.npz", "objects.png", "report.json", "robot.xml", "scenes.npz", "scenes.png"}
    assert {p.name for p in draft.path.iterdir()} == names
    assert mujoco.MjModel.from_xml_path(str(draft.path / "robot.xml")).nu == 32


def test_a_second_run_gives_the_same_bytes(made):
    for path in made[0].path.iterdir():
        assert path.read_bytes() == (made[1].path / path.name).read_bytes(), path.name


def test_loader_gives_what_belongs_together(made):
    assets = load_assets(made[0].path)
    scenes, texts = assets.scenes, assets.texts
    assert texts.embedding.shape == (len(texts.sentence), 384)
    np.testing.assert_allclose(np.linalg.norm(texts.embedding, axis=1), 1.0, atol=1e-5)
    for k in range(len(scenes)):
        noun = str(assets.objects.noun[scenes.object[k, 0]])
        assert any(w in texts.sentence[scenes.text[k, 0]] for w in (noun, "object"))
    assert set(assets.meshes) == set(np.flatnonzero(assets.objects.has_mesh()).tolist())
    vertices, faces = next(iter(assets.meshes.values()))
    assert faces.max() == len(vertices) - 1


def test_loader_refuses_what_is_no_artifact(made, tmp_path):
    with pytest.raises(FileNotFoundError, match="not an assets artifact"):
        load_assets(tmp_path)
    assets = load_assets(made[0].path)
    short = Texts(assets.texts.sentence[:2], assets.texts.embedding[:2])
    Assets(assets.objects, assets.scenes, short).save(tmp_path, {})
    with pytest.raises(ValueError, match="do not fit together"):
        load_assets(tmp_path)


def test_contact_sheets_show_things(made):
    for name, colors in (("objects.png", 200), ("scenes.png", 200)):
        image = np.asarray(Image.open(made[0].path / name))
        assert image.ndim == 3 and image.shape[1] > 1000
        assert len(np.unique(image.reshape(-1, 3), axis=0)) > colors
    objects = load_assets(made[0].path).objects
    sheet = np.asarray(Image.open(made[0].path / "objects.png")).astype(float)
    for o in range(0, 12):  # the middle of a tile has its object's hue
        tile = sheet[40:72, o * 128 + 48 : o * 128 + 80].reshape(-1, 3) / 255
        shade = tile / np.maximum(tile.max(axis=1, keepdims=True), 1e-6)
        hue = objects.rgb[o] / objects.rgb[o].max()
        assert np.abs(shade - hue).max(axis=1).min() < 0.12, objects.name[o]

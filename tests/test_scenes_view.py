"""`wbm view` of assets in headless Chromium: scenes with the robot, its spheres, and all objects side by side."""

import numpy as np
import pytest
from browser import chromium, page_of
from scenes_small import small_bank, small_model, small_objects

from wbm.report.gallery import COLUMNS, PITCH, gallery_tracks
from wbm.robot.rotations import rotate
from wbm.scenes.assets import Assets
from wbm.scenes.instructions import Texts, write_instructions


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("assets")
    bank, sentences = write_instructions(small_objects(), small_bank(), 0)
    Assets(small_objects(), bank, Texts(sentences, np.zeros((len(sentences), 384), np.float32))).save(path, {})
    return path


def test_the_gallery_stands_on_the_floor_in_front_of_the_robot(folder):
    objects = small_objects()
    tracks = gallery_tracks(Assets(objects, small_bank(), Texts(np.array([]), np.zeros((0, 384)))))
    assert [s.id for s in tracks.solids] == list(objects.name)
    np.testing.assert_allclose(tracks.q[0], small_model().robot.q_home)
    low = [float((rotate(s.quat, s.vertices) + s.pos)[:, 2].min()) for s in tracks.solids]
    np.testing.assert_allclose(low, 0.0, atol=2e-3)
    places = np.array([s.pos[:2] for s in tracks.solids])
    assert len(np.unique(places.round(6), axis=0)) == len(places) and np.ptp(places[:, 1]) < COLUMNS * PITCH


@pytest.mark.browser
def test_assets_in_a_browser(folder, tmp_path):
    module = pytest.importorskip("wbm.report.viewer", reason="needs viser")
    from stages.view import items_of

    items = items_of(folder, "assets")
    assert items[-1].name == f"objects ({len(small_objects())})" and items[0].name.startswith("scene 0: ")
    viewer = module.Viewer(items, port=0)
    try:
        with (
            chromium(("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")) as browser,
            page_of(browser, 900, 600) as (page, troubles),
        ):
            page.goto(viewer.address)
            page.wait_for_selector("canvas", timeout=60_000)
            page.get_by_text("Robot spheres").wait_for(timeout=60_000)
            page.wait_for_timeout(2500)
            scene = page.screenshot(path=tmp_path / "scene.png")
            page.get_by_label("Robot spheres").check()
            page.wait_for_timeout(1500)
            spheres = page.screenshot(path=tmp_path / "spheres.png")
            viewer._select(items[-1].name)
            page.wait_for_timeout(2500)
            objects = page.screenshot(path=tmp_path / "objects.png")
            assert scene != spheres != objects
            assert all(handle.visible for handle in viewer._spheres)
            assert not troubles
    finally:
        viewer.close()

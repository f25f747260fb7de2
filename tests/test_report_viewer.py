"""The viewer in headless Chromium: it draws, plays, scrubs and follows, on this machine only."""

from __future__ import annotations

import time

import numpy as np
import pytest
from browser import chromium, page_of
from hypothesis import given, settings
from hypothesis import strategies as st

from wbm.artifacts.mcap_io import BOX, EpisodeTracks, Solid
from wbm.report.sight import sight_image
from wbm.report.tracks import frame_tracks, joint_tracks, mats_to_quats, robot_tracks
from wbm.robot.model import frame_poses, load_robot
from wbm.robot.proprio import FRAMES, proprioception, quat_to_mat
from wbm.robot.schema import ActionSpec, to_target
from wbm.robot.spheres import batched_kinematics


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_quaternions_of_tracks(seed):
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(9, 4))
    quat[3:6] = np.eye(4)[1:]  # half turns, where the trace is of no use
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    np.testing.assert_allclose(quat_to_mat(np, mats_to_quats(quat_to_mat(np, quat))), quat_to_mat(np, quat), atol=1e-12)


def test_joints_come_back_from_proprioception():
    robot, rng = load_robot(), np.random.default_rng(0)
    q = rng.uniform(robot.q_min, robot.q_max, (6, 32))
    qd = rng.normal(size=(6, 32))
    frames = frame_tracks(robot, q)
    for name, (pos, quat) in frames.items():
        rot_w, pos_w = frame_poses(robot, q[2])[name]
        np.testing.assert_allclose(pos[2], pos_w, atol=1e-12)
        np.testing.assert_allclose(quat_to_mat(np, quat[2]), rot_w, atol=1e-12)
    pos, quat = (np.stack([frames[n][i] for n in FRAMES], axis=1) for i in (0, 1))
    back_q, back_qd = joint_tracks(proprioception(np, q, qd, pos, quat), q[:, :3])
    np.testing.assert_allclose(back_q, q, atol=1e-12)
    np.testing.assert_allclose(back_qd, qd, atol=1e-12)


def test_the_robot_shows_every_joint_inside_its_range():
    robot, tracks = load_robot(), robot_tracks()
    assert (tracks.q >= robot.q_min - 1e-12).all() and (tracks.q <= robot.q_max + 1e-12).all()
    assert (np.ptp(tracks.q, axis=0) > 0.05).all()


def make_tracks(steps: int = 60) -> EpisodeTracks:
    robot, rng = load_robot(), np.random.default_rng(0)
    times = np.arange(steps) / 25
    q = np.tile(robot.q_home, (steps, 1))
    q[:, 0] = 0.5 * times
    moving = np.stack([0.8 + 0 * times, 0 * times, 0.6 + 0.1 * times], axis=1)
    unit = np.tile([1.0, 0, 0, 0], (steps, 1))
    cloud = (rng.normal(size=(steps, 40, 3)) * 0.2 + [0.8, 0, 0.6]).astype(np.float32)
    return EpisodeTracks(
        times=times,
        q=q,
        action=rng.uniform(-1, 1, q.shape),
        camera=(cloud, rng.integers(0, 256, (steps, 40, 3), dtype=np.uint8), np.ones((steps, 40), np.uint8)),
        lidar=(cloud * 2, np.ones((steps, 40), np.uint8)),
        solids=(
            Solid("table", BOX, (0.3, 0.5, 0.02), (0.6, 0.5, 0.4, 1), np.array([0.9, 0, 0.5]), unit[0]),
            Solid("target", BOX, (0.04, 0.04, 0.08), (0.9, 0.3, 0.1, 1), moving, unit),
        ),
        log=((0.0, "approach"), (1.0, "contact")),
    )


@pytest.fixture
def viewer():
    module = pytest.importorskip("wbm.report.viewer", reason="needs viser")
    mask = np.zeros((60, 40), np.uint8)
    mask[:, :10] = 1
    items = [
        module.Shown("episode 0", make_tracks, mask),
        module.Shown("robot", lambda: robot_tracks(seconds=2.0)),
    ]
    viewer = module.Viewer(items, port=0)
    yield viewer
    viewer.close()


def test_steps_place_robot_and_objects(viewer):
    tracks, robot = make_tracks(), load_robot()
    viewer.show(40)
    rot, pos = batched_kinematics(robot, tracks.q[40:41])
    for i, handle in viewer._links.items():
        np.testing.assert_allclose(handle.position, pos[0, i], atol=1e-9)
        np.testing.assert_allclose(quat_to_mat(np, np.array(handle.wxyz)), rot[0, i], atol=1e-9)
    np.testing.assert_allclose(viewer._moving[0][0].position, tracks.solids[1].pos[40])
    colours = np.asarray(viewer._parts["camera"].colors)
    assert (colours[:10] == (255, 70, 20)).all() and not (colours[10:] == (255, 70, 20)).all(axis=1).any()
    assert "contact" in viewer._clock.content
    rot_w, pos_w = frame_poses(robot, to_target(np, tracks.q[40], tracks.action[40], ActionSpec()))["ee"]
    np.testing.assert_allclose(viewer._parts["command"].position, pos_w, atol=1e-9)
    np.testing.assert_allclose(quat_to_mat(np, np.array(viewer._parts["command"].wxyz)), rot_w, atol=1e-9)
    viewer.show(10_000)
    assert viewer.step == 59
    viewer._select("robot")
    assert viewer.step == 0 and not viewer._moving and len(viewer.tracks.times) == 50


def test_playing_follows_the_clock_and_stops_at_the_end(viewer):
    viewer._speed.value = "4"
    viewer._toggle()
    deadline = time.monotonic() + 30
    while viewer.playing and time.monotonic() < deadline:
        time.sleep(0.05)
    assert viewer.step == 59 and not viewer.playing and viewer._play.label == "Play"


def test_the_picture_shows_points_where_the_camera_sees_them():
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0], [0.5, 0.0, 1.0], [0.0, 0.25, 1.0], [0.0, 0.0, -1.0]])
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0], [255, 255, 255]], np.uint8)
    image = sight_image(points, colours, np.eye(3), np.zeros(3), 200, 100)
    assert tuple(image[50, 100]) == (255, 0, 0)  # the nearer of two on the axis
    assert tuple(image[50, int(100 * (1 + 0.5 / np.tan(np.radians(43.5))))]) == (0, 0, 255)
    assert tuple(image[int(50 * (1 + 0.25 / np.tan(np.radians(29.0)))), 100]) == (255, 255, 0)
    assert not (image == 255).all(axis=2).any()  # behind the camera
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = sight_image(points @ turn.T + [1, 2, 3], colours, turn, np.array([1.0, 2, 3]), 200, 100)
    np.testing.assert_array_equal(moved, image)


class ScriptedPolicy:
    """Two episodes of a policy that takes a step whenever it is asked and not paused."""

    def __init__(self, lengths: tuple[int, ...] = (12, 60)) -> None:
        self.lengths, self.number, self.steps, self.paused, self.speed = lengths, 0, 0, True, 0.0
        self.error = ""

    def set_pace(self, paused: bool, speed: float) -> None:
        self.paused, self.speed = paused, speed

    def poll(self):
        if self.error:
            raise ValueError(self.error)
        if not self.paused:
            if self.steps == self.lengths[self.number] and self.number + 1 < len(self.lengths):
                self.number, self.steps = self.number + 1, 0
            self.steps = min(self.steps + 1, self.lengths[self.number])
        mask = np.zeros((max(self.steps, 1), 40), np.uint8)
        return self.number, make_tracks(self.steps), mask


@pytest.fixture
def live():
    module = pytest.importorskip("wbm.report.viewer", reason="needs viser")
    policy = ScriptedPolicy()
    viewer = module.Viewer([module.Shown("student", live=policy), module.Shown("robot", robot_tracks)], port=0)
    yield viewer, policy
    viewer.close()


def wait_for(condition) -> None:
    deadline = time.monotonic() + 60
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert condition()


def test_a_live_policy_is_followed_paused_and_looked_back_on(live):
    viewer, policy = live
    wait_for(lambda: policy.number == 1 and viewer._number == 1 and viewer.step > 20)
    viewer._speed.value = "2"
    wait_for(lambda: policy.speed == 2.0)
    viewer._scrub.value = 5  # looking back holds the policy
    viewer._scrubbed()
    assert policy.paused and not viewer.playing and viewer.step == 5
    _, pos = batched_kinematics(viewer.robot, viewer.tracks.q)
    np.testing.assert_allclose(viewer._link_pos, pos, atol=1e-12)  # built up step by step
    steps = policy.steps
    time.sleep(0.2)
    assert policy.steps == steps and viewer.step == 5
    viewer._toggle()
    wait_for(lambda: viewer.step == 59)
    policy.error = "the hand fell off"
    wait_for(lambda: "the hand fell off" in viewer._clock.content)
    assert not viewer.playing
    viewer._select("robot")
    assert policy.paused and not viewer.playing


@pytest.mark.browser
def test_a_live_policy_in_a_browser(live):
    viewer, policy = live
    with (
        chromium(("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")) as browser,
        page_of(browser, 900, 600) as (page, troubles),
    ):
        page.goto(viewer.address)
        page.wait_for_selector("canvas", timeout=60_000)
        page.get_by_text("2.36 s").wait_for(timeout=60_000)
        page.get_by_role("button", name="Pause").click()
        page.get_by_role("button", name="Play").wait_for(timeout=20_000)
        assert policy.paused
        assert page.get_by_text("What the student sees").count() == 1
        assert not troubles


@pytest.mark.browser
def test_viewer_in_a_browser(viewer, tmp_path):
    with (
        chromium(("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")) as browser,
        page_of(browser, 900, 600) as (page, troubles),
    ):
        page.goto(viewer.address)
        page.wait_for_selector("canvas", timeout=60_000)
        page.get_by_role("button", name="Play").wait_for(timeout=60_000)
        page.wait_for_timeout(2500)
        first = page.screenshot(path=tmp_path / "first.png")
        assert page.get_by_text("0.00 s").count() == 1
        viewer.show(50)
        page.get_by_text("2.00 s").wait_for(timeout=20_000)
        page.wait_for_timeout(1500)
        second = page.screenshot(path=tmp_path / "second.png")
        assert len(set(_pixels(first))) > 500  # a picture, not an empty canvas
        assert first != second
        viewer.show(0)
        page.get_by_role("button", name="Play").click()
        page.get_by_text("2.36 s").wait_for(timeout=60_000)
        assert viewer.step == 59
        assert not troubles


def _pixels(png: bytes) -> list[tuple[int, ...]]:
    import io

    from PIL import Image

    return list(Image.open(io.BytesIO(png)).convert("RGB").resize((300, 200)).get_flattened_data())

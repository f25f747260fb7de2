"""The software renderer: geometry against rays, light by what must be brighter, and the benchmark's comparison."""

import numpy as np
import pytest

from wbm.robot.rotations import mat_to_quat
from wbm.sensors import bench
from wbm.sensors.poses import look_at, optical_axis
from wbm.sensors.render import Renderer, render_rgb
from wbm.sensors.scene import BOX, SPHERE, Instances, RayScene, floor_instance

EYE, FOCUS = np.array([1.5, -1.5, 1.2]), np.array([0.0, 0.0, 0.2])


@pytest.fixture(scope="module")
def scene():
    """Environment 0 is empty, 1 holds a red box and a green ball on the floor."""
    things = Instances.empty(2)
    things.type[:], things.size[:] = [BOX, SPHERE], [[0.3, 0.3, 0.2], [0.2, 0.0, 0.0]]
    things.pos[:], things.color[:] = [[0, 0, 0.2], [0, 0.9, 0.2]], [[0.9, 0.05, 0.05], [0.05, 0.9, 0.05]]
    out = RayScene(2, 0, 3)
    out.update_envs([0], floor_instance())
    out.update_envs([1], Instances.concat([floor_instance(), things]))
    return out


def project(point: np.ndarray, width: int, height: int, fov_deg: float) -> tuple[int, int]:
    """Pixel (row, column) of a world point by the pinhole model, written independently of the rays."""
    z = (FOCUS - EYE) / np.linalg.norm(FOCUS - EYE)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    local = np.array([x, np.cross(z, x), z]) @ (point - EYE)
    focal = height / 2 / np.tan(np.radians(fov_deg) / 2)
    return int(height / 2 + focal * local[1] / local[2]), int(width / 2 + focal * local[0] / local[2])


def test_picture_shows_the_right_environment_in_the_right_place(scene):
    image = render_rgb(scene, 1, EYE, look_at(EYE, FOCUS), 160, 120, 50.0)
    empty = render_rgb(scene, 0, EYE, look_at(EYE, FOCUS), 160, 120, 50.0)
    assert image.shape == (120, 160, 3)
    assert image.dtype == np.uint8
    for point, channel in (((0.3, -0.3, 0.2), 0), ((0.0, 0.9, 0.2), 1)):
        row, column = project(np.array(point), 160, 120, 50.0)
        assert image[row, column].argmax() == channel
        assert image[row, column].max() > 2 * np.median(image[row, column])
        assert np.ptp(empty[row, column].astype(int)) < 40
    # The sky is bluish.
    up = render_rgb(scene, 0, EYE, look_at(EYE, EYE + np.array([1.0, 0.0, 0.3])), 40, 30, 30.0)
    assert up[0, :, 2].min() > up[0, :, 0].max()


def test_objects_cast_shadows_and_faces_differ(scene):
    renderer = Renderer(160, 120, 50.0)
    # Shadows fall towards -x, +y: seen from there.
    eye = EYE * (-1, -1, 1)
    with_box = renderer.draw(scene, 1, eye, look_at(eye, FOCUS)).astype(int)
    without = renderer.draw(scene, 0, eye, look_at(eye, FOCUS)).astype(int)
    grey = np.ptp(with_box, axis=2) < 25
    darker = grey & (with_box.sum(2) < 0.8 * without.sum(2))
    assert darker.sum() > 50
    assert not (grey & (with_box.sum(2) > without.sum(2) + 6)).any()
    np.testing.assert_array_equal(with_box, renderer.draw(scene, 1, eye, look_at(eye, FOCUS)))
    lit = renderer.draw(scene, 1, EYE, look_at(EYE, FOCUS)).astype(int)
    top, side = (project(np.array(p), 160, 120, 50.0) for p in ((0, 0, 0.4), (0.3, -0.2, 0.2)))
    assert lit[top][0] > lit[side][0] + 10


def test_bad_poses_are_refused(scene):
    with pytest.raises(ValueError, match="not finite"):
        render_rgb(scene, 0, np.array([np.nan, 0, 0]), np.array([1.0, 0, 0, 0]))
    with pytest.raises(ValueError, match="within 0"):
        render_rgb(scene, 2, EYE, look_at(EYE, FOCUS), 8, 8)
    with pytest.raises(ValueError, match="fov_deg"):
        Renderer(8, 8, 180.0)


def test_look_at_is_upright_and_points_there():
    rng = np.random.default_rng(0)
    for _ in range(50):
        pos, target = rng.normal(size=(2, 3))
        quat = look_at(pos, target)
        axis = (target - pos) / np.linalg.norm(target - pos)
        assert np.abs(optical_axis(quat) - axis).max() < 1e-9
        rot, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        rot *= np.sign(np.linalg.det(rot))
        q = mat_to_quat(rot)
        assert np.abs(optical_axis(q) - rot[:, 2]).max() < 1e-9
    assert np.allclose(optical_axis(look_at(np.zeros(3), np.array([0, 0, -1.0]))), [0, 0, -1])


def test_benchmark_reports_its_keys_and_finds_no_difference():
    out = bench.measure_exactness(4, 8000)
    assert out["rays_compared"] >= 8000
    assert out["max_abs_error_m"] <= 1e-4
    assert out["id_mismatches_unexplained"] == 0
    assert out["id_mismatches"] <= 1
    (row,) = bench.measure_speed((48,), 2, 1, peers=False)
    for key in ("depth_mrays_s", "lidar_mrays_s", "mj_multiray_depth", "mj_multiray_lidar"):
        assert np.isfinite(row[key])
        assert row[key] > 0


def test_benchmark_sees_a_moved_instance():
    """The comparison fails when the two sides differ by 1 mm."""
    setup = bench.make_setup(0, 1, 48, bench.DepthConfig(32, 24), bench.LidarConfig(64), 1, random_robot=False)
    oracle = setup.oracle(0)
    setup.scene.pos.numpy()[0, 36] += 0.001  # the table top
    setup.camera.render()
    assert bench.compare(setup, 0, oracle, setup.camera)["error"] > 5e-4

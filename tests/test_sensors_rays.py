"""Ray routine against `mj_multiRay` on random scenes. Tolerance: 1e-4 m in range (float32 kernels, float64 MuJoCo).

A ray that grazes the floor far away is its horizon, a silhouette: a float32 direction is wrong by 1e-7, the range by
`t / sin(incidence)` times that. Incidences below 3 degrees are left out of the largest error.
"""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from wbm.robot.model import load_robot
from wbm.robot.rotations import quat_to_mat
from wbm.sensors.bench_scene import robot_bodies, sample_meshes, tabletop
from wbm.sensors.bundles import GROUP, SUBGROUP, build_table, common_part
from wbm.sensors.config import DepthConfig, LidarConfig
from wbm.sensors.depth import DepthCamera, pinhole_rays, pixel_areas
from wbm.sensors.lidar import Lidar, scan_rays
from wbm.sensors.oracle import MujocoScene
from wbm.sensors.ray_sensor import RaySensor
from wbm.sensors.scene import BOX, CAPSULE, CYLINDER, MESH, PLANE, SPHERE, UNUSED, Instances, RayScene, Semantic

TOLERANCE = 1e-4
GRAZING = np.sin(np.radians(3.0))


def random_quat(rng):
    quat = rng.normal(size=4)
    return quat / np.linalg.norm(quat)


@pytest.fixture(scope="module")
def world():
    """Four environments with different scenes; the third is compared."""
    rng, robot, meshes = np.random.default_rng(3), load_robot(), sample_meshes(1)
    scene = RayScene(4, len(robot.link_names), 80, meshes)
    rows = [tabletop(rng, 60, 8, len(meshes))[0] for _ in range(4)]
    scene.update_envs(np.arange(4), rows)
    return MujocoScene(rows[2], meshes), scene, rows[2], rng


def check_env(sensor: RaySensor, env: int, oracle: MujocoScene, row: Instances, planar: bool) -> int:
    """Every output of one environment against the oracle; returns the number of hits compared."""
    R_WS = quat_to_mat(sensor.true_quat.numpy()[env].astype(float))
    origin = sensor.true_pos.numpy()[env].astype(float)
    rays = sensor.table.rays[sensor.pattern.numpy()[env]]
    rays_w = rays @ R_WS.T
    dist, inst = oracle.cast(origin, rays_w, sensor.exclude_body)
    measured = dist * rays[:, 2] if planar else dist
    want = (dist >= 0) & (measured >= sensor.min_range) & (measured <= sensor.max_range)
    valid, got = sensor.valid.numpy()[env], sensor.range.numpy()[env]
    assert (want != valid).sum() <= 1
    both = want & valid
    same = both & (inst == sensor.instance.numpy()[env])
    assert (both & ~same).sum() <= 1
    same &= (inst != 0) | (np.abs(rays_w[:, 2]) > GRAZING)
    assert np.abs(got[same] - dist[same]).max(initial=0.0) <= TOLERANCE
    assert (
        np.abs(sensor.depth.numpy()[env][same] - (dist * rays[:, 2])[same]).max(initial=0.0) <= TOLERANCE or not planar
    )
    world = origin + dist[same, None] * rays_w[same]
    assert np.abs(sensor.point_w.numpy()[env][same] - world).max(initial=0.0) <= TOLERANCE
    R_frame = quat_to_mat(sensor.quat.numpy()[env].astype(float))
    assert np.abs(sensor.point_s.numpy()[env][same] - (world - origin) @ R_frame).max(initial=0.0) <= TOLERANCE
    np.testing.assert_array_equal(sensor.id.numpy()[env][same], row.id[inst[same]])
    np.testing.assert_array_equal(sensor.color.numpy()[env][same], row.color[inst[same]])
    invalid = ~valid
    for name in ("range", "depth", "instance", "id"):
        assert (getattr(sensor, name).numpy()[env][invalid] == -1).all()
    for name in ("color", "point_s", "point_w"):
        assert (getattr(sensor, name).numpy()[env][invalid] == 0).all()
    return int(same.sum())


def poison(sensor: RaySensor) -> None:
    """Fill outputs so that an unwritten cell fails."""
    for name in ("range", "depth", "true_range"):
        getattr(sensor, name).fill_(np.inf)
    for name in ("color", "point_s", "point_w"):
        getattr(sensor, name).fill_(wp.vec3(np.inf, np.inf, np.inf))
    for name in ("instance", "id", "true_instance"):
        getattr(sensor, name).fill_(12345)


@pytest.mark.parametrize("device", ["depth", "lidar"])
def test_matches_mujoco(world, device):
    oracle, scene, row, rng = world
    robot = load_robot()
    if device == "depth":
        sensor = DepthCamera(DepthConfig(width=51, height=37), scene, exclude_body=robot.frames["camera"].link)
    else:
        sensor = Lidar(LidarConfig(num_rays=1000), scene, exclude_body=robot.frames["lidar"].link)
        sensor.step.assign(np.array([0, 3, 777, 12]))
    seen = 0
    for _ in range(8):
        q = rng.uniform(robot.q_min, robot.q_max)
        q[:3] = rng.uniform(-0.5, 0.5, 3)
        scene.body_pos.numpy()[2], scene.body_quat.numpy()[2] = robot_bodies(q)
        oracle.place(scene.body_pos.numpy()[2], scene.body_quat.numpy()[2])
        sensor.pos.numpy()[2], sensor.quat.numpy()[2] = rng.uniform([-1, -1, 0.1], [2, 1, 1.5]), random_quat(rng)
        poison(sensor)
        sensor.render([2])
        assert np.isinf(sensor.range.numpy()[[0, 1, 3]]).all(), "environments that were not asked for were written"
        if sensor.ok.numpy()[2]:
            seen += check_env(sensor, 2, oracle, row, device == "depth")
    assert seen > 2000


SHAPES = st.sampled_from([PLANE, SPHERE, CAPSULE, CYLINDER, BOX, MESH])


@settings(max_examples=40, deadline=None)
@given(kinds=st.lists(SHAPES, min_size=1, max_size=5), seed=st.integers(0, 2**31), bounded=st.booleans())
def test_each_shape_matches_mujoco_from_outside(kinds, seed, bounded):
    rng, meshes = np.random.default_rng(seed), sample_meshes(0)
    row = Instances.empty(len(kinds))
    for i, kind in enumerate(kinds):
        row.type[i], row.mesh[i], row.id[i] = kind, rng.integers(len(meshes)) if kind == MESH else -1, i
        row.size[i] = rng.uniform(0.02, 0.6, 3)
        if kind == PLANE and not bounded:
            row.size[i] = 0.0
        row.pos[i], row.quat[i] = rng.uniform(-1.0, 1.0, 3), random_quat(rng)
        row.color[i] = rng.uniform(0, 1, 3)
    scene = RayScene(1, 0, len(kinds), meshes)
    scene.update_envs([0], row)
    oracle = MujocoScene(row, meshes)
    oracle.place(np.zeros((0, 3)), np.zeros((0, 4)))
    sensor = DepthCamera(DepthConfig(width=30, height=30, min_range=0.0, max_range=8.0), scene)
    sensor.pos.numpy()[0], sensor.quat.numpy()[0] = rng.uniform(-1.5, 1.5, 3), random_quat(rng)
    poison(sensor)
    sensor.render()
    if sensor.ok.numpy()[0]:
        # Here every plane may be seen at a grazing angle; only what is not is compared in range.
        planes = [k for k, kind in enumerate(kinds) if kind == PLANE]
        R_WS = quat_to_mat(sensor.true_quat.numpy()[0].astype(float))
        dist, inst = oracle.cast(sensor.true_pos.numpy()[0].astype(float), sensor.table.rays[0] @ R_WS.T)
        got, got_inst = sensor.true_range.numpy()[0], sensor.true_instance.numpy()[0]
        reach = (dist >= 0) & (dist < 8.0)
        assert (reach != ((got >= 0) & (got < 8.0))).sum() <= 1
        same = reach & (inst == got_inst)
        assert (reach & ~same).sum() <= 1
        slack = np.ones(len(dist))
        for k in planes:
            normal = quat_to_mat(row.quat[k].astype(float))[:, 2]
            slack[inst == k] = np.maximum(np.abs(sensor.table.rays[0] @ R_WS.T @ normal)[inst == k], 1e-9)
        slack[slack > GRAZING] = 1.0
        assert (np.abs(got - dist)[same] * slack[same]).max(initial=0.0) <= TOLERANCE


def test_any_bundle_size_gives_the_same_hits(world):
    _, scene, _, rng = world
    rays = pinhole_rays(33, 21, 87.0, 58.0)[None]
    pos, quat = np.array([0.2, 0.1, 1.1]), random_quat(rng)
    found = []
    for bundle in (1, 7, 64, 1000):
        sensor = RaySensor(scene, rays, 0.0, 5.0, bundle=bundle)
        sensor.pos.numpy()[:], sensor.quat.numpy()[:] = pos, quat
        sensor.render([1])
        found.append((sensor.true_range.numpy()[1], sensor.true_instance.numpy()[1]))
    for ranges, instances in found[1:]:
        np.testing.assert_array_equal(ranges, found[0][0])
        np.testing.assert_array_equal(instances, found[0][1])


def test_three_kernels_and_one_agree_to_the_bit(world):
    """A GPU takes the three steps apart, a CPU takes an environment through all of them in shared memory."""
    _, scene, _, rng = world
    rays = scan_rays(LidarConfig(num_rays=500))
    pos, quat = rng.uniform([-1, -1, 0.3], [0.3, 1, 1.5], (4, 3)), [random_quat(rng) for _ in range(4)]
    found = []
    for keep in (False, True):
        sensor = RaySensor(scene, rays, 0.0, 8.0, keep_slots=keep)
        sensor.pos.assign(pos.astype(np.float32))
        sensor.quat.assign(np.array(quat, np.float32))
        sensor.step.assign(np.array([0, 5, 9, 2]))
        poison(sensor)
        sensor.trace(sensor.env_index(None))
        if keep:
            at_once = sensor.true_range.numpy().copy(), sensor.true_instance.numpy().copy()
            poison(sensor)
            sensor._cast_in_steps(sensor.env_index(None))
            found.append(at_once)
        found.append((sensor.true_range.numpy(), sensor.true_instance.numpy()))
    assert (found[0][1] >= 0).sum() > 500
    for ranges, instances in found[1:]:
        np.testing.assert_array_equal(ranges, found[0][0])
        np.testing.assert_array_equal(instances, found[0][1])


@settings(max_examples=30, deadline=None)
@given(num=st.integers(1, 300), bundle=st.integers(1, 70), seed=st.integers(0, 1000))
def test_bundles_hold_every_ray_once_inside_its_cone(num, bundle, seed):
    rays = np.random.default_rng(seed).normal(size=(2, num, 3))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    part = common_part(bundle)
    table = build_table(rays, bundle, part)
    for pattern in range(2):
        np.testing.assert_array_equal(np.sort(table.order[pattern]), np.arange(num))
        for k, ray in enumerate(table.order[pattern]):
            for cones, size in (
                (table.cone, bundle),
                (table.part_cone, part),
                (table.subgroup_cone, bundle * SUBGROUP),
                (table.group_cone, bundle * GROUP),
            ):
                cone = cones[pattern, k // size]
                assert rays[pattern, ray] @ cone[:3] >= cone[3]


def test_lidar_scan_follows_the_two_axes():
    """Ray k of step s against `R_z(2 pi 5.55 t) (cos a, 0, sin a)` at absolute time, a from the 216 Hz sweep."""
    scene = RayScene(3, 0, 0)
    lidar = Lidar(LidarConfig(num_rays=301), scene)
    steps = np.array([0, 13, 4321])
    lidar.step.assign(steps)
    lidar.render()
    for env, step in enumerate(steps):
        rot = quat_to_mat(lidar.true_quat.numpy()[env].astype(float))
        rays = lidar.table.rays[lidar.pattern.numpy()[env]] @ rot.T
        time = (step + (np.arange(301) + 0.5) / 301) / 25.0
        alpha = np.radians(-6.0 + 192.0 * (216.0 * time % 1.0))
        theta = 2 * np.pi * 5.55 * time
        want = np.stack([np.cos(alpha) * np.cos(theta), np.cos(alpha) * np.sin(theta), np.sin(alpha)], axis=1)
        assert np.abs(rays - want).max() < 2e-5
    elevation = np.degrees(np.arcsin(scan_rays(LidarConfig(num_rays=2592))[..., 2]))
    assert elevation.min() >= -6.0001
    assert elevation.min() < -5.0
    assert elevation.max() > 89.0


def test_camera_covers_its_field_of_view():
    rays = pinhole_rays(848, 480, 87.0, 58.0).reshape(480, 848, 3)
    half_pixel = np.degrees(np.arctan(np.tan(np.radians(43.5)) * (1 - 1 / 848)))
    assert np.isclose(np.degrees(np.arctan2(rays[0, -1, 0], rays[0, -1, 2])), half_pixel)
    assert rays[0, 0, 0] < 0 < rays[0, -1, 0]
    assert rays[0, 0, 1] < 0 < rays[-1, 0, 1]


def test_a_grid_that_is_denser_in_the_middle_covers_the_same_field():
    even, dense = (pinhole_rays(80, 60, 87.0, 58.0, c).reshape(60, 80, 3) for c in (1.0, 0.35))
    assert np.isclose(
        dense[30, 40:42, 0] / dense[30, 40:42, 2], 0.35 * even[30, 40:42, 0] / even[30, 40:42, 2], rtol=0.02
    ).all()
    assert np.abs(dense[0, 0] - even[0, 0]).max() < 0.02
    areas = pixel_areas(80, 60, 0.35)
    assert areas.sum() == pytest.approx(80 * 60, rel=2e-3) and areas.reshape(60, 80)[30, 40] == pytest.approx(
        0.35**2, rel=0.02
    )
    # a round target in the middle counts as many pixels of an even grid whichever grid sees it
    inside = [(np.arccos(grid[..., 2]) < 0.2).ravel() for grid in (even, dense)]
    assert areas[inside[1]].sum() == pytest.approx(inside[0].sum(), rel=0.05)


def test_excluded_body_is_not_seen():
    row = Instances.empty(2)
    row.type[:], row.size[:] = SPHERE, 0.2
    row.body[:] = [0, 1]
    scene = RayScene(1, 2, 2)
    scene.update_envs([0], row)
    scene.body_pos.assign(np.array([[[0, 0, 0], [0, 0, 1]]], np.float32))
    for exclude, seen in ((0, 1), (-1, None)):
        camera = DepthCamera(DepthConfig(width=9, height=9), scene, exclude_body=exclude)
        camera.render()
        if seen is None:
            # The camera stands inside body 0.
            assert camera.ok.numpy()[0] == 0
            assert not camera.valid.numpy().any()
        else:
            assert camera.instance.numpy()[0, 40] == seen
            assert np.isclose(camera.depth.numpy()[0, 40], 0.8, atol=1e-6)


def finite(sensor) -> bool:
    return all(np.isfinite(getattr(sensor, n).numpy()).all() for n in ("range", "depth", "color", "point_s", "point_w"))


@pytest.mark.parametrize("bad", ["pos", "quat", "zero_quat", "body_pos", "body_quat"])
def test_poses_that_are_not_finite_give_invalid_returns(bad):
    row = Instances.empty(1)
    row.type[0], row.size[0], row.body[0], row.id[0] = BOX, 0.2, 0, Semantic.TARGET
    scene = RayScene(2, 1, 1)
    scene.update_envs([0, 1], row)
    scene.body_pos.numpy()[:, 0] = (0, 0, 1)
    for sensor in (DepthCamera(DepthConfig(), scene), Lidar(LidarConfig(min_elevation_deg=-90), scene)):
        scene.body_pos.numpy()[:, 0] = (0, 0, 1)
        scene.body_quat.numpy()[:, 0] = (1, 0, 0, 0)
        if bad == "zero_quat":
            sensor.quat.numpy()[0] = 0
        elif bad.startswith("body"):
            getattr(scene, bad).numpy()[0, 0, 1] = np.nan
        else:
            getattr(sensor, bad).numpy()[0, 1] = np.nan
        sensor.render()
        assert list(sensor.ok.numpy()) == [0, 1]
        assert not sensor.valid.numpy()[0].any()
        assert sensor.valid.numpy()[1].any()
        assert finite(sensor)


@pytest.mark.parametrize("kind", [PLANE, SPHERE, CAPSULE, CYLINDER, BOX, MESH])
def test_camera_inside_an_object_sees_nothing(kind):
    row = Instances.empty(1)
    row.type[0], row.size[0], row.mesh[0] = kind, (0.3, 0.3, 0.3), 0
    if kind == PLANE:
        row.size[0], row.pos[0] = 0.0, (0, 0, 0.1)
    scene = RayScene(1, 0, 1, [(np.asarray(v) * 5, f) for v, f in sample_meshes(2)[:1]])
    scene.update_envs([0], row)
    camera = DepthCamera(DepthConfig(min_range=0.0), scene)
    camera.render()
    assert camera.ok.numpy()[0] == 0
    assert not camera.valid.numpy().any()
    assert finite(camera)


@pytest.mark.parametrize(("envs", "instances"), [(0, 3), (2, 0), (0, 0)])
def test_empty_scenes_render(envs, instances):
    scene = RayScene(envs, 0, instances)
    for sensor in (DepthCamera(DepthConfig(width=5, height=4), scene), Lidar(LidarConfig(num_rays=7), scene)):
        poison(sensor)
        sensor.render()
        sensor.render([])
        assert sensor.valid.shape == (envs, sensor.num_rays)
        assert not sensor.valid.numpy().any()
        assert (sensor.range.numpy() == -1).all()


def test_bad_input_is_refused_in_one_line():
    scene = RayScene(2, 1, 1)
    row = Instances.empty(1)
    row.type[0] = BOX
    cases = [
        (lambda: RayScene(-1, 0, 0), "num_envs"),
        (lambda: RayScene(1, 1, 1, body_pos=wp.zeros((2, 2), dtype=wp.vec3)), "body_pos"),
        (lambda: scene.update_envs([2], row), "outside 0..1"),
        (lambda: scene.update_envs([0, 1], [row]), "1 sets"),
        (lambda: scene.update_envs([0], Instances.empty(2)), "raise num_instances"),
        (lambda: scene.update_envs([0], Instances(**vars(row) | {"body": np.array([1])})), "body index"),
        (lambda: scene.update_envs([0], Instances(**vars(row) | {"type": np.array([7])})), "mesh index"),
        (lambda: scene.update_envs([0], Instances(**vars(row) | {"type": np.array([4])})), "types"),
        (lambda: scene.add_meshes([(np.zeros((3, 3)), np.zeros((0, 3)))]), "no faces"),
        (lambda: DepthCamera(DepthConfig(), scene).render([5]), "outside 0..1"),
        (lambda: DepthConfig(width=0), "width"),
        (lambda: LidarConfig(min_range=2, max_range=1), "min_range"),
    ]
    for call, words in cases:
        with pytest.raises(ValueError, match=words) as caught:
            call()
        assert "\n" not in str(caught.value)
    assert (scene.type.numpy() == UNUSED).all()

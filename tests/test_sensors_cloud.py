"""Cloud assembly against a NumPy selection of the same scan; points must be bit-equal, frames to 1e-6 m."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from wbm.robot.model import load_robot
from wbm.robot.rotations import quat_to_mat
from wbm.sensors.bench_scene import robot_bodies, sample_meshes, tabletop, viewpoint
from wbm.sensors.cloud import PointCloud
from wbm.sensors.config import CloudConfig, DelayConfig, DepthConfig
from wbm.sensors.depth import DepthCamera
from wbm.sensors.scene import RayScene, Semantic


@pytest.fixture(scope="module")
def camera():
    rng, robot, meshes = np.random.default_rng(0), load_robot(), sample_meshes(2)
    scene = RayScene(3, len(robot.link_names), 60, meshes)
    out = DepthCamera(DepthConfig(width=64, height=48), scene)
    for env in range(3):
        row, height = tabletop(rng, 60, 4, len(meshes))
        scene.update_envs([env], row)
        scene.body_pos.numpy()[env], scene.body_quat.numpy()[env] = robot_bodies(robot.q_home)
        out.pos.numpy()[env], out.quat.numpy()[env] = viewpoint(rng, height)
    out.render()
    return out


def eligible(camera, cloud, env):
    """Base-frame points of the scan and the masks of target and other points that may be drawn."""
    c = cloud.config
    rot = quat_to_mat(cloud.base_quat.numpy()[env].astype(float))
    points = (camera.point_w.numpy()[env] - cloud.base_pos.numpy()[env]) @ rot
    ids = camera.id.numpy()[env]
    ok = camera.valid.numpy()[env] & (points >= c.crop_min).all(1) & (points <= c.crop_max).all(1)
    if c.self_filter:
        ok &= ids != Semantic.ROBOT
    return points, ok & (ids == Semantic.TARGET), ok & (ids != Semantic.TARGET)


@settings(max_examples=40, deadline=None)
@given(
    num=st.integers(1, 400),
    share=st.floats(0, 1),
    self_filter=st.booleans(),
    crop=st.floats(0.2, 2.0),
    seed=st.integers(0, 50),
    step=st.integers(0, 100),
)
def test_counts_membership_and_frame(camera, num, share, self_filter, crop, seed, step):
    config = CloudConfig(
        num_points=num,
        target_share=share,
        self_filter=self_filter,
        crop_min=(0.0, -2.0, 0.1),
        crop_max=(crop, 2.0, 2.0),
    )
    cloud = PointCloud(config, camera, seed=seed)
    camera.step.fill_(step)
    half = 0.35
    cloud.base_pos.numpy()[:] = (0.1, -0.05, 0.02)
    cloud.base_quat.numpy()[:] = (np.cos(half), 0, 0, np.sin(half))
    cloud.xyz.fill_(wp.vec3(np.inf, np.inf, np.inf))
    cloud.assemble()
    for env in range(3):
        points, on_target, other = eligible(camera, cloud, env)
        quota = min(on_target.sum(), int(share * num))
        rest = min(other.sum(), num - quota)
        quota = min(on_target.sum(), num - rest)
        valid, target = cloud.valid.numpy()[env], cloud.target.numpy()[env]
        # A point on the crop's border may fall to either side in float32.
        assert abs(int((valid & target).sum()) - quota) <= 1
        assert abs(int((valid & ~target).sum()) - rest) <= 1
        assert not (~valid[:-1] & valid[1:]).any()
        xyz = cloud.xyz.numpy()[env]
        assert (xyz[~valid] == 0).all()
        assert (cloud.id.numpy()[env][~valid] == -1).all()
        if valid.any():
            pool = np.flatnonzero(on_target | other)
            gap = np.abs(xyz[valid][:, None] - points[pool][None]).max(-1)
            drawn = pool[gap.argmin(1)]
            assert gap.min(1).max() < 1e-5
            assert len(np.unique(drawn)) == valid.sum()
            np.testing.assert_array_equal(cloud.id.numpy()[env][valid], camera.id.numpy()[env][drawn])
            np.testing.assert_array_equal(cloud.rgb.numpy()[env][valid], camera.color.numpy()[env][drawn])
            np.testing.assert_array_equal(
                cloud.robot.numpy()[env][valid], camera.id.numpy()[env][drawn] == Semantic.ROBOT
            )


def test_drawing_is_uniform_within_each_class(camera):
    cloud = PointCloud(CloudConfig(num_points=100, target_share=0.1), camera, seed=3)
    counts = np.zeros(camera.num_rays)
    rounds = 400
    for step in range(rounds):
        camera.step.fill_(step)
        cloud.assemble([0])
        _, on_target, other = eligible(camera, cloud, 0)
        xyz = cloud.xyz.numpy()[0]
        index = {p.tobytes(): k for k, p in enumerate(camera.point_w.numpy()[0])}
        for p in xyz:
            counts[index[p.tobytes()]] += 1
    for mask, num in ((on_target, 10), (other, 90)):
        assert counts[mask].sum() == rounds * num
        # Chi-square per degree of freedom of equal chances; its deviation is sqrt(2 / dof), below 0.1 here.
        mean = rounds * num / mask.sum()
        spread = ((counts[mask] - mean) ** 2).mean() / (mean * (1 - num / mask.sum()))
        assert 0.6 < spread < 1.4


def test_late_clouds_keep_their_frame_and_reset_forgets(camera):
    config = CloudConfig(num_points=64, delay=DelayConfig(2, 2))
    late, now = PointCloud(config, camera, seed=1), PointCloud(CloudConfig(num_points=64), camera, seed=1)
    history = []
    for step in range(5):
        camera.step.fill_(step)
        for cloud in (late, now):
            cloud.base_pos.numpy()[:] = (0.01 * step, 0, 0)
            cloud.assemble()
        history.append((now.xyz.numpy().copy(), now.target.numpy().copy(), now.id.numpy().copy()))
        past = history[max(step - 2, 0)]
        for got, want in zip((late.xyz, late.target, late.id), past, strict=True):
            np.testing.assert_array_equal(got.numpy(), want)
        assert (late.age.numpy() == min(step, 2)).all()
    late.reset([1])
    camera.step.fill_(77)
    for cloud in (late, now):
        cloud.assemble()
    np.testing.assert_array_equal(late.xyz.numpy()[1], now.xyz.numpy()[1])
    np.testing.assert_array_equal(late.xyz.numpy()[0], history[3][0][0])
    assert list(late.age.numpy()) == [2, 0, 2]


def test_a_base_pose_that_is_not_finite_gives_no_points(camera):
    cloud = PointCloud(CloudConfig(num_points=32), camera)
    cloud.base_pos.numpy()[1, 0] = np.nan
    cloud.assemble()
    assert not cloud.valid.numpy()[1].any()
    assert cloud.valid.numpy()[0].all()
    assert np.isfinite(cloud.xyz.numpy()).all()


def test_an_empty_scan_gives_an_invalid_cloud():
    sensor = DepthCamera(DepthConfig(width=4, height=4), RayScene(2, 0, 0))
    cloud = PointCloud(CloudConfig(num_points=8), sensor)
    sensor.render()
    cloud.xyz.fill_(wp.vec3(np.inf, np.inf, np.inf))
    cloud.valid.fill_(True)
    cloud.assemble()
    assert not cloud.valid.numpy().any()
    assert (cloud.xyz.numpy() == 0).all()

"""Ray routine against `mj_multiRay`. Tolerance: 1e-4 m in range (float32 kernels against float64 MuJoCo).

A ray that grazes the floor far away is its horizon, a silhouette: a float32 direction is wrong by 1e-7, the range by
`t / sin(incidence)` times that. Incidences below 3 degrees are left out of the largest error.
"""

import numpy as np
import pytest
from sensors_model import OracleModel, primitive_meshes, random_quat

from wbm.robot.model import load_robot
from wbm.sensors.config import DepthConfig, LidarConfig
from wbm.sensors.depth import DepthCamera
from wbm.sensors.lidar import Lidar
from wbm.sensors.scene import RayScene

TOLERANCE = 1e-4
GRAZING = np.sin(np.radians(3.0))


def quat_mat(q):
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@pytest.fixture(scope="module")
def oracle():
    rng = np.random.default_rng(3)
    om = OracleModel(rng, 16, primitive_meshes(1), 4)
    robot = load_robot()
    scene = RayScene(4, len(robot.link_names), len(om.instances.type), om.meshes())
    return om, scene, rng


def compare(om, sensor, scene, rng, camera: bool):
    robot, seen = om.robot, 0
    for _ in range(6):
        q = rng.uniform(np.maximum(robot.q_min, -1.0), np.minimum(robot.q_max, 1.0))
        om.pose(scene, 2, q)
        pos, quat = rng.uniform([-2, -2, 0.1], [2, 2, 1.5]), random_quat(rng)
        sensor.pos.numpy()[2], sensor.quat.numpy()[2] = pos, quat
        sensor.range.fill_(np.inf)
        sensor.render([2])
        if sensor.ok.numpy()[2] == 0:
            continue
        R_WS = quat_mat(sensor.true_quat.numpy()[2].astype(float))
        rays_s = sensor.table.rays[sensor.pattern.numpy()[2]]
        dist, geom = om.rays(sensor.true_pos.numpy()[2].astype(float), rays_s @ R_WS.T)
        measured = dist * rays_s[:, 2] if camera else dist
        want = (dist >= 0) & (measured >= sensor.min_range) & (measured <= sensor.max_range)
        valid, got = sensor.valid.numpy()[2], sensor.range.numpy()[2]
        assert (want != valid).sum() <= 1
        both = want & valid
        same = both & (geom == sensor.instance.numpy()[2])
        assert (both & ~same).sum() <= 1
        same &= (geom != 0) | (np.abs(rays_s @ R_WS[2]) > GRAZING)
        assert np.abs(got[same] - dist[same]).max(initial=0.0) <= TOLERANCE
        assert (got[~valid] == -1.0).all()
        world = pos + dist[same, None] * (rays_s[same] @ R_WS.T)
        assert np.abs(sensor.point_w.numpy()[2][same] - world).max() <= TOLERANCE
        frame = (world - pos) @ quat_mat(quat)
        assert np.abs(sensor.point_s.numpy()[2][same] - frame).max() <= TOLERANCE
        assert (sensor.id.numpy()[2][same] == om.instances.id[geom[same]]).all()
        np.testing.assert_array_equal(sensor.color.numpy()[2][same], om.instances.color[geom[same]])
        seen += same.sum()
    assert seen > 1000


def test_depth_matches_mujoco(oracle):
    om, scene, rng = oracle
    compare(om, DepthCamera(DepthConfig(width=48, height=36), scene), scene, rng, camera=True)


def test_lidar_matches_mujoco(oracle):
    om, scene, rng = oracle
    lidar = Lidar(LidarConfig(num_rays=1000), scene)
    lidar.step.numpy()[:] = [0, 3, 777, 12]
    compare(om, lidar, scene, rng, camera=False)

"""Benchmark of the sensors: exactness and speed beside `mj_multiRay` and, when installed, mujoco-lidar and embreex."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from wbm.robot.facts import quat_to_mat
from wbm.robot.model import load_robot
from wbm.sensors import bench_peers
from wbm.sensors.bench_scene import robot_bodies, sample_meshes, sensor_pose, tabletop, viewpoint
from wbm.sensors.config import DepthConfig, LidarConfig
from wbm.sensors.depth import DepthCamera
from wbm.sensors.lidar import Lidar
from wbm.sensors.oracle import MujocoScene
from wbm.sensors.ray_sensor import RaySensor
from wbm.sensors.scene import Instances, RayScene

SIZES = (48, 56, 128, 256)
NUM_MESHES = 4
SILHOUETTE = 1e-6  # rad; a float32 direction is worth about 1e-7
TOLERANCE = 1e-4  # m


@dataclass
class Setup:
    """Random scenes of one size with both sensors posed in them."""

    rows: list[Instances]
    meshes: list[tuple[np.ndarray, np.ndarray]]
    scene: RayScene
    camera: DepthCamera
    lidar: Lidar

    def oracle(self, env: int) -> MujocoScene:
        """The scene of one environment as MuJoCo sees it."""
        out = MujocoScene(self.rows[env], self.meshes)
        out.place(self.scene.body_pos.numpy()[env], self.scene.body_quat.numpy()[env])
        return out


def make_setup(
    seed: int,
    num_envs: int,
    num_instances: int,
    depth: DepthConfig,
    lidar: LidarConfig,
    detail: int,
    random_robot: bool,
) -> Setup:
    """Scenes with the camera looking at the table and the LiDAR on the base."""
    rng, robot = np.random.default_rng(seed), load_robot()
    meshes = sample_meshes(detail)
    scene = RayScene(num_envs, len(robot.link_names), num_instances, meshes)
    out = Setup(
        [],
        meshes,
        scene,
        DepthCamera(depth, scene, exclude_body=robot.frames["camera"].link),
        Lidar(lidar, scene, exclude_body=robot.frames["lidar"].link),
    )
    for env in range(num_envs):
        row, height = tabletop(rng, num_instances, NUM_MESHES, len(meshes))
        q = robot.q_home.copy()
        if random_robot:
            q = rng.uniform(robot.q_min, robot.q_max)
            q[:3] = rng.uniform([-0.3, -0.3, -0.5], [0.1, 0.3, 0.5])
        out.rows.append(row)
        scene.body_pos.numpy()[env], scene.body_quat.numpy()[env] = robot_bodies(q)
        out.camera.pos.numpy()[env], out.camera.quat.numpy()[env] = viewpoint(rng, height)
        out.lidar.pos.numpy()[env], out.lidar.quat.numpy()[env] = sensor_pose("lidar", q)
        out.lidar.step.numpy()[env] = rng.integers(1000) if random_robot else 0
    scene.update_envs(np.arange(num_envs), out.rows)
    return out


def compare(setup: Setup, env: int, oracle: MujocoScene, sensor: RaySensor) -> dict[str, float]:
    """Differences between a rendered sensor and `mj_multiRay` in one environment.

    A ray lies at a silhouette if MuJoCo itself answers otherwise (another geom, or a range that moves by more than
    the tolerance) when the ray turns by `SILHOUETTE`.
    """
    if sensor.ok.numpy()[env] == 0:
        return {"rays": 0, "mismatches": 0, "unexplained": 0, "error": 0.0, "error_all": 0.0, "silhouettes": 0}
    rot = quat_to_mat(sensor.true_quat.numpy()[env].astype(float))
    origin = sensor.true_pos.numpy()[env].astype(float)
    rays = sensor.rays.numpy()[sensor.pattern.numpy()[env]].astype(float)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ rot.T
    want, want_inst = oracle.cast(origin, rays, sensor.exclude_body)
    got, got_inst = sensor.true_range.numpy()[env], sensor.true_instance.numpy()[env]
    # Beyond the sensor's reach nothing is traced.
    beyond = want > sensor.reach
    want, want_inst = np.where(beyond, -1.0, want), np.where(beyond, -1, want_inst)
    differs = want_inst != got_inst
    error = np.where(differs | (want_inst < 0), 0.0, np.abs(want - got))
    suspects = np.flatnonzero(differs | (error > TOLERANCE / 10))
    soft = np.zeros(len(rays), bool)
    for shift in (np.eye(3)[a] * s * SILHOUETTE for a in range(3) for s in (-1, 1)):
        turned = rays[suspects] + shift
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
        near, near_inst = oracle.cast(origin, turned, sensor.exclude_body)
        near_inst = np.where(near > sensor.reach, -1, near_inst)
        soft[suspects] |= near_inst != want_inst[suspects]
        soft[suspects] |= (want_inst[suspects] >= 0) & (np.abs(near - want[suspects]) > TOLERANCE)
    return {
        "rays": len(rays),
        "mismatches": int(differs.sum()),
        "unexplained": int((differs & ~soft).sum()),
        "error": float(error[~soft].max(initial=0.0)),
        "error_all": float(error.max()),
        "silhouettes": int(soft.sum()),
    }


def measure_exactness(num_scenes: int, num_rays: int, seed: int = 0) -> dict[str, Any]:
    """Compare `num_rays` rays, half from each sensor, over random scenes with random robot poses."""
    side = int(np.ceil(np.sqrt(num_rays / num_scenes / 2)))
    depth, lidar = DepthConfig(width=side, height=side), LidarConfig(num_rays=side * side)
    setup = make_setup(seed, num_scenes, 56, depth, lidar, 3, random_robot=True)
    setup.camera.render()
    setup.lidar.render()
    found = []
    for env in range(num_scenes):
        oracle = setup.oracle(env)
        found += [compare(setup, env, oracle, sensor) for sensor in (setup.camera, setup.lidar)]
    return {
        "rays_compared": sum(f["rays"] for f in found),
        "scenes_compared": num_scenes,
        "max_abs_error_m": max(f["error"] for f in found),
        "max_abs_error_with_silhouettes_m": max(f["error_all"] for f in found),
        "rays_at_silhouettes": sum(f["silhouettes"] for f in found),
        "id_mismatches": sum(f["mismatches"] for f in found),
        "id_mismatches_unexplained": sum(f["unexplained"] for f in found),
    }


def rate(work: Callable[[], Any], num_rays: int, repeats: int) -> float:
    """Median million rays per second of CPU time on this process."""
    work()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return num_rays / max(float(np.median(times)), 1e-9) / 1e6


def measure_speed(num_instances: int, num_envs: int, repeats: int, peers: bool, seed: int = 1) -> dict[str, Any]:
    """Rates of both sensors, of `mj_multiRay` and of the peers over the same scenes and rays (64 x 48 and 2,048)."""
    depth, lidar = DepthConfig(width=64, height=48), LidarConfig(num_rays=2048)
    setup = make_setup(seed, num_envs, num_instances, depth, lidar, 4, random_robot=False)
    out: dict[str, Any] = {"instances": num_instances}
    oracles = [setup.oracle(env) for env in range(min(num_envs, 8))]
    for name, sensor in (("depth", setup.camera), ("lidar", setup.lidar)):
        every = sensor.env_index(None)
        total = num_envs * sensor.num_rays
        out[f"{name}_mrays_s"] = rate(sensor.render, total, repeats)
        out[f"{name}_range_only_mrays_s"] = rate(lambda s=sensor, e=every: s.trace(e), total, repeats)
        rays, origins = bench_peers.world_rays(sensor, len(oracles))

        def cast(sensor: RaySensor = sensor, rays: np.ndarray = rays, origins: np.ndarray = origins) -> None:
            for oracle, ray, origin in zip(oracles, rays, origins, strict=True):
                oracle.cast(origin, ray, sensor.exclude_body)

        out[f"mj_multiray_{name}"] = rate(cast, len(oracles) * sensor.num_rays, max(repeats // 2, 1))
        out[f"{name}_speedup"] = out[f"{name}_mrays_s"] / out[f"mj_multiray_{name}"]
        if peers:
            for peer, work in bench_peers.workloads(oracles, sensor, setup.meshes).items():
                out[f"{peer}_{name}"] = rate(work, len(oracles) * sensor.num_rays, max(repeats // 2, 1))
    return out


def bench_sensors(
    num_scenes: int = 200, num_rays: int = 1_000_000, repeats: int = 9, peers: bool = True
) -> dict[str, Any]:
    """Everything that `wbm bench sensors` reports; rates are million rays per second of CPU time on one thread.

    Args:
        num_scenes, num_rays: size of the comparison with `mj_multiRay`.
        repeats: timings of which the median counts.
        peers: also time mujoco-lidar and embreex when they are installed.
    """
    wp.config.quiet = True
    scaling = [measure_speed(size, 32, repeats, peers and size == 56) for size in SIZES]
    typical = next(row for row in scaling if row["instances"] == 56)
    keys = ("depth_mrays_s", "lidar_mrays_s", "mj_multiray_depth", "mj_multiray_lidar")
    out = {key: typical[key] for key in keys}
    out |= {key: value for key, value in typical.items() if key not in out and key != "instances"}
    return out | measure_exactness(num_scenes, num_rays) | {"instances_scaling": scaling}

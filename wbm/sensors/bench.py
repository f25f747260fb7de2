"""Benchmark of the sensors: exactness and speed beside `mj_multiRay` and, when installed, mujoco-lidar and embreex."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from wbm.robot.model import load_robot
from wbm.robot.rotations import quat_to_mat
from wbm.scenes.bank import SceneBank
from wbm.scenes.objects import ObjectSet
from wbm.sensors import bench_peers
from wbm.sensors.bench_scene import robot_bodies, sample_meshes, sensor_pose, tabletop, viewpoint
from wbm.sensors.config import DepthConfig, LidarConfig
from wbm.sensors.depth import DepthCamera
from wbm.sensors.instances import SceneInstances, hull_meshes
from wbm.sensors.lidar import Lidar
from wbm.sensors.oracle import MujocoScene
from wbm.sensors.poses import look_at
from wbm.sensors.ray_sensor import RaySensor
from wbm.sensors.scene import Instances, RayScene

SIZES = (48, 56, 128, 256)
TYPICAL = 56
NUM_MESHES = 4
SILHOUETTE = 1e-6  # rad; a float32 direction is worth about 1e-7
TOLERANCE = 1e-4  # m
TIE = 1e-6  # m


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


def make_asset_setup(seed: int, objects: ObjectSet, bank: SceneBank, num_envs: int, side: int) -> Setup:
    """Scenes of an assets artifact, those with mesh targets first, the robot in random poses before them."""
    rng, robot = np.random.default_rng(seed), load_robot()
    builder, meshes = SceneInstances(robot, objects, bank), hull_meshes(objects)
    order = rng.permutation(len(bank))
    order = order[np.argsort(~objects.has_mesh()[bank.object[order, 0]], kind="stable")]
    scene = RayScene(num_envs, builder.num_bodies, builder.count, meshes)
    out = Setup(
        [],
        meshes,
        scene,
        DepthCamera(DepthConfig(width=side, height=side), scene, exclude_body=robot.frames["camera"].link),
        Lidar(LidarConfig(num_rays=side * side), scene, exclude_body=robot.frames["lidar"].link),
    )
    first = builder.first_body
    for env in range(num_envs):
        k = int(order[env % len(order)])
        q = rng.uniform(robot.q_min, robot.q_max)
        q[:3] = bank.base_grasp[k] + rng.uniform([-0.5, -0.5, -0.5], [0.2, 0.5, 0.5])
        out.rows.append(builder.of_scene(k))
        pos, quat = robot_bodies(q)
        scene.body_pos.numpy()[env, :first], scene.body_quat.numpy()[env, :first] = pos, quat
        scene.body_pos.numpy()[env, first:] = bank.object_pos[k]
        scene.body_quat.numpy()[env, first:] = bank.object_quat[k]
        target = bank.object_pos[k, 0]
        eye = target + rng.uniform([-0.6, -0.6, 0.15], [0.6, 0.6, 0.6])
        out.camera.pos.numpy()[env], out.camera.quat.numpy()[env] = (
            eye,
            look_at(eye, target + rng.uniform(-0.1, 0.1, 3)),
        )
        out.lidar.pos.numpy()[env], out.lidar.quat.numpy()[env] = sensor_pose("lidar", q)
        out.lidar.step.numpy()[env] = rng.integers(1000)
    scene.update_envs(np.arange(num_envs), out.rows)
    return out


def compare(setup: Setup, env: int, oracle: MujocoScene, sensor: RaySensor) -> dict[str, float]:
    """Differences between a rendered sensor and `mj_multiRay` in one environment.

    A ray lies at a silhouette if MuJoCo itself answers otherwise (another geom, or a range that moves by more than
    the tolerance) when the ray turns by `SILHOUETTE`.
    """
    if sensor.ok.numpy()[env] == 0:
        return dict.fromkeys(("rays", "mismatches", "ties", "unexplained", "silhouettes"), 0) | {
            "error": 0.0,
            "error_all": 0.0,
        }
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
    # Where two parts cross, both sides may name either.
    tie = differs & (want_inst >= 0) & (got_inst >= 0) & (np.abs(want - got) < TIE)
    return {
        "rays": len(rays),
        "mismatches": int(differs.sum()),
        "ties": int(tie.sum()),
        "unexplained": int((differs & ~soft & ~tie).sum()),
        "error": float(error[~soft].max(initial=0.0)),
        "error_all": float(error.max()),
        "silhouettes": int(soft.sum()),
    }


def measure_exactness(
    num_scenes: int, num_rays: int, assets: tuple[ObjectSet, SceneBank] | None = None, seed: int = 0
) -> dict[str, Any]:
    """Compare at least `num_rays` rays, half from each sensor, over random scenes with random robot poses.

    Scenes come from `assets` (objects and bank) if they are given, else from the benchmark's own generator. A sensor
    that happens to stand inside an object is left out, which the twentieth of spare rays makes up for.
    """
    side = int(np.ceil(np.sqrt(1.05 * num_rays / num_scenes / 2)))
    if assets is not None:
        setup = make_asset_setup(seed, *assets, num_scenes, side)
    else:
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
        "id_mismatches_where_parts_cross": sum(f["ties"] for f in found),
        "id_mismatches_unexplained": sum(f["unexplained"] for f in found),
    }


@dataclass
class Workload:
    """Something to time: `run` casts `rays` rays; `best` is the least CPU time seen, s."""

    run: Callable[[], Any]
    rays: int
    best: float = np.inf

    @property
    def mrays_s(self) -> float:
        return self.rays / max(self.best, 1e-9) / 1e6


def speed_workloads(num_instances: int, num_envs: int, peers: bool, seed: int = 1) -> dict[str, Workload]:
    """Both sensors (64 x 48 and 2,048 rays), `mj_multiRay` and the peers over the same scenes and rays."""
    depth, lidar = DepthConfig(width=64, height=48), LidarConfig(num_rays=2048)
    setup = make_setup(seed, num_envs, num_instances, depth, lidar, 4, random_robot=False)
    oracles = [setup.oracle(env) for env in range(min(num_envs, 8))]
    out = {}
    for name, sensor in (("depth", setup.camera), ("lidar", setup.lidar)):
        sensor.render()
        few = len(oracles) * sensor.num_rays
        out[f"{name}_mrays_s"] = Workload(sensor.render, num_envs * sensor.num_rays)
        out[f"{name}_range_only_mrays_s"] = Workload(
            partial(sensor.trace, sensor.env_index(None)), num_envs * sensor.num_rays
        )
        rays, origins = bench_peers.world_rays(sensor, len(oracles))
        out[f"mj_multiray_{name}"] = Workload(
            partial(bench_peers.cast_all, oracles, rays, origins, sensor.exclude_body), few
        )
        if peers:
            for peer, work in bench_peers.workloads(oracles, sensor, setup.meshes).items():
                out[f"{peer}_{name}"] = Workload(work, few)
    return out


def measure_speed(sizes: tuple[int, ...], num_envs: int, rounds: int, peers: bool) -> list[dict[str, Any]]:
    """Million rays per second of CPU time on one thread for every number of instances; peers at `TYPICAL`.

    Rounds go over all workloads and the fastest time of each counts: other load on the machine only ever adds time, and
    all workloads meet the same load.
    """
    work = {size: speed_workloads(size, num_envs, peers and size == TYPICAL) for size in sizes}
    for turn in range(rounds + 1):
        for job in (job for jobs in work.values() for job in jobs.values()):
            start = time.process_time()
            job.run()
            # The first turn warms up.
            job.best = min(job.best, time.process_time() - start) if turn else np.inf
    out = []
    for size, jobs in work.items():
        row = {"instances": size} | {name: job.mrays_s for name, job in jobs.items()}
        for name in ("depth", "lidar"):
            row[f"{name}_speedup"] = row[f"{name}_mrays_s"] / row[f"mj_multiray_{name}"]
        out.append(row)
    return out


def bench_sensors(
    num_scenes: int = 200,
    num_rays: int = 1_000_000,
    rounds: int = 15,
    peers: bool = True,
    assets: tuple[ObjectSet, SceneBank] | None = None,
) -> dict[str, Any]:
    """Everything that `wbm bench sensors` reports; rates are million rays per second of CPU time on one thread.

    Args:
        num_scenes, num_rays: size of the comparison with `mj_multiRay`.
        rounds: timings of which the fastest counts.
        peers: also time mujoco-lidar and embreex when they are installed.
        assets: objects and scene bank of an assets artifact for the comparison; None uses generated table tops.
    """
    wp.config.log_level = wp.LOG_ERROR
    scaling = measure_speed(SIZES, 32, rounds, peers)
    typical = {k: v for k, v in next(row for row in scaling if row["instances"] == TYPICAL).items() if k != "instances"}
    return typical | measure_exactness(num_scenes, num_rays, assets) | {"instances_scaling": scaling}

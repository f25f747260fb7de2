"""The peers of the sensor benchmark, each over the same scenes and rays: mujoco-lidar (Warp) and embreex."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable

import numpy as np
import trimesh

from wbm.robot.rotations import quat_to_mat
from wbm.sensors.oracle import MujocoScene
from wbm.sensors.ray_sensor import RaySensor
from wbm.sensors.scene import BOX, CAPSULE, CYLINDER, PLANE, SPHERE

FLOOR_HALF = 50.0  # a tessellated plane needs an end, m


def world_rays(sensor: RaySensor, num_envs: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """World rays [R,3] and origin [3] of the first environments, as last rendered."""
    rays = sensor.rays.numpy().astype(float)
    pattern, quat = sensor.pattern.numpy(), sensor.true_quat.numpy().astype(float)
    origins = sensor.true_pos.numpy().astype(float)
    return [rays[pattern[e]] @ quat_to_mat(quat[e]).T for e in range(num_envs)], list(origins[:num_envs])


def cast_all(oracles: list[MujocoScene], rays: list[np.ndarray], origins: list[np.ndarray], exclude_body: int) -> None:
    """One pass of `mj_multiRay` over all scenes."""
    for oracle, ray, origin in zip(oracles, rays, origins, strict=True):
        oracle.cast(origin, ray, exclude_body)


def workloads(
    oracles: list[MujocoScene], sensor: RaySensor, meshes: list[tuple[np.ndarray, np.ndarray]]
) -> dict[str, Callable[[], None]]:
    """One pass over all scenes for each installed peer."""
    rays, origins = world_rays(sensor, len(oracles))
    out: dict[str, Callable[[], None]] = {}
    if importlib.util.find_spec("mujoco_lidar"):
        out["mujoco_lidar"] = _mujoco_lidar(oracles, rays, origins)
    if importlib.util.find_spec("embreex"):
        out["embreex"] = _embreex(oracles, rays, origins, meshes)
    return out


def _mujoco_lidar(oracles: list[MujocoScene], rays: list[np.ndarray], origins: list[np.ndarray]) -> Callable[[], None]:
    from mujoco_lidar.core_warp.mjlidar_warp import MjLidarWarp

    jobs = []
    for oracle, ray, origin in zip(oracles, rays, origins, strict=True):
        pose = np.eye(4)
        pose[:3, 3] = origin
        tracer = MjLidarWarp(oracle.model, cutoff_dist=30.0, geomgroup=None, bodyexclude=-1, device="cpu", use_bvh=True)
        jobs.append((tracer, oracle.data, pose, np.arctan2(ray[:, 1], ray[:, 0]), np.arcsin(ray[:, 2])))

    def work() -> None:
        for tracer, data, pose, theta, phi in jobs:
            tracer.update(data)
            tracer.trace_rays(pose, theta, phi)

    return work


def _embreex(
    oracles: list[MujocoScene],
    rays: list[np.ndarray],
    origins: list[np.ndarray],
    meshes: list[tuple[np.ndarray, np.ndarray]],
) -> Callable[[], None]:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    jobs = []
    for oracle, ray, origin in zip(oracles, rays, origins, strict=True):
        scene = EmbreeScene()
        parts = [_tessellate(oracle, g, meshes) for g in range(oracle.model.ngeom)]
        mesh = trimesh.util.concatenate(parts)
        TriangleMesh(scene, mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))
        jobs.append((scene, np.tile(origin, (len(ray), 1)).astype(np.float32), ray.astype(np.float32)))

    def work() -> None:
        # The bounding volumes are built on the first run and kept: only rays are timed.
        for scene, starts, directions in jobs:
            scene.run(starts, directions, query="DISTANCE")

    return work


def _tessellate(oracle: MujocoScene, geom: int, meshes: list[tuple[np.ndarray, np.ndarray]]) -> trimesh.Trimesh:
    """World triangles of a geom."""
    inst, i = oracle.instances, oracle.instance[geom]
    kind, size = int(inst.type[i]), inst.size[i]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = oracle.data.geom_xmat[geom].reshape(3, 3), oracle.data.geom_xpos[geom]
    if kind == PLANE:
        return trimesh.creation.box(extents=[2 * FLOOR_HALF, 2 * FLOOR_HALF, 1.0], transform=_lowered(pose, 0.5))
    if kind == SPHERE:
        return trimesh.creation.icosphere(subdivisions=3, radius=size[0]).apply_transform(pose)
    if kind == CAPSULE:
        return trimesh.creation.capsule(2 * size[1], size[0], count=[24, 24], transform=_lowered(pose, 0.0))
    if kind == CYLINDER:
        return trimesh.creation.cylinder(size[0], 2 * size[1], sections=48, transform=pose)
    if kind == BOX:
        return trimesh.creation.box(extents=2 * size, transform=pose)
    vertices, faces = meshes[inst.mesh[i]]
    body = oracle.model.geom_bodyid[geom]
    pose[:3, :3], pose[:3, 3] = oracle.data.xmat[body].reshape(3, 3), oracle.data.xpos[body]
    return trimesh.Trimesh(vertices, faces, process=False).apply_transform(pose)


def _lowered(pose: np.ndarray, by: float) -> np.ndarray:
    """The pose moved along its own -z."""
    out = pose.copy()
    out[:3, 3] -= by * pose[:3, 2]
    return out

"""What the sensors see: geometry instances per environment, carried by bodies whose poses are live inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import IntEnum

import numpy as np
import warp as wp

from wbm.kernels.rays_data import SceneView
from wbm.robot.model import RobotModel

PLANE, SPHERE, CAPSULE, CYLINDER, BOX, MESH = 0, 2, 3, 5, 6, 7
UNUSED = -1
KINDS = (UNUSED, PLANE, SPHERE, CAPSULE, CYLINDER, BOX, MESH)
MAX_INSTANCES = 32767  # slots are stored as int16


class Semantic(IntEnum):
    """Class of what a ray hit, the `id` of an instance. Distractor k has id `DISTRACTOR + k`; -1 is no hit."""

    FLOOR = 0
    TARGET = 1
    ROBOT = 2
    SUPPORT = 3
    DISTRACTOR = 4


@dataclass
class Instances:
    """I instances of one environment. `body` -1 means fixed in the world; `quat` is w x y z; `color` is RGB in 0..1.

    Shapes: `type`, `mesh`, `body`, `id` [I]; `size`, `pos`, `color` [I,3]; `quat` [I,4]. Sizes are MuJoCo's half
    sizes and are ignored for meshes.
    """

    type: np.ndarray
    size: np.ndarray
    mesh: np.ndarray
    body: np.ndarray
    pos: np.ndarray
    quat: np.ndarray
    id: np.ndarray
    color: np.ndarray

    @staticmethod
    def empty(num: int) -> Instances:
        """`num` unused instances."""
        return Instances(
            type=np.full(num, UNUSED, np.int32),
            size=np.zeros((num, 3), np.float32),
            mesh=np.full(num, -1, np.int32),
            body=np.full(num, -1, np.int32),
            pos=np.zeros((num, 3), np.float32),
            quat=np.tile(np.array([1, 0, 0, 0], np.float32), (num, 1)),
            id=np.full(num, -1, np.int32),
            color=np.full((num, 3), 0.5, np.float32),
        )

    @staticmethod
    def concat(parts: Sequence[Instances], num: int | None = None) -> Instances:
        """Join parts in order, padded with unused instances to `num` if it is given.

        Raises:
            ValueError: the parts hold more than `num` instances.
        """
        total = sum(len(p.type) for p in parts)
        if num is not None:
            if total > num:
                raise ValueError(f"{total} instances do not fit into {num}: raise num_instances of the RayScene")
            parts = [*parts, Instances.empty(num - total)]
        return Instances(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Instances)})


def robot_instances(robot: RobotModel) -> Instances:
    """The robot's collision geometry; body index = link index."""
    out = Instances.empty(len(robot.geoms))
    for i, geom in enumerate(robot.geoms):
        out.type[i], out.size[i] = geom.type, geom.size
        out.body[i] = robot.link(geom.link)
        out.pos[i], out.quat[i] = geom.pos, geom.quat
        out.id[i], out.color[i] = Semantic.ROBOT, geom.rgb
    return out


def floor_instance(color: tuple[float, float, float] = (0.55, 0.53, 0.5)) -> Instances:
    """The unbounded plane z = 0."""
    out = Instances.empty(1)
    out.type[0], out.id[0], out.color[0] = PLANE, Semantic.FLOOR, color
    return out


class RayScene:
    """Instances [N,I] and live body poses [N,B] on one device.

    Attributes:
        body_pos: `wp.array` [N,B] of vec3, metres, world frame; live input.
        body_quat: `wp.array` [N,B] of vec4, w x y z; live input.
        type, size, mesh, body, pos, quat, id, color: `wp.array`s [N,I], written by `update_envs`.
        view: the same, as the kernels take it.
    """

    def __init__(
        self,
        num_envs: int,
        num_bodies: int,
        num_instances: int,
        meshes: Sequence[tuple[np.ndarray, np.ndarray]] = (),
        device: str = "cpu",
        body_pos: wp.array | None = None,
        body_quat: wp.array | None = None,
    ) -> None:
        """Allocate a scene of unused instances.

        Args:
            num_envs: N; zero is allowed and renders nothing.
            num_bodies: B.
            num_instances: I, the most that one environment may hold.
            meshes: (vertices [V,3] float, faces [F,3] int) of each mesh, in the mesh's own frame, faces outward.
            device: Warp device.
            body_pos, body_quat: arrays to share instead of allocating.

        Raises:
            ValueError: a negative count, too many instances, or an array of another shape.
        """
        if num_envs < 0 or num_bodies < 0 or not 0 <= num_instances <= MAX_INSTANCES:
            raise ValueError(
                f"RayScene needs num_envs, num_bodies >= 0 and 0..{MAX_INSTANCES} instances, "
                f"got {num_envs}, {num_bodies}, {num_instances}"
            )
        self.num_envs, self.num_bodies, self.num_instances = num_envs, num_bodies, num_instances
        self.device = wp.get_device(device)
        bodies = (num_envs, num_bodies)
        self.body_pos = self._shared(body_pos, bodies, wp.vec3, "body_pos")
        self.body_quat = self._shared(body_quat, bodies, wp.vec4, "body_quat")
        if body_quat is None:
            self.body_quat.fill_(wp.vec4(1.0, 0.0, 0.0, 0.0))
        blank = Instances.empty(num_instances)
        dtypes = {"size": wp.vec3, "pos": wp.vec3, "quat": wp.vec4, "color": wp.vec3}
        for f in fields(Instances):
            value = getattr(blank, f.name)
            value = np.broadcast_to(value, (num_envs, *value.shape)).copy()
            setattr(self, f.name, wp.array(value, dtype=dtypes.get(f.name, wp.int32), device=self.device))
        self._meshes: list[wp.Mesh] = []
        self._spheres: list[np.ndarray] = []
        self._halves: list[np.ndarray] = []
        self.mesh_ids = wp.zeros(1, dtype=wp.uint64, device=self.device)
        self.mesh_sphere = wp.zeros(1, dtype=wp.vec4, device=self.device)
        self.mesh_half = wp.zeros(1, dtype=wp.vec3, device=self.device)
        self.view = SceneView()
        for name in ("body_pos", "body_quat", "type", "size", "mesh", "body", "pos", "quat"):
            setattr(self.view, name, getattr(self, name))
        self._show_meshes()
        self.add_meshes(meshes)

    def _show_meshes(self) -> None:
        for name in ("mesh_ids", "mesh_sphere", "mesh_half"):
            setattr(self.view, name, getattr(self, name))

    def _shared(self, array: wp.array | None, shape: tuple, dtype: type, name: str) -> wp.array:
        if array is None:
            return wp.zeros(shape, dtype=dtype, device=self.device)
        if tuple(array.shape) != shape or array.dtype is not dtype:
            raise ValueError(f"{name} must be a wp.array of {dtype.__name__} with shape {shape}, got {array.shape}")
        return array

    @property
    def num_meshes(self) -> int:
        """Meshes added so far."""
        return len(self._meshes)

    def add_meshes(self, meshes: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[int]:
        """Add meshes and return their indices, the values of the field `mesh`.

        Raises:
            ValueError: a mesh has no faces, a non-finite vertex, or a face index out of range.
        """
        first = len(self._meshes)
        for k, (vertices, faces) in enumerate(meshes):
            vertices = np.ascontiguousarray(vertices, np.float32)
            faces = np.ascontiguousarray(faces, np.int32).reshape(-1, 3)
            if len(faces) == 0 or not np.isfinite(vertices).all() or faces.min() < 0 or faces.max() >= len(vertices):
                raise ValueError(
                    f"mesh {first + k} has no faces, a non-finite vertex or a bad face index: repair it first"
                )
            centre = (vertices.min(0) + vertices.max(0)) / 2
            radius = np.linalg.norm(vertices - centre, axis=1).max()
            self._spheres.append(np.array([*centre, radius], np.float32))
            # Widened, so that rounding never loses a hit.
            self._halves.append(np.ptp(vertices, axis=0) * 0.5001 + 1e-6)
            self._meshes.append(
                wp.Mesh(
                    points=wp.array(vertices, dtype=wp.vec3, device=self.device),
                    indices=wp.array(faces.ravel(), dtype=wp.int32, device=self.device),
                    support_winding_number=True,
                )
            )
        if len(self._meshes) > first:
            ids = np.array([m.id for m in self._meshes], np.uint64)
            self.mesh_ids = wp.array(ids, dtype=wp.uint64, device=self.device)
            self.mesh_sphere = wp.array(np.stack(self._spheres), dtype=wp.vec4, device=self.device)
            self.mesh_half = wp.array(np.stack(self._halves), dtype=wp.vec3, device=self.device)
            self._show_meshes()
        return list(range(first, len(self._meshes)))

    def update_envs(self, env_ids: Sequence[int] | np.ndarray, instances: Sequence[Instances] | Instances) -> None:
        """Write the instances of some environments (one for each, or one shared by all), unused ones behind them.

        Raises:
            ValueError: an environment, type, mesh or body index out of range, or too many instances.
        """
        env_ids = np.atleast_1d(np.asarray(env_ids, np.int64))
        if len(env_ids) == 0:
            return
        if env_ids.min() < 0 or env_ids.max() >= self.num_envs:
            raise ValueError(f"update_envs: environment index outside 0..{self.num_envs - 1}")
        shared = isinstance(instances, Instances)
        rows = [Instances.concat([x], self.num_instances) for x in ([instances] if shared else instances)]
        if not shared and len(rows) != len(env_ids):
            raise ValueError(f"update_envs: {len(rows)} sets of instances for {len(env_ids)} environments")
        for row in rows:
            self._check(row)
        for f in fields(Instances):
            values = np.stack([getattr(row, f.name) for row in rows])
            if shared:
                values = np.broadcast_to(values, (len(env_ids), *values.shape[1:]))
            self._write(getattr(self, f.name), env_ids, values)

    def like(self, num_envs: int) -> RayScene:
        """A scene of unused instances with the same numbers of bodies and instances, sharing this one's meshes."""
        other = RayScene(num_envs, self.num_bodies, self.num_instances, device=str(self.device))
        other._meshes, other._spheres, other._halves = list(self._meshes), list(self._spheres), list(self._halves)
        other.mesh_ids, other.mesh_sphere, other.mesh_half = self.mesh_ids, self.mesh_sphere, self.mesh_half
        other._show_meshes()
        return other

    def copy_envs(self, source: RayScene, env_ids: Sequence[int] | np.ndarray) -> None:
        """Make environment k of this scene what environment `env_ids[k]` of `source` is now, bodies included.

        Raises:
            ValueError: an environment out of range.
        """
        env_ids = np.asarray(env_ids, np.int64)
        if len(env_ids) != self.num_envs or env_ids.min(initial=0) < 0 or env_ids.max(initial=-1) >= source.num_envs:
            raise ValueError(f"copy_envs: need {self.num_envs} environments within 0..{source.num_envs - 1}")
        everyone = np.arange(self.num_envs)
        for name in ("body_pos", "body_quat", *(f.name for f in fields(Instances))):
            self._write(getattr(self, name), everyone, getattr(source, name).numpy()[env_ids])

    def _check(self, row: Instances) -> None:
        used = row.type != UNUSED
        if not np.isin(row.type, KINDS).all():
            raise ValueError(f"update_envs: types must be among {KINDS}")
        if (row.mesh[row.type == MESH] < 0).any() or (row.mesh[row.type == MESH] >= self.num_meshes).any():
            raise ValueError(f"update_envs: mesh index outside 0..{self.num_meshes - 1}: add_meshes first")
        if (row.body[used] < -1).any() or (row.body[used] >= self.num_bodies).any():
            raise ValueError(f"update_envs: body index outside -1..{self.num_bodies - 1}")

    def _write(self, array: wp.array, env_ids: np.ndarray, values: np.ndarray) -> None:
        if self.device.is_cpu:
            array.numpy()[env_ids] = values
            return
        host = array.numpy()
        host[env_ids] = values
        array.assign(host)

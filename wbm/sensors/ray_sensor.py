"""One ray routine for every sensor: aim, place, cull, trace, fill."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from wbm.kernels.noise import RayNoise, aim_sensors
from wbm.kernels.points import fill_hits
from wbm.kernels.rays import cast_rays, cull_bundles, place_instances, trace_rays
from wbm.kernels.rays_data import Bundles, Scratch, Slots
from wbm.sensors.bundles import BUNDLE, GROUP, SUBGROUP, RayTable, build_table, common_part
from wbm.sensors.config import ExtrinsicNoise
from wbm.sensors.scene import RayScene

EnvIds = Sequence[int] | np.ndarray | wp.array | None


class RaySensor:
    """Casts a table of R rays from one origin an environment, Q interchangeable patterns.

    Live inputs, `wp.array`s over the N environments:
        pos [vec3], quat [vec4, w x y z]: believed pose of the sensor frame in the world.
        step [int32]: policy step of the episode. key [int32]: a number that no two episodes share (default: the
        environment's index). Noise depends on (seed, key, step) alone.
        level [float32]: factor on every deviation and chance of the noise models (default 1).

    Outputs, `wp.array`s [N,R]; `valid` False comes with -1 in numbers and zeros in vectors:
        range: distance along the ray, m. depth: coordinate along sensor z, m.
        instance: index of the instance in the scene. id: its semantic id. color [vec3]: RGB in 0..1. valid [bool].
        point_s, point_w [vec3]: in the sensor frame and in the world (through the believed pose), m.
        true_range, true_instance: what the ray meets within reach, before limits and noise, -1 for none.
        ok [N]: 0 where nothing can be trusted (a pose that is not finite, a sensor inside an object): all is invalid.
    """

    def __init__(
        self,
        scene: RayScene,
        rays: np.ndarray,
        min_range: float,
        max_range: float,
        *,
        planar: bool = False,
        turn: float = 0.0,
        exclude_body: int = -1,
        bundle: int = BUNDLE,
        noise: RayNoise | None = None,  # pyright: ignore[reportGeneralTypeIssues]
        extrinsic: ExtrinsicNoise | None = None,
        seed: int = 0,
        keep_slots: bool = False,
    ) -> None:
        """Sort the rays and allocate outputs for every environment.

        Args:
            scene: what is seen.
            rays: unit directions [Q,R,3] in the head's frame; an environment uses pattern `step % Q`.
            min_range, max_range: limits on the range, or on the depth if `planar`, m.
            planar: whether the limits are on depth.
            turn: revolutions of the head about sensor z in a step.
            exclude_body: body whose instances are not seen: the sensor's own (-1: none).
            bundle: rays in a culling bundle.
            noise: error model of each return; None is exact.
            extrinsic: mounting error; None is exact.
            seed: of all noise.
            keep_slots: whether `slots` holds every environment's instances after `trace`, for other kernels to use.
        """
        self.scene, self.min_range, self.max_range, self.planar = scene, float(min_range), float(max_range), planar
        self.exclude_body, self.bundle, self.seed, self._turn = int(exclude_body), bundle, int(seed), float(turn)
        self._keep_slots = keep_slots
        self.noise, self.extrinsic = noise or RayNoise(), extrinsic or ExtrinsicNoise()
        self.noise.seed = self.seed
        # A corner ray is longer than its planar depth.
        self.reach = self.max_range / float(rays[..., 2].min()) if planar else self.max_range
        self.num_envs, self.num_rays = scene.num_envs, rays.shape[1]
        # A CPU thread takes a whole bundle, which spares the cost of starting a thread a ray.
        self._chunk = bundle if scene.device.is_cpu else 1
        part = common_part(self._chunk)
        self.table: RayTable = build_table(rays, bundle, part)
        self._bundles = self._upload_table(part)
        self._allocate()

    def _upload_table(self, part: int) -> Any:  # a `Bundles`; a Warp struct is no class to a type checker
        table, device = self.table, self.scene.device

        def vectors(value: np.ndarray, dtype: type) -> wp.array:
            return wp.array(value.astype(np.float32), dtype=dtype, device=device)

        self.rays = vectors(table.rays, wp.vec3)
        out = Bundles()
        in_order = np.take_along_axis(table.rays, table.order[:, :, None].astype(np.int64), axis=1)
        out.direction, out.order = vectors(in_order, wp.vec3), wp.array(table.order, dtype=wp.int32, device=device)
        out.cone, out.group_cone = vectors(table.cone, wp.vec4), vectors(table.group_cone, wp.vec4)
        out.subgroup_cone = vectors(table.subgroup_cone, wp.vec4)
        out.part_cone = vectors(table.part_cone, wp.vec4)
        out.bundle, out.group, out.subgroup = self.bundle, GROUP, SUBGROUP
        out.part, out.chunk = part, self._chunk
        axis, half = table.view
        out.view_axis, out.view_cos, out.view_sin = wp.vec3(*axis), float(np.cos(half)), max(float(np.sin(half)), 0.0)
        out.reach = self.reach
        return out

    def _allocate(self) -> None:
        n, device = self.num_envs, self.scene.device
        envs, hits = (n,), (n, self.num_rays)

        def new(shape: tuple[int, ...], dtype: type) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        self._all = wp.array(np.arange(n), dtype=wp.int32, device=device)
        self.pos, self.quat = new(envs, wp.vec3), new(envs, wp.vec4)
        self.quat.fill_(wp.vec4(1.0, 0.0, 0.0, 0.0))
        self.step, self.key = new(envs, wp.int32), wp.clone(self._all)
        self.level = wp.ones(envs, dtype=wp.float32, device=device)
        self.pattern, self.ok = new(envs, wp.int32), new(envs, wp.int32)
        self.true_pos, self.true_quat = new(envs, wp.vec3), new(envs, wp.vec4)
        self._head, self._rotation = new(envs, wp.mat33), new(envs, wp.mat33)
        self._memory: list[wp.array] = []
        self.slots, self._work = self._new_slots(), self._new_work()
        self.true_range, self.true_instance = new(hits, wp.float32), new(hits, wp.int32)
        self.range, self.depth = new(hits, wp.float32), new(hits, wp.float32)
        self.instance, self.id = new(hits, wp.int32), new(hits, wp.int32)
        self.color, self.valid = new(hits, wp.vec3), new(hits, wp.bool)
        self.point_s, self.point_w = new(hits, wp.vec3), new(hits, wp.vec3)

    def _temporary(self, shape: tuple[int, ...], dtype: type) -> wp.array:
        """An array [N,...] that holds nothing from one kernel to the next.

        Kernels on a CPU run on one thread: there, environments follow each other in the same memory, which stays in the
        cache.
        """
        device, n = self.scene.device, self.num_envs
        shared = device.is_cpu and n > 1 and not self._keep_slots
        memory = wp.zeros((1 if shared else n, *shape), dtype=dtype, device=device)
        if not shared:
            return memory
        self._memory.append(memory)
        strides = (0, *memory.strides[1:])  # pyright: ignore[reportArgumentType, reportOptionalSubscript]
        return wp.array(ptr=memory.ptr, dtype=dtype, shape=(n, *shape), strides=strides, device=device)  # pyright: ignore[reportArgumentType]

    def _new_slots(self) -> Any:
        out, new, num = Slots(), self._temporary, (self.scene.num_instances,)
        out.count, out.inst, out.kind = new((), wp.int32), new(num, wp.int32), new(num, wp.int32)
        out.size, out.mesh, out.rot = new(num, wp.vec3), new(num, wp.uint64), new(num, wp.mat33)
        out.origin, out.sphere, out.cone = new(num, wp.vec3), new(num, wp.vec4), new(num, wp.vec4)
        out.near = new(num, wp.float32)
        return out

    def _new_work(self) -> Any:
        out, new, num = Scratch(), self._temporary, self.scene.num_instances
        groups, bundles = self.table.group_cone.shape[1], self.table.cone.shape[1]
        out.group_slot, out.slot = new((groups, num), wp.int16), new((bundles, num), wp.int16)
        out.subgroup_slot = new((groups, num), wp.int16)
        out.count, out.far = new((bundles,), wp.int32), new((self.table.part_cone.shape[1],), wp.float32)
        out.best, out.inst = new((self.num_rays,), wp.float32), new((self.num_rays,), wp.int32)
        return out

    def env_index(self, env_ids: EnvIds) -> wp.array:
        """Device array of environment indices; all of them for None.

        Raises:
            ValueError: an index out of range.
        """
        if env_ids is None:
            return self._all
        if isinstance(env_ids, wp.array):
            return env_ids
        ids = np.asarray(env_ids, np.int32).reshape(-1)
        if len(ids) and (ids.min() < 0 or ids.max() >= self.num_envs):
            raise ValueError(f"render: environment index outside 0..{self.num_envs - 1}")
        return wp.array(ids, dtype=wp.int32, device=self.scene.device)

    def render(self, env_ids: EnvIds = None) -> None:
        """Measure in the given environments (all for None) at their live poses and steps; other outputs stay.

        Raises:
            ValueError: an index out of range.
        """
        ids = self.env_index(env_ids)
        if ids.shape[0] > 0:
            self.trace(ids)
            self.fill(ids)

    def trace(self, ids: wp.array) -> None:
        """Fill `true_range` and `ok` of the given environments."""
        device = self.scene.device
        wp.launch(
            aim_sensors,
            dim=ids.shape[0],
            inputs=[
                ids, self.step, self.key, self.level, self.seed, self.extrinsic.sigma_pos, self.extrinsic.sigma_rot,
                self._turn, self.table.rays.shape[0], self.pos, self.quat,
            ],
            outputs=[self.pattern, self.true_pos, self.true_quat, self._head, self._rotation],
            device=device,
        )  # fmt: skip
        (self._cast_at_once if device.is_cpu else self._cast_in_steps)(ids)

    def _cast_at_once(self, ids: wp.array) -> None:
        """A thread an environment."""
        wp.launch(
            cast_rays,
            dim=ids.shape[0],
            inputs=[
                ids, self.pattern, self.true_pos, self.true_quat, self.exclude_body, self._bundles, self.scene.view,
                self.slots, self._work,
            ],
            outputs=[self.ok, self.true_range, self.true_instance],
            device=self.scene.device,
        )  # fmt: skip

    def _cast_in_steps(self, ids: wp.array) -> None:
        """Many threads an environment; needs memory of its own for each environment."""
        num, device = ids.shape[0], self.scene.device
        wp.launch(
            place_instances,
            dim=num,
            inputs=[ids, self.true_pos, self.true_quat, self.exclude_body, self._bundles, self.scene.view],
            outputs=[self.slots, self.ok],
            device=device,
        )
        wp.launch(
            cull_bundles,
            dim=(num, self.table.group_cone.shape[1]),
            inputs=[ids, self.pattern, self._bundles, self.slots],
            outputs=[self._work],
            device=device,
        )
        wp.launch(
            trace_rays,
            dim=(num, -(-self.num_rays // self._chunk)),
            inputs=[ids, self.pattern, self._bundles, self.slots, self._work],
            outputs=[self.true_range, self.true_instance],
            device=device,
        )

    def fill(self, ids: wp.array) -> None:
        """Apply the noise and derive depth, ids, colour, flags and points of the given environments."""
        wp.launch(
            fill_hits,
            dim=(ids.shape[0], -(-self.num_rays // self._chunk)),
            inputs=[
                ids, self.pattern, self.step, self.key, self.level, self.noise, self._chunk, self.rays, self.pos,
                self._head, self._rotation, self.planar, self.min_range, self.max_range, self.true_range,
                self.true_instance, self.scene.id, self.scene.color,
            ],
            outputs=[
                self.range, self.depth, self.instance, self.id, self.color, self.valid, self.point_s, self.point_w,
            ],
            device=self.scene.device,
        )  # fmt: skip

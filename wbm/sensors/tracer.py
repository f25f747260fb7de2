"""One ray routine for every sensor: place, cull, trace, fill."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from wbm.kernels.points import fill_hits
from wbm.kernels.rays import cull_bundles, place_instances, trace_rays
from wbm.sensors.bundles import BUNDLE, RayTable, build_table
from wbm.sensors.scene import RayScene


class RayTracer:
    """Casts one table of R rays from one origin an environment, Q interchangeable patterns.

    Attributes:
        pos, quat: sensor pose in the world, `wp.array`s [N] of vec3 and vec4 (w x y z); live inputs.
        frame_quat: orientation of the frame that `point_s` is given in; the same array as `quat` unless `spinning`.
        pattern: row of the table that each environment uses, [N]; live input.
        range: hit distance [N,R], m, -1 invalid. depth: its share along sensor z, m, -1 invalid.
        instance, id: [N,R] index of the instance and its semantic id, -1 invalid.
        color: [N,R] vec3. valid: [N,R] bool. ok: [N] 0 where the pose is not usable (not finite, inside an object).
        point_s, point_w: [N,R] vec3, m, in the sensor frame and in the world; zero where invalid.
    """

    def __init__(
        self,
        scene: RayScene,
        rays: np.ndarray,
        min_range: float,
        max_range: float,
        exclude_body: int = -1,
        bundle: int = BUNDLE,
        planar: bool = False,
        spinning: bool = False,
    ) -> None:
        """Sort `rays` [Q,R,3] (unit, sensor frame) and allocate outputs for every environment of `scene`.

        Limits are on the range, or with `planar` on the coordinate along sensor z. A `spinning` sensor keeps the frame
        of its points apart from that of its rays.
        """
        self.scene, self.min_range, self.max_range, self.planar = scene, float(min_range), float(max_range), planar
        self._reach = self.max_range / float(rays[..., 2].min()) if planar and rays.size else self.max_range
        self.exclude_body, self.bundle = int(exclude_body), bundle
        self.table: RayTable = build_table(rays, bundle)
        device = scene.device
        n, num_rays, groups = scene.num_envs, rays.shape[1], self.table.cone.shape[1]
        self.num_envs, self.num_rays = n, num_rays
        sorted_rays = np.take_along_axis(self.table.rays, self.table.order[:, :, None].astype(np.int64), axis=1)
        self._rays = wp.array(self.table.rays.astype(np.float32), dtype=wp.vec3, device=device)
        self._sorted = wp.array(sorted_rays.astype(np.float32), dtype=wp.vec3, device=device)
        self._order = wp.array(self.table.order, dtype=wp.int32, device=device)
        self._cone = wp.array(self.table.cone.astype(np.float32), dtype=wp.vec4, device=device)
        self._all = wp.array(np.arange(n), dtype=wp.int32, device=device)

        def new(shape: tuple[int, ...], dtype: type) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        self.pos, self.quat = new((n,), wp.vec3), new((n,), wp.vec4)
        self.quat.fill_(wp.vec4(1.0, 0.0, 0.0, 0.0))
        self.frame_quat = new((n,), wp.vec4) if spinning else self.quat
        self.frame_quat.fill_(wp.vec4(1.0, 0.0, 0.0, 0.0))
        self.pattern = new((n,), wp.int32)
        slots = (n, scene.num_instances)
        self.ok, self._count = new((n,), wp.int32), new((n,), wp.int32)
        self._inst, self._kind = new(slots, wp.int32), new(slots, wp.int32)
        self._size, self._mesh = new(slots, wp.vec3), new(slots, wp.uint64)
        self._rot, self._origin = new(slots, wp.mat33), new(slots, wp.vec3)
        self._sphere, self._near = new(slots, wp.vec4), new(slots, wp.float32)
        self._cand_count = new((n, groups), wp.int32)
        self._cand = new((n, groups, scene.num_instances), wp.int16)
        hits = (n, num_rays)
        self.range, self.depth = new(hits, wp.float32), new(hits, wp.float32)
        self.instance, self.id = new(hits, wp.int32), new(hits, wp.int32)
        self.color, self.valid = new(hits, wp.vec3), new(hits, wp.bool)
        self.point_s, self.point_w = new(hits, wp.vec3), new(hits, wp.vec3)

    def env_index(self, env_ids: Sequence[int] | np.ndarray | wp.array | None) -> wp.array:
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

    def trace(self, env_ids: Sequence[int] | np.ndarray | wp.array | None = None) -> wp.array:
        """Fill `range`, `instance` and `ok` of the given environments; returns their device index array."""
        s, ids, device = self.scene, self.env_index(env_ids), self.scene.device
        if ids.shape[0] == 0 or self.num_rays == 0:
            return ids
        axis, half = self.table.view
        wp.launch(
            place_instances,
            dim=ids.shape[0],
            inputs=[
                ids, self.pos, self.quat, self.exclude_body, wp.vec3(*axis), float(np.cos(half)),
                max(float(np.sin(half)), 0.0), self._reach, s.body_pos, s.body_quat, s.type, s.size, s.mesh, s.body,
                s.pos, s.quat, s.mesh_ids, s.mesh_sphere,
            ],
            outputs=[
                self.ok, self._count, self._inst, self._kind, self._size, self._mesh, self._rot, self._origin,
                self._sphere, self._near,
            ],
            device=device,
        )  # fmt: skip
        wp.launch(
            cull_bundles,
            dim=(ids.shape[0], self._cand_count.shape[1]),
            inputs=[ids, self.pattern, self._cone, self._count, self._sphere, self._near],
            outputs=[self._cand_count, self._cand],
            device=device,
        )
        wp.launch(
            trace_rays,
            dim=(ids.shape[0], self.num_rays),
            inputs=[
                ids, self.pattern, self._sorted, self._order, self.bundle, self._reach, self._inst, self._kind,
                self._size, self._mesh, self._rot, self._origin, self._sphere, self._near, self._cand_count, self._cand,
            ],
            outputs=[self.range, self.instance],
            device=device,
        )  # fmt: skip
        return ids

    def fill(self, ids: wp.array) -> None:
        """Derive depth, id, colour, flags and points from `range` and `instance`."""
        if ids.shape[0] == 0 or self.num_rays == 0:
            return
        wp.launch(
            fill_hits,
            dim=(ids.shape[0], self.num_rays),
            inputs=[
                ids, self.pattern, self._rays, self.pos, self.quat, self.frame_quat, self.planar, self.min_range,
                self.max_range, self.ok, self.instance, self.scene.id, self.scene.color, self.range,
            ],
            outputs=[self.depth, self.id, self.color, self.valid, self.point_s, self.point_w],
            device=self.scene.device,
        )  # fmt: skip

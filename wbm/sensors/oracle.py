"""The same scene as MuJoCo sees it: what the ray routine is compared with."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from wbm.sensors.scene import MESH, PLANE, UNUSED, Instances

SEEN, HIDDEN = 0, 1  # geom groups


class MujocoScene:
    """One environment's instances as the geoms of a compiled `MjModel`, geom i being used instance i.

    Attributes:
        model, data: MuJoCo's.
        instance: [G] instance index of each geom.
    """

    def __init__(self, instances: Instances, meshes: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
        """Compile; every instance but planes becomes a mocap body so that it can be placed."""
        spec = mujoco.MjSpec()
        used = np.flatnonzero(instances.type != UNUSED)
        for k in np.unique(instances.mesh[instances.type == MESH]):
            vertices, faces = meshes[k]
            mesh = spec.add_mesh(name=f"m{k}", uservert=vertices.ravel().tolist(), userface=faces.ravel().tolist())
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        for i in used:
            kind = int(instances.type[i])
            if kind == PLANE:
                quat = instances.quat[i] / np.linalg.norm(instances.quat[i])
                spec.worldbody.add_geom(
                    name=f"g{i}",
                    type=mujoco.mjtGeom.mjGEOM_PLANE,
                    size=[*instances.size[i, :2], 1.0],
                    pos=instances.pos[i],
                    quat=quat,
                )
                continue
            body = spec.worldbody.add_body(name=f"b{i}", mocap=True)
            if kind == MESH:
                body.add_geom(name=f"g{i}", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"m{instances.mesh[i]}")
            else:
                body.add_geom(name=f"g{i}", type=mujoco.mjtGeom(kind), size=instances.size[i].tolist())
        # Without contact no convex hulls are built, which rays do not need.
        for geom in spec.geoms:
            geom.contype = geom.conaffinity = 0
        self.instances = instances
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.instance = np.array([int(self.model.geom(g).name[1:]) for g in range(self.model.ngeom)], np.int64)
        self._mocap = [(i, int(self.model.body(f"b{i}").mocapid[0])) for i in used if instances.type[i] != PLANE]

    def place(self, body_pos: np.ndarray, body_quat: np.ndarray) -> None:
        """Put every geom where bodies [B,3], [B,4] (w x y z) carry it."""
        inst = self.instances
        for i, mocap in self._mocap:
            pos, quat = inst.pos[i].astype(float), inst.quat[i].astype(float)
            quat /= np.linalg.norm(quat)
            if inst.body[i] >= 0:
                carrier = body_quat[inst.body[i]].astype(float)
                carrier /= np.linalg.norm(carrier)
                moved, turned = np.empty(3), np.empty(4)
                mujoco.mju_rotVecQuat(moved, pos, carrier)
                mujoco.mju_mulQuat(turned, carrier, quat)
                pos, quat = moved + body_pos[inst.body[i]], turned
            self.data.mocap_pos[mocap], self.data.mocap_quat[mocap] = pos, quat
        mujoco.mj_kinematics(self.model, self.data)

    def cast(self, origin: np.ndarray, rays: np.ndarray, exclude_body: int = -1) -> tuple[np.ndarray, np.ndarray]:
        """`mj_multiRay` over unit rays [R,3] from `origin` [3], world frame.

        Returns:
            range [R], -1 where nothing is hit, and instance [R], -1 there.
        """
        hidden = (self.instances.body[self.instance] == exclude_body) & (exclude_body >= 0)
        self.model.geom_group[:] = np.where(hidden, HIDDEN, SEEN)
        group = np.zeros(mujoco.mjNGROUP, np.uint8)
        group[SEEN] = 1
        num = len(rays)
        geom, dist = np.full(num, -1, np.int32), np.full(num, np.inf)
        flat = np.ascontiguousarray(rays, np.float64).ravel()
        origin = np.asarray(origin, np.float64)
        mujoco.mj_multiRay(self.model, self.data, origin, flat, group, True, -1, geom, dist, None, num, mujoco.mjMAXVAL)
        return dist, np.where(geom >= 0, self.instance[geom], -1)

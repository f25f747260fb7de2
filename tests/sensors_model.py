"""Random MuJoCo scenes with the robot, and the same scene as instances: the oracle side of the sensor tests."""

from __future__ import annotations

import mujoco
import numpy as np
import trimesh

from wbm.robot.model import forward_kinematics, load_robot
from wbm.sensors.scene import Instances, RayScene, Semantic, floor_instance, robot_instances

TYPES = {2: "sphere", 3: "capsule", 5: "cylinder", 6: "box"}


def primitive_meshes(detail: int = 2) -> list[tuple[np.ndarray, np.ndarray]]:
    """Closed meshes about 0.15 m large; detail 4 gives 4 to 5 thousand triangles each."""
    around = 8 * 2**detail
    shapes = [
        trimesh.creation.icosphere(subdivisions=detail, radius=0.08),
        trimesh.creation.torus(0.08, 0.025, major_sections=around, minor_sections=around // 4),
        trimesh.creation.capsule(0.2, 0.05, count=[around // 2, around // 2]),
        trimesh.creation.revolve(
            np.stack([0.04 + 0.03 * np.cos(np.linspace(0, 7, around)), np.linspace(-0.1, 0.1, around)], axis=1),
            sections=around // 2,
        ),
    ]
    return [(np.asarray(s.vertices), np.asarray(s.faces)) for s in shapes]


def random_quat(rng: np.random.Generator) -> np.ndarray:
    q = rng.normal(size=4)
    return q / np.linalg.norm(q)


class OracleModel:
    """One compiled MjModel whose geoms are the instances of one environment, in the same order."""

    def __init__(self, rng: np.random.Generator, num_props: int, meshes, num_mesh: int, robot: bool = True) -> None:
        self.robot = load_robot()
        parts = [floor_instance()]
        if robot:
            parts.append(robot_instances(self.robot))
        self.props = Instances.empty(num_props + num_mesh)
        for i in range(num_props + num_mesh):
            mesh = i >= num_props
            self.props.type[i] = 7 if mesh else rng.choice(list(TYPES))
            self.props.mesh[i] = rng.integers(len(meshes)) if mesh else -1
            self.props.size[i] = rng.uniform(0.03, 0.25, 3)
            self.props.pos[i] = rng.uniform([-2.0, -2.0, 0.1], [2.0, 2.0, 1.5])
            self.props.quat[i] = random_quat(rng)
            self.props.id[i] = Semantic.TARGET if i == num_props else Semantic.DISTRACTOR + i
            self.props.color[i] = rng.uniform(0, 1, 3)
        self.instances = Instances.concat([*parts, self.props])
        spec = mujoco.MjSpec()
        for k, (v, f) in enumerate(meshes):
            spec.add_mesh(name=f"m{k}", uservert=v.ravel().tolist(), userface=f.ravel().tolist())
        bodies = []
        for i in range(len(self.instances.type)):
            kind = int(self.instances.type[i])
            link = int(self.instances.body[i])
            if kind == 0:
                spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
                continue
            body = spec.worldbody.add_body(name=f"b{i}", mocap=True)
            bodies.append((i, link))
            if kind == 7:
                body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"m{int(self.instances.mesh[i])}")
            else:
                body.add_geom(type=mujoco.mjtGeom(kind), size=self.instances.size[i].tolist())
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.bodies = bodies
        self.exclude = {}

    def meshes(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """The meshes as compiled: MuJoCo centres and aligns them."""
        m = self.model
        out = []
        for k in range(m.nmesh):
            v = m.mesh_vert[m.mesh_vertadr[k] : m.mesh_vertadr[k] + m.mesh_vertnum[k]]
            f = m.mesh_face[m.mesh_faceadr[k] : m.mesh_faceadr[k] + m.mesh_facenum[k]]
            out.append((v.copy(), f.copy()))
        return out

    def pose(self, scene: RayScene, env: int, q: np.ndarray) -> None:
        """Put both sides into joint position `q`, props where they are."""
        rot, pos = forward_kinematics(self.robot, q)
        quat = np.empty((len(pos), 4))
        for i in range(len(pos)):
            mujoco.mju_mat2Quat(quat[i], rot[i].ravel())
        inst = self.instances
        for mocap, (i, link) in enumerate(self.bodies):
            p, r = inst.pos[i].astype(float), inst.quat[i].astype(float)
            r /= np.linalg.norm(r)
            if link >= 0:
                out, r0 = np.empty(4), r
                mujoco.mju_mulQuat(out, quat[link], r0)
                p, r = pos[link] + rot[link] @ p, out
            self.data.mocap_pos[mocap], self.data.mocap_quat[mocap] = p, r
        mujoco.mj_kinematics(self.model, self.data)
        row = Instances.concat([inst])
        meshes = np.flatnonzero(inst.type == 7)
        # A mesh geom's own frame is not its body's.
        row.pos[meshes] = self.data.geom_xpos[meshes]
        for g in meshes:
            q4 = np.empty(4)
            mujoco.mju_mat2Quat(q4, self.data.geom_xmat[g])
            row.quat[g] = q4
        scene.update_envs([env], [row])
        scene.body_pos.numpy()[env] = pos
        scene.body_quat.numpy()[env] = quat

    def rays(
        self, origin: np.ndarray, rays_w: np.ndarray, skip: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """`mj_multiRay`: range (-1 nothing) and geom of each ray; geoms in `skip` are not seen."""
        n = len(rays_w)
        geom, dist = np.full(n, -9, np.int32), np.full(n, np.nan)
        group = np.zeros(6, np.uint8)
        group[0] = 1
        self.model.geom_group[:] = 0
        if skip is not None:
            self.model.geom_group[skip] = 1
        mujoco.mj_multiRay(
            self.model, self.data, origin, rays_w.ravel(), group, True, -1, geom, dist, None, n, mujoco.mjMAXVAL
        )
        return dist, geom

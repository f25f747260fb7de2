"""What a scene's MuJoCo spec is put together from: meshes, supports and the geometry slots of objects."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from wbm.robot.mjcf import OBJECT_BIT, ROBOT_BIT, STATIC_BIT

EVERYTHING = ROBOT_BIT | OBJECT_BIT | STATIC_BIT


def compile_with_hulls(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a spec so that every mesh has its collision hull, used by a geom or not.

    MuJoCo builds hulls for the meshes of colliding geoms only, once: a first compilation has a geom of every mesh.
    """
    library = spec.worldbody.add_body(name="library")
    for mesh in spec.meshes:
        library.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, contype=OBJECT_BIT)
    spec.compile()
    spec.delete(library)
    model = spec.compile()
    if (model.mesh_graphadr < 0).any():
        raise RuntimeError("MuJoCo built no collision hull for some object meshes: the scene model needs MuJoCo 3.14")
    return model


def add_mesh(spec: mujoco.MjSpec, name: str, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Add a mesh asset of vertices [V,3] (m) and triangles [F,3]."""
    spec.add_mesh(name=name, uservert=vertices.ravel(), userface=faces.ravel())


def add_support(spec: mujoco.MjSpec, i: int, size: np.ndarray, pos: np.ndarray, quat: np.ndarray) -> mujoco.MjsGeom:
    """Add support `i`, a static box with half sizes [3] (m) and its pose in the world."""
    return spec.worldbody.add_geom(
        name=f"support_{i}",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=size,
        pos=pos,
        quat=quat,
        contype=STATIC_BIT,
        conaffinity=0,
        rgba=[0.65, 0.55, 0.45, 1.0],
    )


def add_slot(body: mujoco.MjsBody, **geom: Any) -> None:
    """Add a massless geom of an object; `geom` are MuJoCo's attributes for its shape, pose and name."""
    # Priority: the object's friction and contact parameters decide every contact it takes part in.
    body.add_geom(contype=OBJECT_BIT, conaffinity=EVERYTHING, priority=1, mass=0.0, **geom)

"""Puts the robot and solids into the scene of a web viewer (viser)."""

from __future__ import annotations

from typing import Any

import numpy as np

from wbm.artifacts.mcap_io import BOX, CAPSULE, CYLINDER, MESH, SPHERE
from wbm.robot.model import RobotModel
from wbm.robot.spheres import robot_spheres


def add_robot(scene: Any, robot: RobotModel) -> tuple[dict[int, Any], list[Any]]:
    """Draw the robot with its geometry below one frame a link; returns those frames and the (hidden) spheres."""
    links, spheres = {}, []
    for i, name in enumerate(robot.link_names):
        links[i] = scene.add_frame(f"/robot/{name}", show_axes=False)
    for geom in robot.geoms:
        path = f"/robot/{geom.link}/{geom.name}"
        add_solid(scene, path, geom.type, geom.size, geom.rgb, geom.pos, geom.quat)
    ball = robot_spheres(robot)
    for k in range(len(ball)):
        handle = scene.add_icosphere(
            f"/robot/{robot.link_names[ball.link[k]]}/sphere_{k}",
            radius=float(ball.radius[k]),
            color=(240, 170, 40),
            opacity=0.35,
            subdivisions=2,
            position=tuple(ball.pos[k]),
            visible=False,
        )
        spheres.append(handle)
    return links, spheres


def add_solid(
    scene: Any,
    path: str,
    kind: int,
    size: Any,
    rgb: Any,
    pos: Any,
    quat: Any,
    vertices: np.ndarray | None = None,
    faces: np.ndarray | None = None,
) -> Any:
    """Draw a primitive (MuJoCo's numbers and half sizes) or a mesh; returns the handle that carries its pose."""
    colour = tuple(round(255 * float(c)) for c in rgb[:3])
    pose = {"position": tuple(float(v) for v in pos), "wxyz": tuple(float(v) for v in quat)}
    if kind == BOX:
        return scene.add_box(path, color=colour, dimensions=tuple(2 * float(s) for s in size), **pose)
    if kind == SPHERE:
        return scene.add_icosphere(path, radius=float(size[0]), color=colour, **pose)
    if kind in (CYLINDER, CAPSULE):
        radius, half = float(size[0]), float(size[1])
        if kind == CYLINDER:
            return scene.add_cylinder(path, radius=radius, height=2 * half, color=colour, **pose)
        root = scene.add_frame(path, show_axes=False, **pose)
        scene.add_cylinder(f"{path}/tube", radius=radius, height=2 * half, color=colour)
        for name, z in (("top", half), ("bottom", -half)):
            scene.add_icosphere(f"{path}/{name}", radius=radius, color=colour, position=(0.0, 0.0, z))
        return root
    if kind == MESH and vertices is not None and faces is not None:
        return scene.add_mesh_simple(
            path, np.float32(vertices), np.uint32(faces), color=colour, flat_shading=True, **pose
        )
    raise ValueError(f"geometry type {kind} of {path} cannot be drawn")

"""What `wbm robot export` and `wbm robot show` do: a standalone MJCF file, and the robot in numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from wbm.robot import joints
from wbm.robot.config import MjcfOptions
from wbm.robot.mjcf import build_robot
from wbm.robot.model import RobotModel, load_robot
from wbm.robot.skin import add_skin
from wbm.robot.spheres import robot_spheres, self_pairs


def standalone_spec(options: MjcfOptions | None = None, spheres: bool = False) -> mujoco.MjSpec:
    """The robot on a floor with a light and the keyframe `home`; optionally its collision spheres as visuals.

    Raises:
        FileNotFoundError: `skin=menagerie` and the meshes cannot be had.
        FactsError: `facts` makes no robot.
    """
    options = options or MjcfOptions()
    robot = load_robot(options.facts)
    spec = mujoco.MjSpec()
    spec.modelname = "wbm"
    spec.option.timestep = 0.004
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    build_robot(spec, robot, options)
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 0.1], rgba=[0.6, 0.6, 0.6, 1])
    spec.worldbody.add_light(pos=[0, 0, 3], dir=[0, 0, -1], diffuse=[0.7, 0.7, 0.7])
    spec.add_key(name="home", qpos=robot.q_home, ctrl=robot.q_home)
    if options.skin == "menagerie":
        add_skin(spec)
    if spheres:
        _add_spheres(spec, robot)
    return spec


def export_robot(path: Path, options: MjcfOptions | None = None) -> None:
    """Write the robot as one MJCF file that MuJoCo's viewer opens.

    Raises:
        FileNotFoundError: `skin=menagerie` and the meshes cannot be had.
    """
    spec = standalone_spec(options)
    spec.compile()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(spec.to_xml(), encoding="utf-8")


def describe_robot(robot: RobotModel | None = None) -> dict[str, Any]:
    """The robot in numbers, ready for JSON: joints with limits, links with masses, frames, spheres and pairs."""
    robot = robot or load_robot()
    spheres = robot_spheres(robot)
    kind = {1: "hinge", 2: "slide"}
    of_joint = {int(j): kind[int(t)] for j, t in zip(robot.joint_index, robot.joint_type, strict=True) if j >= 0}
    group = {i: name for name, part in joints.GROUPS.items() for i in range(*part.indices(joints.NUM_JOINTS))}
    return {
        "joints": [
            {
                "name": name,
                "group": group[i],
                "type": of_joint[i],
                "min": float(robot.q_min[i]),
                "max": float(robot.q_max[i]),
                "max_velocity": float(robot.qd_max[i]),
                "max_acceleration": float(robot.qdd_max[i]),
                "max_effort": float(robot.effort[i]),
                "kp": float(robot.kp[i]),
                "kv": float(robot.kv[i]),
                "home": float(robot.q_home[i]),
            }
            for i, name in enumerate(robot.joint_names)
        ],
        "links": [
            {
                "name": name,
                "parent": robot.link_names[p] if p >= 0 else None,
                "mass": inertial.mass if inertial else 0.0,
            }
            for name, p, inertial in zip(robot.link_names, robot.parent, robot.inertials, strict=True)
        ],
        "frames": {name: robot.link_names[frame.link] for name, frame in robot.frames.items()},
        "mass": float(sum(i.mass for i in robot.inertials if i)),
        "geoms": len(robot.geoms),
        "spheres": [
            {"name": name, "link": robot.link_names[link], "radius": float(radius)}
            for name, link, radius in zip(spheres.names, spheres.link, spheres.radius, strict=True)
        ],
        "self_pairs": len(self_pairs(robot, spheres)),
    }


def format_robot(robot: RobotModel | None = None) -> str:
    """`describe_robot` as text for a terminal."""
    facts = describe_robot(robot)
    lines = [
        f"{'joint':<16}{'type':<7}{'min':>9}{'max':>9}{'vel':>8}{'acc':>8}{'effort':>9}{'kp':>9}{'kv':>8}{'home':>8}"
    ]
    for j in facts["joints"]:
        lines.append(
            f"{j['name']:<16}{j['type']:<7}{j['min']:>9.3f}{j['max']:>9.3f}{j['max_velocity']:>8.3g}"
            f"{j['max_acceleration']:>8.3g}{j['max_effort']:>9.3g}{j['kp']:>9.4g}{j['kv']:>8.3g}{j['home']:>8.3f}"
        )
    lines += ["", f"{'link':<18}{'parent':<18}{'mass kg':>9}"]
    lines += [f"{k['name']:<18}{k['parent'] or '-':<18}{k['mass']:>9.4f}" for k in facts["links"]]
    lines += [f"{'total':<36}{facts['mass']:>9.4f}", "", f"{'sphere':<22}{'link':<18}{'radius m':>9}"]
    lines += [f"{s['name']:<22}{s['link']:<18}{s['radius']:>9.4f}" for s in facts["spheres"]]
    lines.append(f"{len(facts['spheres'])} spheres, {facts['self_pairs']} self pairs, {facts['geoms']} geoms")
    return "\n".join(lines)


def _add_spheres(spec: mujoco.MjSpec, robot: RobotModel) -> None:
    spheres = robot_spheres(robot)
    for name, link, pos, radius in zip(spheres.names, spheres.link, spheres.pos, spheres.radius, strict=True):
        spec.body(robot.link_names[link]).add_geom(
            name=f"sphere_{name}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[radius, 0, 0],
            pos=pos,
            rgba=np.array([0.2, 0.6, 1.0, 0.25]),
            contype=0,
            conaffinity=0,
            mass=0.0,
            group=4,
        )

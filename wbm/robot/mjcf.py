"""Adds the robot to a `mujoco.MjSpec`: bodies, joints, actuators, frames as sites, collision geoms, contact sensors."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import mujoco
import numpy as np

from wbm.robot import joints
from wbm.robot.config import MjcfOptions
from wbm.robot.model import HINGE, RobotModel, load_robot
from wbm.robot.spheres import moving_joints

ROBOT_BIT, OBJECT_BIT, STATIC_BIT = 1, 2, 4
"""Collision bits: everything collides with everything, but statics and unused slots not with statics."""

PRIMITIVE_GROUP = 1  # visible in MuJoCo's viewer; a skin hides it

BASE_JOINT_LINKS = ("base_x", "base_y")  # massless links whose joints MuJoCo keeps on the base's body
FORCE_DATA = (1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND)) | (1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE))
NET_FORCE = 3  # mjtConReduce: net wrench about the force-weighted centroid, in the world frame
CONTACT_VALUES = 4
"""Values of one contact sensor: number of contacts, then the net force (N, world frame) on the second body."""

_SAMPLES = 256
_OFTEN_TOUCHING = 0.25


def build_robot(spec: mujoco.MjSpec, robot: RobotModel, options: MjcfOptions | None = None) -> None:
    """Add the robot to `spec` under its world body.

    One body stands for the base, with the slide joints x, y and the hinge yaw. Joints and actuators are named and
    ordered as `robot.joint_names`; actuators are position servos with the model's gains and effort limits. Frames
    become sites of the same name. Gravity is compensated on every link. Angles are radians.
    """
    options = options or MjcfOptions()
    _add_links(spec, robot, options)
    _add_actuators(spec, robot, options)
    for first, second in excluded_pairs(robot, options.self_collision):
        spec.add_exclude(bodyname1=first, bodyname2=second)


def _add_links(spec: mujoco.MjSpec, robot: RobotModel, options: MjcfOptions) -> None:
    spec.compiler.degree = False
    bodies = {0: spec.worldbody}
    pending: list[int] = []
    extra = np.zeros(joints.NUM_JOINTS)
    extra[joints.ARM] = options.arm_armature_extra
    for i in range(1, len(robot.link_names)):
        name, parent = robot.link_names[i], int(robot.parent[i])
        if name in BASE_JOINT_LINKS:
            bodies[i] = bodies[parent]
            pending.append(i)
            continue
        body = bodies[parent].add_body(name=name, pos=robot.link_pos[i], quat=robot.link_quat[i], gravcomp=1.0)
        bodies[i] = body
        inertial = robot.inertials[i]
        if inertial is not None:
            inertia = inertial.inertia
            body.mass = inertial.mass
            body.ipos = inertial.com
            body.fullinertia = [*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]
            body.explicitinertial = True
        if robot.joint_index[i] >= 0:
            for link in [*pending, i]:
                _add_joint(body, robot, link, extra)
            pending = []
    for geom in robot.geoms:
        bodies[robot.link(geom.link)].add_geom(
            name=geom.name,
            type=mujoco.mjtGeom(geom.type),
            size=geom.size,
            pos=geom.pos,
            quat=geom.quat,
            mass=0.0,
            rgba=[*geom.rgb, 1.0],
            contype=ROBOT_BIT,
            conaffinity=ROBOT_BIT | OBJECT_BIT | STATIC_BIT,
            group=PRIMITIVE_GROUP,
        )
    for name, frame in robot.frames.items():
        bodies[frame.link].add_site(name=name, pos=frame.pos, quat=frame.quat, size=[0.005] * 3, group=4)


def _add_joint(body: mujoco.MjsBody, robot: RobotModel, link: int, extra: np.ndarray) -> None:
    j = int(robot.joint_index[link])
    hinge = robot.joint_type[link] == HINGE
    body.add_joint(
        name=robot.joint_names[j],
        type=mujoco.mjtJoint.mjJNT_HINGE if hinge else mujoco.mjtJoint.mjJNT_SLIDE,
        axis=robot.joint_axis[link],
        range=[robot.q_min[j], robot.q_max[j]],
        limited=True,
        armature=robot.armature[j] + extra[j],
        damping=robot.damping[j],
        frictionloss=robot.frictionloss[j],
    )


def _add_actuators(spec: mujoco.MjSpec, robot: RobotModel, options: MjcfOptions) -> None:
    effort = robot.effort.copy()
    if options.hand_effort > 0:
        effort[joints.HAND] = options.hand_effort
    for j, name in enumerate(robot.joint_names):
        actuator = spec.add_actuator(
            name=name,
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            ctrllimited=True,
            ctrlrange=[robot.q_min[j], robot.q_max[j]],
            forcelimited=True,
            forcerange=[-effort[j], effort[j]],
        )
        actuator.set_to_position(kp=robot.kp[j], kv=robot.kv[j])


@cache
def excluded_pairs(robot: RobotModel, self_collision: bool = True) -> tuple[tuple[str, str], ...]:
    """Body pairs whose contact is not simulated: near neighbours whose primitives touch in many configurations.

    Found by sampling configurations (parents and children are already left out by MuJoCo), seeded; near means at most
    two joints apart. With `self_collision` off, every pair outside the hand is excluded too.
    """
    spec = mujoco.MjSpec()
    _add_links(spec, robot, MjcfOptions())
    model = spec.compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    count: dict[tuple[int, int], int] = {}
    for k in range(_SAMPLES):
        data.qpos[:] = robot.q_home if k == 0 else rng.uniform(robot.q_min, robot.q_max)
        data.qpos[joints.BASE] = 0.0
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        pairs = {tuple(sorted(p)) for p in model.geom_bodyid[data.contact.geom[: data.ncon]].tolist()}
        for pair in pairs:
            count[pair] = count.get(pair, 0) + 1
    names = [model.body(i).name for i in range(model.nbody)]
    often = {pair for pair, hits in count.items() if hits > _OFTEN_TOUCHING * _SAMPLES}
    links = [robot.link(name) for name in names]
    excluded = {(a, b) for a, b in often if len(moving_joints(robot, links[a], links[b])) <= 2}
    if not self_collision:
        body = [i for i, name in enumerate(names) if i > 0 and not name.startswith("hand_")]
        hand = [i for i, name in enumerate(names) if name.startswith("hand_")]
        excluded |= {(min(a, b), max(a, b)) for a in body for b in body + hand if a != b}
    return tuple((names[a], names[b]) for a, b in sorted(excluded))


def add_contact_sensors(spec: mujoco.MjSpec, target: str, distractors: Sequence[str]) -> tuple[str, ...]:
    """Add the contact sensors that observations, rewards and success read; return their names in order.

    Each has `CONTACT_VALUES` values: number of contacts, and net force (N, world frame) on the second-named body.

    - `tip_<finger>`: fingertip link on the target; `finger_<finger>`: the whole finger on it; `palm`: the palm on it.
    - `robot_target`: all of the robot on the target; `support_target`: the static scene on the target.
    - `robot_support`, `hand_support`: robot (hand included) and hand on the static scene.
    - `robot_distractor_<i>`, `hand_distractor_<i>`: the same on each distractor.
    """
    body, subtree = mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_XBODY
    rows: list[tuple[str, mujoco.mjtObj, str, str]] = []
    for finger in joints.FINGERS:
        rows.append((f"tip_{finger}", body, joints.FINGER_TIP[finger], target))
        rows.append((f"finger_{finger}", subtree, joints.FINGER_ROOT[finger], target))
    rows += [
        ("palm", body, "hand_palm", target),
        ("robot_target", subtree, "base", target),
        ("support_target", body, "world", target),
        ("robot_support", subtree, "base", "world"),
        ("hand_support", subtree, "hand_palm", "world"),
    ]
    for i, name in enumerate(distractors):
        rows += [(f"robot_distractor_{i}", subtree, "base", name), (f"hand_distractor_{i}", subtree, "hand_palm", name)]
    for name, kind, first, second in rows:
        spec.add_sensor(
            name=name,
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=kind,
            objname=first,
            reftype=body,
            refname=second,
            intprm=[FORCE_DATA, NET_FORCE, 1],
        )
    return tuple(row[0] for row in rows)


def robot_spec(options: MjcfOptions | None = None) -> mujoco.MjSpec:
    """A spec that holds the robot alone."""
    options = options or MjcfOptions()
    spec = mujoco.MjSpec()
    spec.modelname = "wbm"
    build_robot(spec, load_robot(options.facts), options)
    return spec

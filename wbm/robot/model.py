"""The robot as one kinematic tree with limits, frames and collision geometry (NumPy only).

How the parts are mounted on each other is this project's own choice: the arm stands on the base's front half, the
LEAP hand's palm faces along the flange axis (so that fingers and thumb close around what the flange points at), the
neck stands on a mast at the rear left, the LiDAR at the front right corner.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from wbm.robot import joints
from wbm.robot.facts import Inertial, PartLink, load_facts, part_links, quat_to_mat, unit_quat
from wbm.robot.geometry import Geom, robot_geoms

FIXED, HINGE, SLIDE = 0, 1, 2

ARM_MOUNT = (0.08, 0.0, 0.335)
NECK_MOUNT = (-0.15, 0.15, 0.525)
LIDAR_MOUNT = (0.185, -0.185, 0.3575)
HAND_MOUNT_POS = (-0.030, 0.0225, 0.034)  # palm origin in the flange frame: the grasp centre lies on its z axis
HAND_MOUNT_QUAT = (0.0, 0.0, 1.0, 0.0)  # palm -z along the flange z, fingers forward in the ready pose
CAMERA_MASS = 0.072 + 0.1  # D435 and its bracket replace the PiPER's gripper (1.2 kg link6)

BASE_RANGE = np.array([[-10.0, 10.0], [-10.0, 10.0], [-2 * np.pi, 2 * np.pi]])
BASE_KP, BASE_KV = np.array([2.0e4, 2.0e4, 4.0e3]), np.array([2.0e3, 2.0e3, 4.0e2])
BASE_EFFORT = np.array([400.0, 400.0, 120.0])
NECK_KP, NECK_KV, NECK_EFFORT = 300.0, 30.0, 25.0
HAND_EFFORT = 0.95  # N m, stall torque of the LEAP's Dynamixel XC330-M288 at 5 V

Q_HOME = np.concatenate(
    [
        [0.0, 0.0, 0.0],
        [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785],
        [0.3, 0.0, 0.4, 0.3] * 3,
        [0.9, 0.9, 0.2, 0.2],
        [0.26, 2.10, -2.24, -0.74, 0.97, 0.83],  # looks at (0.8, 0, 0.62), 5 cm clear of the arm
    ]
)


@dataclass(frozen=True)
class Frame:
    """A named frame fixed to link `link` (index) at `pos` (m), `quat` (w x y z)."""

    link: int
    pos: np.ndarray
    quat: np.ndarray


@dataclass(frozen=True, eq=False)  # identity hash: what derives from a model is cached by it
class RobotModel:
    """Kinematic tree of L links over 32 joints; see `docs/architecture.md` for the meaning of each field.

    Shapes: `parent`, `joint_type`, `joint_index` [L]; `link_pos`, `joint_axis` [L,3]; `link_quat` [L,4] (w x y z);
    limits and gains [32]. Units: m, rad, s, N or N m.
    """

    link_names: tuple[str, ...]
    parent: np.ndarray
    link_pos: np.ndarray
    link_quat: np.ndarray
    joint_type: np.ndarray
    joint_axis: np.ndarray
    joint_index: np.ndarray
    inertials: tuple[Inertial | None, ...]
    joint_names: tuple[str, ...]
    q_min: np.ndarray
    q_max: np.ndarray
    qd_max: np.ndarray
    qdd_max: np.ndarray
    effort: np.ndarray
    kp: np.ndarray
    kv: np.ndarray
    armature: np.ndarray
    damping: np.ndarray
    frictionloss: np.ndarray
    q_home: np.ndarray
    frames: dict[str, Frame]
    geoms: tuple[Geom, ...]

    def link(self, name: str) -> int:
        """Index of a link by name."""
        return self.link_names.index(name)


@dataclass
class _Dof:
    """Per-joint numbers gathered while the tree is built."""

    rng: tuple[float, float]
    kp: float
    kv: float
    effort: float
    armature: float = 0.0
    damping: float = 0.0
    frictionloss: float = 0.0


class _Tree:
    def __init__(self) -> None:
        self.names: list[str] = []
        self.rows: list[tuple] = []
        self.dofs: dict[str, _Dof] = {}

    def add(self, name, parent, pos, quat, inertial=None, joint=None, kind=FIXED, axis=(0, 0, 1)) -> None:
        index = joints.JOINT_NAMES.index(joint) if joint else -1
        parent_index = self.names.index(parent) if parent else -1
        self.names.append(name)
        self.rows.append((parent_index, pos, unit_quat(quat), kind, axis, index, inertial))

    def add_part(self, prefix: str, links: tuple[PartLink, ...], parent: str, pos, quat, dof_of) -> None:
        for link in links:
            root = link.parent is None
            joint = f"{prefix}_{link.joint['name']}" if link.joint else None
            self.add(
                f"{prefix}_{link.name}",
                parent if root else f"{prefix}_{link.parent}",
                pos if root else link.pos,
                quat if root else link.quat,
                link.inertial,
                joint,
                HINGE if joint else FIXED,
                link.joint["axis"] if link.joint else (0, 0, 1),
            )
            if joint:
                self.dofs[joint] = dof_of(link.joint)


@cache
def load_robot() -> RobotModel:
    """Assemble base, arm, hand and neck into one model (cached: the result is immutable)."""
    facts = load_facts()
    tree = _Tree()
    identity = (1.0, 0.0, 0.0, 0.0)
    tree.add("world", None, (0, 0, 0), identity)
    for i, (name, link, axis) in enumerate(
        [("base_x", "base_x", (1, 0, 0)), ("base_y", "base_y", (0, 1, 0)), ("base_yaw", "base", (0, 0, 1))]
    ):
        parent = ("world", "base_x", "base_y")[i]
        inertial = _base_inertial(facts) if link == "base" else None
        tree.add(link, parent, (0, 0, 0), identity, inertial, name, HINGE if i == 2 else SLIDE, axis)
        tree.dofs[name] = _Dof(tuple(BASE_RANGE[i]), BASE_KP[i], BASE_KV[i], BASE_EFFORT[i])
    tree.add("lidar_body", "base", LIDAR_MOUNT, identity, _lidar_inertial(facts))

    panda = {a["joint"]: a for a in facts["panda"]["actuators"]}

    def arm_dof(joint: dict) -> _Dof:
        act = panda[joint["name"]]
        kv = -float(str(act["biasprm"]).split()[2])
        effort = float(str(act["forcerange"]).split()[1])
        return _Dof(tuple(joint["range"]), float(act["gainprm"]), kv, effort, joint["armature"], joint["damping"])

    tree.add_part("arm", part_links("panda"), "base", ARM_MOUNT, identity, arm_dof)

    leap = {a["joint"]: a for a in facts["leap_right"]["actuators"]}

    def hand_dof(joint: dict) -> _Dof:
        act = leap[joint["name"]]
        return _Dof(
            tuple(joint["range"]),
            float(act["kp"]),
            float(act["kv"]),
            HAND_EFFORT,
            0.0,
            joint["damping"],
            joint["frictionloss"],
        )

    tree.add_part("hand", part_links("leap_right"), "arm_attachment", HAND_MOUNT_POS, HAND_MOUNT_QUAT, hand_dof)

    loss = facts["piper"]["joint_armature_damping_frictionloss_published"]

    def neck_dof(joint: dict) -> _Dof:
        return _Dof(
            tuple(joint["range"]),
            NECK_KP,
            NECK_KV,
            NECK_EFFORT,
            loss["armature"],
            loss["damping"],
            loss["frictionloss"],
        )

    neck = tuple(_with_camera(link) for link in part_links("piper"))
    tree.add_part("neck", neck, "base", NECK_MOUNT, identity, neck_dof)
    return _finish(tree)


def _finish(tree: _Tree) -> RobotModel:
    rows = list(zip(*tree.rows, strict=True))
    dofs = [tree.dofs[name] for name in joints.JOINT_NAMES]
    rng = np.array([d.rng for d in dofs])

    def frame(link: str, pos=(0.0, 0.0, 0.0), quat=(1.0, 0.0, 0.0, 0.0)) -> Frame:
        return Frame(tree.names.index(link), np.asarray(pos, float), unit_quat(quat))

    # The grasp frame E: z = -z_palm (approach), x = x_palm (stretched fingers), centred between fingers and thumb.
    frames = {
        "ee": frame("hand_palm", (-0.030, -0.0225, -0.085), (0.0, 1.0, 0.0, 0.0)),
        "palm": frame("hand_palm"),
        "camera": frame("neck_link6", (0.0, 0.0, 0.0425), CAMERA_QUAT),
        "lidar": frame("lidar_body"),
        "base": frame("base"),
        "tip_index": frame("hand_if_ds", (0.0, -0.036, 0.015)),
        "tip_middle": frame("hand_mf_ds", (0.0, -0.036, 0.015)),
        "tip_ring": frame("hand_rf_ds", (0.0, -0.036, 0.015)),
        "tip_thumb": frame("hand_th_ds", (0.0, -0.045, -0.015)),
    }
    return RobotModel(
        link_names=tuple(tree.names),
        parent=np.array(rows[0], dtype=np.int32),
        link_pos=np.array(rows[1], dtype=np.float64),
        link_quat=np.array(rows[2], dtype=np.float64),
        joint_type=np.array(rows[3], dtype=np.int32),
        joint_axis=np.array(rows[4], dtype=np.float64),
        joint_index=np.array(rows[5], dtype=np.int32),
        inertials=tuple(rows[6]),
        joint_names=joints.JOINT_NAMES,
        q_min=rng[:, 0],
        q_max=rng[:, 1],
        qd_max=joints.QD_MAX.copy(),
        qdd_max=joints.QDD_MAX.copy(),
        effort=np.array([d.effort for d in dofs]),
        kp=np.array([d.kp for d in dofs]),
        kv=np.array([d.kv for d in dofs]),
        armature=np.array([d.armature for d in dofs]),
        damping=np.array([d.damping for d in dofs]),
        frictionloss=np.array([d.frictionloss for d in dofs]),
        q_home=Q_HOME.copy(),
        frames=frames,
        geoms=robot_geoms(),
    )


# The camera looks along link6's z; its x (image right) is link6's -y, so that the image is upright at home.
CAMERA_QUAT = (0.70710678, 0.0, 0.0, -0.70710678)


def _base_inertial(facts: dict) -> Inertial:
    """A solid box of the published mass over the body's published bounds."""
    lo = np.array(facts["tidybot2_base"]["parts_aabb_m"]["body"]["min"])
    hi = np.array(facts["tidybot2_base"]["parts_aabb_m"]["body"]["max"])
    return _box_inertial(facts["tidybot2_base"]["mass"], (lo + hi) / 2, hi - lo)


def _lidar_inertial(facts: dict) -> Inertial:
    return _box_inertial(facts["unitree_l2"]["mass_kg"], np.zeros(3), np.array([0.075, 0.075, 0.065]))


def _box_inertial(mass: float, com: np.ndarray, size: np.ndarray) -> Inertial:
    s = size**2
    return Inertial(mass, com, np.diag([s[1] + s[2], s[0] + s[2], s[0] + s[1]]) * mass / 12.0)


def _with_camera(link: PartLink) -> PartLink:
    """link6 carries the D435 in place of the gripper that its published inertia includes."""
    if link.name != "link6":
        return link
    inertial = _box_inertial(CAMERA_MASS, np.array([0.0, 0.0, 0.02]), np.array([0.025, 0.09, 0.045]))
    return PartLink(link.name, link.parent, link.pos, link.quat, inertial, link.joint, link.boxes)


def forward_kinematics(robot: RobotModel, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World poses of all links, float64: the oracle for the Warp kernels.

    Args:
        q: joint positions [32], m or rad.

    Returns:
        `R_WL` [L,3,3] and `p_WL` [L,3].
    """
    num = len(robot.link_names)
    rot, pos = np.zeros((num, 3, 3)), np.zeros((num, 3))
    rot[0] = np.eye(3)
    local = quat_to_mat(robot.link_quat)
    for i in range(1, num):
        p = robot.parent[i]
        pos[i] = pos[p] + rot[p] @ robot.link_pos[i]
        rot[i] = rot[p] @ local[i]
        if robot.joint_type[i] == SLIDE:
            pos[i] = pos[i] + rot[i] @ (robot.joint_axis[i] * q[robot.joint_index[i]])
        elif robot.joint_type[i] == HINGE:
            rot[i] = rot[i] @ axis_angle_to_mat(robot.joint_axis[i], q[robot.joint_index[i]])  # pyright: ignore[reportArgumentType]
    return rot, pos


def frame_poses(robot: RobotModel, q: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """World pose (R [3,3], p [3]) of every named frame at `q` [32]."""
    rot, pos = forward_kinematics(robot, q)
    return {
        name: (rot[f.link] @ quat_to_mat(f.quat), pos[f.link] + rot[f.link] @ f.pos) for name, f in robot.frames.items()
    }


def axis_angle_to_mat(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' formula for a unit axis [3] and an angle in rad."""
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew

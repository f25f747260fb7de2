"""The kinematic tree against MuJoCo, fed with the published numbers directly."""

import mujoco
import numpy as np
import pytest

from wbm.robot import joints, model
from wbm.robot.facts import parse_facts
from wbm.robot.rotations import quat_to_mat

TOLERANCE = 1e-6  # m and rad: what the project promises against the published descriptions
FACTS = parse_facts().value
PARTS = [("panda", "arm"), ("leap_right", "hand"), ("piper", "neck")]


def part_model(part):
    """A part's bodies and joints as MJCF text written straight from the facts, compiled by MuJoCo."""

    def numbers(values):
        return " ".join(repr(float(v)) for v in values)

    def body(node):
        pose = "".join(f' {k}="{numbers(node[k])}"' for k in ("pos", "quat") if k in node)
        text = f'<body name="{node["name"]}"{pose}>'
        if "joint" in node:
            joint = node["joint"]
            text += f'<joint name="{joint["name"]}" axis="{numbers(joint["axis"])}" range="{numbers(joint["range"])}"/>'
        inertial = node.get("inertial")
        if inertial:
            kind = "fullinertia" if "fullinertia" in inertial else "diaginertia"
            quat = f' quat="{numbers(inertial["quat"])}"' if "quat" in inertial else ""
            text += f'<inertial pos="{numbers(inertial["com"])}" mass="{inertial["mass"]}"{quat} '
            text += f'{kind}="{numbers(inertial[kind])}"/>'
        return text + "".join(body(child) for child in node.get("children", ())) + "</body>"

    bodies = "".join(body(node) for node in FACTS[part]["bodies"])
    text = f'<mujoco><compiler angle="radian"/><worldbody>{bodies}</worldbody></mujoco>'
    return mujoco.MjModel.from_xml_string(text)


@pytest.fixture(scope="module")
def robot():
    return model.load_robot()


@pytest.mark.parametrize(("part", "prefix"), PARTS)
def test_forward_kinematics_agrees_with_the_published_numbers(robot, part, prefix):
    physics = part_model(part)
    data = mujoco.MjData(physics)
    rng = np.random.default_rng(3)
    names = [physics.joint(i).name for i in range(physics.njnt)]
    columns = [robot.joint_names.index(f"{prefix}_{name}") for name in names]
    root = physics.body(1).name
    root_pose = physics.body(1).pos, quat_to_mat(physics.body(1).quat)
    for _ in range(50):
        q = rng.uniform(robot.q_min, robot.q_max)
        rot, pos = model.forward_kinematics(robot, q)
        data.qpos[:] = q[columns]
        mujoco.mj_kinematics(physics, data)
        base = robot.link(f"{prefix}_{root}")
        for i in range(1, physics.nbody):
            link = robot.link(f"{prefix}_{physics.body(i).name}")
            R, p = rot[base].T @ rot[link], rot[base].T @ (pos[link] - pos[base])
            expected_R = root_pose[1].T @ data.xmat[i].reshape(3, 3)
            expected_p = root_pose[1].T @ (data.xpos[i] - root_pose[0])
            np.testing.assert_allclose(p, expected_p, atol=TOLERANCE)
            off = R.T @ expected_R - expected_R.T @ R  # twice the sine of the angle, times the axis
            assert np.linalg.norm([off[2, 1], off[0, 2], off[1, 0]]) / 2 < TOLERANCE
            assert np.trace(R.T @ expected_R) > 2.9


@pytest.mark.parametrize(("part", "prefix"), PARTS)
def test_masses_inertias_and_limits_are_the_published_ones(robot, part, prefix):
    physics = part_model(part)
    for i in range(1, physics.nbody):
        name = physics.body(i).name
        inertial = robot.inertials[robot.link(f"{prefix}_{name}")]
        if f"{prefix}_{name}" == "neck_link6":
            assert inertial.mass == pytest.approx(FACTS["realsense_d435"]["mass_kg"] + 0.1)
            continue
        mass = inertial.mass if inertial else 0.0
        assert mass == pytest.approx(physics.body_mass[i], abs=1e-12)
        if inertial:
            np.testing.assert_allclose(
                np.sort(np.linalg.eigvalsh(inertial.inertia)), np.sort(physics.body_inertia[i]), rtol=1e-6, atol=1e-12
            )
            np.testing.assert_allclose(inertial.com, physics.body_ipos[i], atol=1e-12)
    for i in range(physics.njnt):
        j = robot.joint_names.index(f"{prefix}_{physics.joint(i).name}")
        np.testing.assert_allclose([robot.q_min[j], robot.q_max[j]], physics.jnt_range[i], atol=1e-12)


def test_joint_order_and_groups(robot):
    assert len(robot.joint_names) == joints.NUM_JOINTS == 32
    assert robot.joint_names[:4] == ("base_x", "base_y", "base_yaw", "arm_joint1")
    assert robot.joint_names[joints.HAND][:5] == (
        "hand_if_mcp",
        "hand_if_rot",
        "hand_if_pip",
        "hand_if_dip",
        "hand_mf_mcp",
    )
    assert robot.joint_names[joints.HAND][-4:] == ("hand_th_cmc", "hand_th_axl", "hand_th_mcp", "hand_th_ipl")
    assert robot.joint_names[joints.NECK] == tuple(f"neck_joint{i}" for i in range(1, 7))
    assert len(joints.WBC) == 16
    moving = robot.joint_index[robot.joint_index >= 0]
    assert sorted(moving.tolist()) == list(range(32))


def test_home_is_inside_the_limits_and_looks_ahead(robot):
    assert (robot.q_home >= robot.q_min).all() and (robot.q_home <= robot.q_max).all()
    frames = model.frame_poses(robot, robot.q_home)
    R, p = frames["camera"]
    target = np.array([0.8, 0.0, 0.62])
    assert (target - p) @ R[:, 2] > 0.99 * np.linalg.norm(target - p)
    assert abs(R[2, 0]) < 0.05  # the image is upright
    ee, _ = frames["ee"]
    np.testing.assert_allclose(ee[:, 2], [0, 0, -1], atol=1e-3)


def test_parents_come_first_and_quaternions_are_unit(robot):
    assert robot.parent[0] == -1
    assert (robot.parent[1:] < np.arange(1, len(robot.parent))).all()
    np.testing.assert_allclose(np.linalg.norm(robot.link_quat, axis=1), 1.0, atol=1e-12)

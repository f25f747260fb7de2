"""The MJCF that the robot becomes: order, frames, servos, collisions, contact sensors, export."""

import json
import sys
import types

import mujoco
import numpy as np
import pytest

from wbm.robot import export, joints, mjcf, model, skin, spheres
from wbm.robot.config import MjcfOptions


@pytest.fixture(scope="module")
def robot():
    return model.load_robot()


@pytest.fixture(scope="module")
def physics():
    return mjcf.robot_spec().compile()


def test_joints_and_actuators_are_in_order(robot, physics):
    assert tuple(physics.joint(i).name for i in range(physics.njnt)) == robot.joint_names
    assert tuple(physics.actuator(i).name for i in range(physics.nu)) == robot.joint_names
    np.testing.assert_allclose(physics.actuator_trnid[:, 0], np.arange(32))
    np.testing.assert_allclose(physics.actuator_gainprm[:, 0], robot.kp)
    np.testing.assert_allclose(physics.actuator_biasprm[:, :3], np.stack([0 * robot.kp, -robot.kp, -robot.kv], axis=1))
    np.testing.assert_allclose(physics.jnt_range, np.stack([robot.q_min, robot.q_max], axis=1))
    np.testing.assert_allclose(physics.actuator_forcerange[:, 1], robot.effort)


def test_mass_and_armature(robot, physics):
    assert physics.body_subtreemass[0] == pytest.approx(sum(i.mass for i in robot.inertials if i))
    np.testing.assert_allclose(physics.dof_armature[joints.ARM], robot.armature[joints.ARM] + 2.0)
    plain = mjcf.robot_spec(MjcfOptions(arm_armature_extra=0.0)).compile()
    np.testing.assert_allclose(plain.dof_armature, robot.armature)


def test_sites_are_the_frames(robot, physics):
    data = mujoco.MjData(physics)
    rng = np.random.default_rng(0)
    for _ in range(30):
        data.qpos[:] = rng.uniform(robot.q_min, robot.q_max)
        mujoco.mj_kinematics(physics, data)
        for name, (R, p) in model.frame_poses(robot, data.qpos).items():
            np.testing.assert_allclose(data.site(name).xpos, p, atol=1e-9)
            np.testing.assert_allclose(data.site(name).xmat.reshape(3, 3), R, atol=1e-9)


def test_batched_kinematics_equals_the_single_one(robot):
    q = spheres.sample_configurations(robot, 5, seed=4)
    rot, pos = spheres.batched_kinematics(robot, q)
    for k in range(5):
        R, p = model.forward_kinematics(robot, q[k])
        np.testing.assert_allclose(rot[k], R, atol=1e-12)
        np.testing.assert_allclose(pos[k], p, atol=1e-12)


def test_home_is_held_without_gravity_sag(robot, physics):
    data = mujoco.MjData(physics)
    data.qpos[:], data.ctrl[:] = robot.q_home, robot.q_home
    physics.opt.timestep, physics.opt.integrator = 0.004, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    mujoco.mj_step(physics, data, 250)
    np.testing.assert_allclose(data.qpos, robot.q_home, atol=1e-4)


def test_excluded_pairs_are_near_neighbours(robot):
    pairs = mjcf.excluded_pairs(robot)
    assert pairs
    for a, b in pairs:
        assert len(spheres.moving_joints(robot, robot.link(a), robot.link(b))) <= 2
    everything = mjcf.excluded_pairs(robot, False)
    assert ("base", "arm_link5") in everything and ("hand_if_ds", "hand_th_ds") not in everything


def scene_with_ball(robot, tip):
    """The robot with a ball just in front of a fingertip, a wall beyond it, and a distractor away from all."""
    spec = mjcf.robot_spec()
    place = model.frame_poses(robot, robot.q_home)[tip][1]
    for name, pos in (("target", place + np.array([0.0, 0.0, -0.03])), ("clutter", np.array([3.0, 0, 1.0]))):
        body = spec.worldbody.add_body(name=name, pos=pos, gravcomp=1.0)
        body.add_freejoint()
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.025, 0, 0], mass=0.1, contype=2, conaffinity=7)
    spec.worldbody.add_geom(
        name="wall", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.2, 0.2, 0.01], contype=4, conaffinity=0
    )
    spec.geom("wall").pos = place + np.array([0.0, 0.0, -0.062])
    names = mjcf.add_contact_sensors(spec, "target", ["clutter"])
    return spec.compile(), names


def test_contact_sensors_give_the_net_force(robot):
    physics, names = scene_with_ball(robot, "tip_index")
    data = mujoco.MjData(physics)
    data.qpos[:32] = robot.q_home
    data.ctrl[:] = robot.q_home
    physics.opt.timestep = 0.002
    mujoco.mj_step(physics, data, 40)
    mujoco.mj_forward(physics, data)
    expected = {name: np.zeros(3) for name in names}
    count = {name: 0 for name in names}
    target = physics.body("target").id
    for i in range(data.ncon):
        first, second = physics.geom_bodyid[data.contact.geom[i]]
        wrench = np.zeros(6)
        mujoco.mj_contactForce(physics, data, i, wrench)
        force = data.contact.frame[i].reshape(3, 3).T @ wrench[:3]  # on the second geom
        if target not in (first, second):
            continue
        other = second if first == target else first
        force = force if second == target else -force
        name = physics.body(other).name
        keys = ["support_target"] if other == 0 else ["robot_target"]
        keys += ["tip_index"] if name == "hand_if_ds" else []
        keys += ["finger_index"] if name.startswith("hand_if_") else []
        for key in keys:
            expected[key] += force
            count[key] += 1
    assert count["tip_index"] == 1 and count["support_target"] == 1
    for name in names:
        values = data.sensor(name).data
        assert values.shape == (mjcf.CONTACT_VALUES,)
        assert values[0] == count[name]
        np.testing.assert_allclose(values[1:], expected[name], atol=1e-6)
    assert data.sensor("tip_index").data[3] < 0 < data.sensor("support_target").data[3]


def test_export_opens_and_agrees(robot, tmp_path):
    path = tmp_path / "deep" / "robot.xml"
    export.export_robot(path)
    loaded = mujoco.MjModel.from_xml_path(str(path))
    assert tuple(loaded.joint(i).name for i in range(loaded.njnt)) == robot.joint_names
    data = mujoco.MjData(loaded)
    mujoco.mj_resetDataKeyframe(loaded, data, 0)
    mujoco.mj_forward(loaded, data)
    np.testing.assert_allclose(data.qpos, robot.q_home, atol=1e-6)
    assert data.ncon == 0
    for name, (_, p) in model.frame_poses(robot, data.qpos).items():
        np.testing.assert_allclose(data.site(name).xpos, p, atol=1e-6)


def test_description_is_complete_and_json(robot):
    facts = json.loads(json.dumps(export.describe_robot()))
    assert [j["name"] for j in facts["joints"]] == list(robot.joint_names)
    assert facts["mass"] == pytest.approx(sum(i.mass for i in robot.inertials if i))
    assert len(facts["spheres"]) == len(spheres.robot_spheres(robot))
    text = export.format_robot()
    assert all(name in text for name in robot.joint_names)


def test_sphere_visuals_do_not_collide(robot):
    spec = export.standalone_spec(spheres=True)
    physics = spec.compile()
    count = len(spheres.robot_spheres(robot))
    ids = [i for i in range(physics.ngeom) if physics.geom(i).name.startswith("sphere_")]
    assert len(ids) == count
    assert not physics.geom_contype[ids].any() and not physics.geom_conaffinity[ids].any()


def test_menagerie_without_meshes_says_how_to_get_them(monkeypatch, tmp_path):
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    with pytest.raises(FileNotFoundError, match="MENAGERIE_ROOT"):
        export.export_robot(tmp_path / "robot.xml", MjcfOptions(skin="menagerie"))
    monkeypatch.delenv("MENAGERIE_ROOT")
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", None)
    with pytest.raises(FileNotFoundError, match="pip install mujoco-menagerie"):
        export.export_robot(tmp_path / "robot.xml", MjcfOptions(skin="menagerie"))


TETRAHEDRON = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def stand_in_menagerie(root):
    """The published collection's layout and habits, with a tetrahedron for every mesh.

    Meshes are named by their files, some in subfolders; some descriptions draw a colliding mesh (the LEAP's fingertips)
    or hold a transparent one (the PiPER's gripper); colours come from materials in default classes.
    """
    bodies = {"arm": "link3", "hand": "if_px", "neck": "link6", "base": "base_link"}
    for prefix, folder, _, file in skin.PARTS:
        (root / folder / "assets" / "sub").mkdir(parents=True)
        for name in ("sub/shell", "tip", "solid", "gripper"):
            (root / folder / "assets" / f"{name}.obj").write_text(TETRAHEDRON)
        (root / folder / file).write_text(
            '<mujoco><compiler meshdir="./assets/"/><default>'
            '<default class="visual">'
            '<geom type="mesh" contype="0" conaffinity="0" group="2" material="paint"/></default>'
            '<default class="tip"><geom type="mesh" mesh="soft" material="paint"/></default></default>'
            '<asset><mesh file="sub/shell.obj"/><mesh name="soft" file="tip.obj"/><mesh file="solid.obj"/>'
            '<mesh file="gripper.obj"/><material name="paint" rgba="1 0 0 1"/></asset><worldbody>'
            f'<body name="{bodies[prefix]}"><geom class="visual" mesh="shell"/><geom class="tip"/>'
            '<geom type="mesh" mesh="solid" group="3"/><geom type="mesh" mesh="gripper" rgba="1 1 1 0"/>'
            '<body name="unknown"><geom class="visual" mesh="shell"/></body></body></worldbody></mujoco>'
        )


def test_menagerie_skin_is_visual_only(monkeypatch, tmp_path):
    stand_in_menagerie(tmp_path)
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    plain = export.standalone_spec().compile()
    dressed = export.standalone_spec(MjcfOptions(skin="menagerie")).compile()
    assert dressed.ngeom == plain.ngeom + 8 and dressed.nmesh == 8  # shell and tip of four parts
    assert dressed.body_mass.sum() == pytest.approx(plain.body_mass.sum())
    added = np.flatnonzero(dressed.geom_group == skin.SKIN_GROUP)
    assert not dressed.geom_contype[added].any()
    bodies = {dressed.body(dressed.geom_bodyid[g]).name for g in added}
    assert bodies == {"arm_link3", "hand_if_px", "neck_link6", "base"}
    np.testing.assert_allclose(dressed.geom_rgba[added], [[1, 0, 0, 1]] * 8)
    hidden = {dressed.geom(g).name for g in np.flatnonzero(dressed.geom_group == skin.HIDDEN_GROUP)}
    assert hidden == {"arm_link3_c", "hand_if_px_box", "base_body"}  # the camera and the mast have no mesh
    path = tmp_path / "out" / "robot.xml"
    export.export_robot(path, MjcfOptions(skin="menagerie"))
    monkeypatch.chdir(tmp_path)
    assert mujoco.MjModel.from_xml_path(str(path)).nmesh == 8


def test_menagerie_of_another_layout_is_refused(monkeypatch, tmp_path):
    stand_in_menagerie(tmp_path)
    path = tmp_path / "leap_hand" / "right_hand.xml"
    path.write_text(path.read_text().replace('"if_px"', '"finger"'))
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    with pytest.raises(ValueError, match=r"right_hand\.xml has no mesh for the robot's hand"):
        export.standalone_spec(MjcfOptions(skin="menagerie"))


def test_menagerie_package_offline_says_what_to_do(monkeypatch, tmp_path):
    """The package's interface: `get(name).xml(entry)` downloads, and raises its own error when it cannot."""

    class MenagerieError(Exception):
        pass

    class Robot:
        def xml(self, entry):
            assert entry == "panda_nohand"
            raise MenagerieError("Name or service not known")

    package = types.SimpleNamespace(MenagerieError=MenagerieError, get=lambda name: Robot())
    monkeypatch.delenv("MENAGERIE_ROOT", raising=False)
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", package)
    with pytest.raises(FileNotFoundError, match=r"franka_emika_panda cannot be had .* set MENAGERIE_ROOT"):
        export.export_robot(tmp_path / "robot.xml", MjcfOptions(skin="menagerie"))


@pytest.mark.parametrize("bad", [{"arm_armature_extra": -1.0}, {"hand_effort": -0.1}, {"skin": "chrome"}])
def test_bad_options_are_refused(bad):
    with pytest.raises(ValueError, match="robot"):
        MjcfOptions(**bad)

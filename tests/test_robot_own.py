"""A robot of one's own: a facts file laid over the standard ones, from the file to the assets."""

import copy
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.cli import main
from wbm.robot import export, joints, model
from wbm.robot.config import MjcfOptions
from wbm.robot.facts import FactsError
from wbm.robot.rotations import unit_quat
from wbm.scenes.assets import load_assets

ROOT = Path(__file__).parents[1]
LONG_ARM = ROOT / "docs" / "examples" / "long_arm.yaml"
NARROW_HAND = ROOT / "docs" / "examples" / "narrow_hand.yaml"


def written(tmp_path, text):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    return path


def test_another_arm_is_followed_by_tree_physics_and_frames():
    robot, standard = model.load_robot(LONG_ARM), model.load_robot()
    assert np.linalg.norm(robot.link_pos[robot.link("arm_link3")]) == pytest.approx(0.36)
    assert robot.q_min[6] == -2.9 and standard.q_min[6] == -3.0718
    np.testing.assert_array_equal(robot.q_max[joints.HAND], standard.q_max[joints.HAND])
    physics = export.standalone_spec(MjcfOptions(facts=str(LONG_ARM))).compile()
    data = mujoco.MjData(physics)
    rng = np.random.default_rng(0)
    for _ in range(20):
        data.qpos[:] = rng.uniform(robot.q_min, robot.q_max)
        mujoco.mj_kinematics(physics, data)
        for name, (R, p) in model.frame_poses(robot, data.qpos).items():
            np.testing.assert_allclose(data.site(name).xpos, p, atol=1e-9)
            np.testing.assert_allclose(data.site(name).xmat.reshape(3, 3), R, atol=1e-9)
    mujoco.mj_resetDataKeyframe(physics, data, 0)
    mujoco.mj_forward(physics, data)
    assert data.ncon == 0  # the home pose is clear
    reach = [np.linalg.norm(model.frame_poses(r, np.zeros(32))["ee"][1]) for r in (robot, standard)]
    assert reach[0] == pytest.approx(reach[1] + 0.08, abs=0.02)


def test_other_limits_of_the_hand_reach_the_actuators():
    robot, standard = model.load_robot(NARROW_HAND), model.load_robot()
    physics = export.standalone_spec(MjcfOptions(facts=str(NARROW_HAND))).compile()
    assert (robot.q_max[joints.HAND] < standard.q_max[joints.HAND]).all()
    np.testing.assert_allclose(physics.actuator_ctrlrange[joints.HAND, 1], robot.q_max[joints.HAND])
    np.testing.assert_allclose(physics.actuator_forcerange[joints.HAND, 1], 0.6)
    np.testing.assert_allclose(physics.actuator_gainprm[joints.HAND, 0], 2.0)
    np.testing.assert_array_equal(robot.link_pos, standard.link_pos)


def test_the_content_of_a_file_decides_not_its_name(tmp_path):
    path = written(tmp_path, "mounts: {arm: {pos: [0.1, 0.0, 0.3]}}")
    first = model.load_robot(path)
    assert model.load_robot(path) is first
    np.testing.assert_allclose(first.link_pos[first.link("arm_link0")], [0.1, 0.0, 0.3])
    path.write_text("mounts: {arm: {pos: [0.1, 0.0, 0.4]}}")
    assert model.load_robot(path).link_pos[first.link("arm_link0"), 2] == 0.4


BAD = {
    "[": r"mine\.yaml: is not YAML",
    "- 1": r"must be a mapping with sections",
    "joint: {}": r"joint: is no section",
    "parts: {arm: nothing}": r"nothing is missing",
    "parts: {arm: leap_right}": r"leap_right: a part for arm must have the joints joint1, .*; it has if_mcp",
    "mounts: {hand: {link: flange}}": r"mounts\.hand\.link: no link is called flange",
    "mounts: {arm: {pos: [0, 1]}}": r"mounts\.arm\.pos: must be 3 finite numbers",
    "mounts: {arm: {quat: [0, 0, 0, 0]}}": r"mounts\.arm\.quat: .* not zero",
    "frames: {ee: {link: hand}}": r"frames\.ee\.link: no link is called hand",
    "frames: {ee: null}": r"frames: ee is missing",
    "joints: {arm: {home: [0, 9, 0, -2, 0, 1, 0]}}": r"joints\.arm\.home: arm_joint2 at 9 is outside its range",
    "joints: {arm: {velocity: 0}}": r"joints\.arm: .* must be positive",
    "joints: {arm: {range: [[0, 1]]}}": r"joints\.arm\.range: must be 7 times",
    "joints: {base: {range: [[1, 0], [0, 1], [0, 1]]}}": r"joints\.base\.range\[0\]: must be \[low, high\]",
    "joints: {neck: {kp: null}}": r"joints\.neck: kp is missing",
    "geometry: {arm: [{name: a, link: arm_link0}]}": r"geometry\.arm\[0\]: must have one of sphere",
    "geometry: {arm: [{name: a, link: elbow, sphere: 0.1}]}": r"geometry: a: no link is called elbow",
    "geometry: {arm: [{name: a, link: arm_link0, box: [1, 1, 0]}]}": r"geometry\.arm\[0\]\.box: half sizes",
    "geometry: {arm: [{name: a, link: base, capsule: 0.1, from: [0, 0, 0], to: [0, 0, 0]}]}": r"to: must differ",
    "geometry: {arm: [{name: neck_d435, link: base, sphere: 0.1}]}": r"a second geom called neck_d435",
    "inertials: {base: {mass: -1, com: [0, 0, 0], box: [1, 1, 1]}}": r"inertials\.base\.mass: .* above 0",
    "panda: {bodies: [{name: link0, joint: {name: joint1, axis: [0, 0, 2], range: [0, 1]}}]}": r"axis: must be a unit",
    "panda: {bodies: [{name: a, inertial: {mass: 1, com: [0, 0, 0], diaginertia: [1, 1, 9]}}]}": r"no body has this",
    "panda: {bodies: &b [{name: a, children: [{name: b, children: *b}]}]}": r"a second link called a",
}


@pytest.mark.parametrize("text", BAD)
def test_errors_name_file_and_field(text, tmp_path):
    with pytest.raises(FactsError, match=BAD[text]) as caught:
        model.load_robot(written(tmp_path, text))
    assert str(caught.value).startswith(str(tmp_path / "mine.yaml")) and "\n" not in str(caught.value)


def test_a_file_that_is_no_facts_file_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "large.yaml"
    with open(path, "wb") as stream:
        stream.truncate(2 << 20)
    with pytest.raises(FactsError, match="larger than 1 MB"):
        model.load_robot(path)
    with pytest.raises(FileNotFoundError):
        model.load_robot(tmp_path / "none.yaml")
    with pytest.raises(ValueError, match=r"leave it out with robot\.facts|robot\.facts"):
        MjcfOptions(skin="menagerie", facts="mine.yaml")


def leaves(tree, place=()):
    if isinstance(tree, (dict, list)):
        for key in tree if isinstance(tree, dict) else range(len(tree)):
            yield (*place, key)
            yield from leaves(tree[key], (*place, key))


TREE = yaml.safe_load(LONG_ARM.read_text())
PLACES = list(leaves(TREE))
ODD = st.one_of(
    st.none(), st.booleans(), st.integers(-3, 3), st.floats(), st.text(max_size=3), st.just([]), st.just({}),
    st.lists(st.floats(-2, 2), max_size=7), st.dictionaries(st.sampled_from(["name", "link", "bodies"]), st.integers()),
)  # fmt: skip


@settings(max_examples=80, deadline=None)
@given(st.sampled_from(PLACES), ODD)
def test_any_value_in_any_place_makes_a_robot_or_is_named(tmp_path_factory, place, value):
    node = tree = copy.deepcopy(TREE)
    for key in place[:-1]:
        node = node[key]
    node[place[-1]] = value
    path = tmp_path_factory.mktemp("facts") / "mine.yaml"
    path.write_text(yaml.safe_dump(tree))
    try:
        robot = model.load_robot(path)
    except FactsError as error:
        assert str(path) in str(error)
    else:
        assert (robot.q_min < robot.q_max).all() and (robot.q_home >= robot.q_min).all()
        for array in (robot.link_pos, robot.link_quat, robot.kp, robot.kv, robot.effort, robot.armature):
            assert np.isfinite(array).all()


def test_the_command_line_takes_a_robot_from_show_to_assets(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WBM_CACHE", str(tmp_path / "cache"))

    def wbm(*arguments):
        with pytest.raises(SystemExit) as stop:
            main([*arguments])
        return stop.value.code, *capsys.readouterr()

    facts = written(tmp_path, LONG_ARM.read_text())
    code, out, _ = wbm("robot", "show", "robot.facts=mine.yaml", "--json")
    assert code == 0 and json.loads(out)["joints"][6]["min"] == -2.9
    assert wbm("robot", "export", "robot.xml", "robot.facts=mine.yaml")[0] == 0
    assert mujoco.MjModel.from_xml_path("robot.xml").jnt_range[6, 0] == pytest.approx(-2.9)

    settings = ["objects.count=34", "scenes.count=1", "scenes.test_count=0", "scenes.kinds=[table]"]
    assert wbm("prepare-assets", *settings, "robot.facts=mine.yaml")[0] == 0
    (folder,) = (tmp_path / "artifacts" / "assets" / "procedural").glob("*/")
    assets = load_assets(folder)
    assert assets.robot.facts == facts.read_bytes() and assets.robot.q_min[6] == -2.9
    assert mujoco.MjModel.from_xml_path(str(folder / "robot.xml")).jnt_range[6, 0] == pytest.approx(-2.9)

    plan = ["plan", "--check", "--until", "prepare-assets", *settings]
    facts = facts.rename(tmp_path / "moved.yaml")
    assert wbm(*plan, "robot.facts=moved.yaml")[0] == 0  # the same facts elsewhere
    facts.write_text(LONG_ARM.read_text().replace("-2.9,", "-2.8,"))
    code, out, _ = wbm(*plan, "robot.facts=moved.yaml")
    assert code == 3 and "outside.robot.facts" in out
    facts.write_text("mounts: {arm: {pos: 1}}")
    assert wbm("robot", "show", "robot.facts=moved.yaml") == (
        1,
        "",
        "wbm: moved.yaml: mounts.arm.pos: must be 3 finite numbers\n",
    )


@pytest.mark.parametrize("scale", [1e-200, 1.0, 1.4e154, 1e300])
def test_a_quaternion_of_any_length_is_a_direction(scale):
    np.testing.assert_allclose(unit_quat(np.array([3.0, 0.0, -4.0, 0.0]) * scale), [0.6, 0.0, -0.8, 0.0], rtol=1e-12)

"""Collision spheres cover the geometry; the pair list holds what can touch and nothing rigid."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from wbm.robot import joints, mjcf, model, spheres
from wbm.robot.geometry import BOX, CAPSULE, CYLINDER
from wbm.robot.rotations import quat_to_mat

LONG_ARM = Path(__file__).parents[1] / "docs" / "examples" / "long_arm.yaml"


@pytest.fixture(scope="module")
def robot():
    return model.load_robot()


@pytest.fixture(scope="module")
def cover(robot):
    return spheres.robot_spheres(robot)


def surface_points(geom, count, rng):
    """Random points on a primitive's surface, link frame."""
    direction = rng.normal(size=(count, 3))
    if geom.type == BOX:
        half = np.array(geom.size)
        points = rng.uniform(-half, half, size=(count, 3))
        axis = rng.integers(0, 3, count)
        points[np.arange(count), axis] = np.sign(direction[:, 0]) * half[axis]
    elif geom.type in (CAPSULE, CYLINDER):
        radius, half = geom.size[:2]
        angle = rng.uniform(0, 2 * np.pi, count)
        z = rng.uniform(-half, half, count)
        points = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
        ends = rng.random(count) < 0.4
        side = np.where(z > 0, 1.0, -1.0)
        if geom.type == CAPSULE:
            cap = radius * direction / np.linalg.norm(direction, axis=1, keepdims=True)
            cap[:, 2] = np.abs(cap[:, 2]) * side + side * half
        else:
            cap = points * np.sqrt(rng.random(count))[:, None]
            cap[:, 2] = side * half
        points[ends] = cap[ends]
    else:
        points = geom.size[0] * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return points @ quat_to_mat(np.array(geom.quat)).T + np.array(geom.pos)


@pytest.mark.parametrize("facts", ["", LONG_ARM], ids=["standard", "own"])
def test_every_surface_point_is_within_5_mm_of_a_sphere(facts):
    robot = model.load_robot(facts)
    cover = spheres.robot_spheres(robot)
    rng = np.random.default_rng(1)
    worst = 0.0
    for geom in robot.geoms:
        points = surface_points(geom, 4000, rng)
        mine = cover.link == robot.link(geom.link)
        distance = np.linalg.norm(points[:, None] - cover.pos[mine], axis=2) - cover.radius[mine]
        worst = max(worst, distance.min(axis=1).max())
    assert worst <= 0.005
    assert worst > 0.002  # the covering is not simply one huge sphere


def test_number_of_spheres_and_their_fit(robot, cover):
    assert 35 <= len(cover) <= 64
    top = cover.pos[:, 2] + cover.radius
    base = [i for i, n in enumerate(cover.names) if n.startswith("base_body")]
    assert top[base].max() < 0.325 + 0.035  # tables reach over the base


def test_pairs_exclude_rigid_and_neighbouring_links(robot, cover):
    pairs = spheres.self_pairs(robot, cover)
    for a, b in pairs:
        path = spheres.moving_joints(robot, int(cover.link[a]), int(cover.link[b]))
        assert len(path) >= 2
        assert set(path) & set(joints.WBC.tolist())


def test_home_pose_is_clear_of_self_collision(robot, cover):
    centre = spheres.sphere_positions(robot, cover, robot.q_home[None])[0]
    a, b = spheres.self_pairs(robot, cover).T
    gap = np.linalg.norm(centre[a] - centre[b], axis=1) - cover.radius[a] - cover.radius[b]
    assert gap.min() > 0.02
    physics = mjcf.robot_spec().compile()
    data = mujoco.MjData(physics)
    data.qpos[:] = robot.q_home
    mujoco.mj_forward(physics, data)
    assert data.ncon == 0


def test_contacts_in_fresh_configurations_are_seen_by_the_pairs(robot, cover):
    """Whenever MuJoCo finds arm, neck, hand and base in contact, some listed sphere pair overlaps."""
    physics = mjcf.robot_spec().compile()
    data = mujoco.MjData(physics)
    pairs = spheres.self_pairs(robot, cover)
    group = np.array([spheres._group(robot, int(i)) for i in cover.link])
    q = spheres.sample_configurations(robot, 400, seed=99)
    centre = spheres.sphere_positions(robot, cover, q)
    a, b = pairs.T
    gap = np.linalg.norm(centre[:, a] - centre[:, b], axis=2) - cover.radius[a] - cover.radius[b]
    seen = missed = 0
    for k in range(len(q)):
        data.qpos[:] = q[k]
        mujoco.mj_kinematics(physics, data)
        mujoco.mj_comPos(physics, data)
        mujoco.mj_collision(physics, data)
        for geoms, depth in zip(data.contact.geom[: data.ncon], data.contact.dist[: data.ncon], strict=True):
            links = [robot.link(physics.body(physics.geom_bodyid[g]).name) for g in geoms]
            if depth > -0.005 or len({spheres._group(robot, i) for i in links}) == 1:
                continue
            if not set(spheres.moving_joints(robot, *links)) & set(joints.WBC.tolist()):
                continue
            groups = {spheres._group(robot, i) for i in links}
            mine = np.array([{x, y} == groups for x, y in zip(group[a], group[b], strict=True)])
            seen += 1
            missed += not (mine.any() and gap[k, mine].min() < 0)
    assert seen > 200
    assert missed <= 0.01 * seen

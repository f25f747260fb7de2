"""One template for all scenes: loading a scene must give what compiling that scene alone gives."""

import copy

import mjbatch
import mujoco
import numpy as np
import pytest
import torch
from scenes_small import small_bank, small_model, small_objects

from wbm.robot.rotations import multiply, rotate
from wbm.scenes.bank import NUM_SUPPORTS, Boxes, obstacle_boxes
from wbm.scenes.model import SceneModel, SceneModelConfig
from wbm.scenes.parts import BOX, part_mesh
from wbm.scenes.placement import clearance

POSE_TOLERANCE = 1e-3  # m and rad after 0.1 s: contacts of round things amplify the last bits of two solves


def loaded_template(slots, scene):
    """A copy of the template with one scene written into its own fields, and its data."""
    scenes = small_model(slots)
    model = copy.copy(scenes.model)
    data = mujoco.MjData(model)
    qpos = data.qpos[None].copy()
    fields = {name: getattr(model, name)[None] for name in scenes.fields}
    scenes.load_scene(fields.__getitem__, qpos, np.array([0]), small_bank(), np.array([scene]))
    data.qpos[:], data.ctrl[:] = qpos[0], small_bank().q_start[scene]
    return model, data


def precise(model):
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.timestep, model.opt.tolerance = 0.004, 0.0
    model.opt.iterations, model.opt.ls_iterations = 100, 100
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE | mujoco.mjtDisableBit.mjDSBL_ISLAND


def slots(scene):
    """Which of target and distractors a scene has."""
    return np.flatnonzero(small_bank().object[scene] >= 0)


def present(scene):
    """Columns of the template's qpos that the compiled scene has."""
    return np.concatenate([np.arange(32), *(32 + 7 * i + np.arange(7) for i in slots(scene))])


@pytest.mark.parametrize("scene", range(0, 24, 3))
def test_loaded_template_is_the_scene_compiled_alone(scene):
    alone = small_model().compile_scene(small_bank(), scene)
    model, data = loaded_template("native", scene)
    reference = mujoco.MjData(alone)
    mujoco.mj_resetDataKeyframe(alone, reference, 0)
    for m in (alone, model):
        precise(m)
    columns = present(scene)
    np.testing.assert_array_equal(data.qpos[columns], reference.qpos)
    dofs = np.arange(len(reference.qvel))
    velocities = np.concatenate([np.arange(32), *(32 + 6 * i + np.arange(6) for i in slots(scene))])
    for d in (data, reference):  # press everything into the surface a little, and spin the target
        d.qpos[34::7] -= 2e-4
        d.qvel[35:38] = [0.5, -0.3, 0.8]
        mujoco.mj_forward(model if d is data else alone, d)
    assert data.ncon == reference.ncon > 0
    names = [[m.geom(g).name for g in d.contact.geom.ravel()] for m, d in ((model, data), (alone, reference))]
    assert names[0] == names[1]
    np.testing.assert_allclose(data.contact.pos, reference.contact.pos, atol=1e-9)
    np.testing.assert_allclose(data.contact.dist, reference.contact.dist, atol=1e-9)
    np.testing.assert_allclose(data.contact.frame, reference.contact.frame, atol=1e-9)
    np.testing.assert_allclose(data.qfrc_bias[velocities], reference.qfrc_bias[dofs], atol=1e-9)
    np.testing.assert_allclose(data.qacc[velocities], reference.qacc[dofs], rtol=1e-4, atol=1e-4)
    mujoco.mj_step(alone, reference, 25)
    mujoco.mj_step(model, data, 25)
    np.testing.assert_allclose(data.qpos[columns], reference.qpos, atol=POSE_TOLERANCE)


def test_derived_masses_are_those_of_set_const():
    scenes, bank = small_model(), small_bank()
    rng = np.random.default_rng(0)
    count = min(24, len(bank))
    batch = mjbatch.Batch(scenes.model, count, 1)
    fields = {name: batch.expand(name) for name in scenes.fields}
    scale = rng.uniform(0.5, 2.0, (count, 4))
    friction = rng.uniform(0.6, 1.2, count)
    scenes.load_scene(fields.__getitem__, batch.bind("qpos"), np.arange(count), bank, np.arange(count), scale, friction)
    before = {name: value.copy() for name, value in fields.items()}
    batch.set_const()
    for name in scenes.fields:
        np.testing.assert_allclose(before[name], fields[name], rtol=1e-9, atol=1e-9, err_msg=name)
    np.testing.assert_allclose(
        fields["body_mass"][:, scenes.body_ids[0]], small_objects().mass[bank.object[:count, 0]] * scale[:, 0]
    )
    np.testing.assert_allclose(fields["geom_friction"][:, scenes.slot_geoms[2, 3], 0], friction)


def test_loading_touches_only_the_chosen_environments():
    scenes, bank = small_model(), small_bank()
    batch = mjbatch.Batch(scenes.model, 4, 1)
    fields = {name: batch.expand(name) for name in scenes.fields}
    before = {name: value.copy() for name, value in fields.items()}
    scenes.load_scene(fields.__getitem__, batch.bind("qpos"), np.array([1, 3]), bank, np.array([0, 5]))
    for name, value in fields.items():
        np.testing.assert_array_equal(value[[0, 2]], before[name][[0, 2]])
        if name not in ("geom_friction", "body_gravcomp"):
            assert (value[[1, 3]] != before[name][[1, 3]]).any(), name


def test_torch_fields_are_written_like_numpy_ones():
    scenes, bank = small_model(), small_bank()
    arrays = {name: np.repeat(getattr(scenes.model, name)[None], 3, axis=0) for name in scenes.fields}
    tensors = {name: torch.from_numpy(value.copy()) for name, value in arrays.items()}
    qpos = np.zeros((3, scenes.model.nq))
    tensor_qpos = torch.zeros(3, scenes.model.nq)
    ids, rows = np.array([2, 0]), np.array([4, 7])
    scenes.load_scene(arrays.__getitem__, qpos, ids, bank, rows, friction=np.array([0.7, 0.9]))
    scenes.load_scene(tensors.__getitem__, tensor_qpos, ids, bank, rows, friction=np.array([0.7, 0.9]))
    for name in scenes.fields:
        np.testing.assert_array_equal(arrays[name], tensors[name].numpy(), err_msg=name)
    np.testing.assert_allclose(qpos, tensor_qpos.numpy(), rtol=1e-6)


def test_mesh_slots_agree_with_native_ones_on_shape():
    """In mesh mode types and bits stay fixed; every part still fills the same place."""
    assert not {"geom_type", "geom_contype", "geom_conaffinity"} & set(small_model("mesh").geom_fields)
    for scene in (0, 8, 15):
        model, data = loaded_template("mesh", scene)
        native, native_data = loaded_template("native", scene)
        for m, d in ((model, data), (native, native_data)):
            mujoco.mj_kinematics(m, d)
        scenes = small_model()
        used = small_objects().slot_type[small_bank().object[scene, 0]] >= 0
        for geom in scenes.slot_geoms[0][used]:
            assert model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH
            mesh = model.geom_dataid[geom]
            start = model.mesh_vertadr[mesh]
            vertices = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
            world = vertices @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
            low, high = world.min(axis=0), world.max(axis=0)
            box = native.geom_aabb[geom]
            corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T * box[3:] + box[:3]
            place = corners @ native_data.geom_xmat[geom].reshape(3, 3).T + native_data.geom_xpos[geom]
            assert (low > place.min(axis=0) - 1e-6).all() and (high < place.max(axis=0) + 1e-6).all()
            np.testing.assert_allclose((low + high) / 2, native_data.geom_xpos[geom], atol=0.03)


def test_every_hull_has_its_collision_graph():
    assert (small_model().model.mesh_graphadr >= 0).all()


def test_absent_distractors_stay_parked():
    bank = small_bank()
    scene = int(np.flatnonzero(bank.object[:, -1] < 0)[0])
    model, data = loaded_template("native", scene)
    start = data.qpos.copy()
    data.ctrl[:] = bank.q_start[scene]
    mujoco.mj_step(model, data, 50)
    np.testing.assert_allclose(data.qpos[-7:], start[-7:], atol=1e-6)


def test_obstacles_cover_supports_and_objects():
    bank, objects = small_bank(), small_objects()
    scenes = np.arange(len(bank))
    boxes = obstacle_boxes(bank, objects, scenes)
    pos, quat = boxes.world(bank.object_pos, bank.object_quat)
    assert boxes.type.shape == (len(bank), NUM_SUPPORTS + 8)
    for k in range(0, len(bank), 4):
        used = boxes.type[k] == BOX
        assert used[:NUM_SUPPORTS].sum() == bank.support_count[k]
        model, data = loaded_template("native", k)
        mujoco.mj_kinematics(model, data)
        for i in range(int(bank.support_count[k])):
            geom = model.geom(f"support_{i}").id
            np.testing.assert_allclose(pos[k, i], data.geom_xpos[geom], atol=1e-12)
            np.testing.assert_allclose(boxes.size[k, i], model.geom_size[geom])
        for slot, o in enumerate(bank.object[k]):
            if o < 0:
                continue
            soup = np.concatenate([part_mesh(p)[0] for p in objects.parts(int(o))])
            world = bank.object_pos[k, slot] + rotate(bank.object_quat[k, slot], soup)
            covered = np.zeros(len(world), dtype=bool)
            for m in np.flatnonzero(used & (boxes.body[k] == slot)):
                local = rotate(quat[k, m] * [1, -1, -1, -1], world - pos[k, m])
                covered |= (np.abs(local) <= boxes.size[k, m] + 1e-6).all(axis=1)
            assert covered.all()
    without = obstacle_boxes(bank, objects, scenes, with_target=False)
    assert (without.type[:, NUM_SUPPORTS : NUM_SUPPORTS + 2] == -1).all()
    assert isinstance(without, Boxes)


def test_quaternion_helpers_agree_with_mujoco():
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(2, 20, 4))
    a, b = a / np.linalg.norm(a, axis=1)[:, None], b / np.linalg.norm(b, axis=1)[:, None]
    v = rng.normal(size=(20, 3))
    product, turned = multiply(a, b), rotate(a, v)
    for i in range(20):
        expected, vec = np.zeros(4), np.zeros(3)
        mujoco.mju_mulQuat(expected, a[i], b[i])
        mujoco.mju_rotVecQuat(vec, v[i], a[i])
        np.testing.assert_allclose(product[i], expected, atol=1e-12)
        np.testing.assert_allclose(turned[i], vec, atol=1e-12)


def test_clearance_agrees_with_a_dense_search():
    bank, robot = small_bank(), small_model().robot
    from wbm.robot.spheres import robot_spheres, sphere_positions

    spheres = robot_spheres(robot)
    rng = np.random.default_rng(0)
    for k in (0, 7):
        count = int(bank.support_count[k])
        found = clearance(
            robot, bank.q_start[k], bank.support_pos[k, :count], bank.support_size[k, :count], bank.support_quat[k, 0]
        )
        centre = sphere_positions(robot, spheres, bank.q_start[k][None])[0]
        best = np.inf
        for i in range(count):
            local = rng.uniform(-1, 1, (4000, 3)) * bank.support_size[k, i]
            cloud = bank.support_pos[k, i] + rotate(bank.support_quat[k, i], local)
            distance = np.linalg.norm(cloud[:, None] - centre, axis=2) - spheres.radius
            best = min(best, distance.min())
        assert found <= best + 1e-9
        assert found == pytest.approx(best, abs=0.06)


def test_another_number_of_distractors_is_refused():
    lonely = SceneModel(small_objects(), SceneModelConfig(num_distractors=0))
    assert lonely.bodies == ("target",)
    with pytest.raises(ValueError, match="num_distractors"):
        lonely.load_scene({}.__getitem__, None, np.array([0]), small_bank(), np.array([0]))
    with pytest.raises(ValueError, match="slots"):
        SceneModelConfig(slots="voxels")

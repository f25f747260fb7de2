"""Convex parts against trimesh, against sampling, and against each other."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes_small import OBJECTS, small_objects
from scipy.spatial.transform import Rotation

from wbm.scenes import parts
from wbm.scenes.objects import centred, lowest_height, principal_boxes, stack_objects
from wbm.scenes.parts import BOX, CAPSULE, CYLINDER, SPHERE, Part
from wbm.scenes.procedural import draw_objects

TYPES = (SPHERE, CAPSULE, CYLINDER, BOX)


@st.composite
def drawn_parts(draw):
    length = st.floats(0.005, 0.1)
    quat = np.array([draw(st.floats(-1, 1)) for _ in range(4)]) + np.array([1.1, 0, 0, 0])
    pos = tuple(draw(st.floats(-0.1, 0.1)) for _ in range(3))
    return Part(
        draw(st.sampled_from(TYPES)),
        (draw(length), draw(length), draw(length)),
        pos,
        tuple(quat / np.linalg.norm(quat)),
    )


@settings(max_examples=40, deadline=None)
@given(drawn_parts())
def test_moments_of_primitives_are_those_of_their_fine_mesh(part):
    volume, centre, inertia = parts.part_moments(part)
    vertices, faces = parts.part_mesh(part, sections=96)
    fine_volume, fine_centre, fine_inertia = parts.mesh_moments(vertices, faces)
    assert volume == pytest.approx(fine_volume, rel=5e-3)
    np.testing.assert_allclose(centre, fine_centre, atol=1e-6)
    np.testing.assert_allclose(inertia, fine_inertia, atol=8e-3 * np.abs(inertia).max())


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_moments_of_hulls_are_trimesh_s(seed):
    rng = np.random.default_rng(seed)
    vertices, faces = parts.convex_mesh(
        rng.normal(size=(int(rng.integers(5, 30)), 3)) * rng.uniform(0.01, 0.1, 3) + 0.3
    )
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    volume, centre, inertia = parts.mesh_moments(vertices, faces)
    assert mesh.is_watertight and mesh.volume > 0
    assert volume == pytest.approx(mesh.volume, rel=1e-6)
    np.testing.assert_allclose(centre, mesh.center_mass, atol=1e-7)
    np.testing.assert_allclose(inertia, mesh.moment_inertia, atol=1e-4 * np.abs(inertia).max())


@settings(max_examples=40, deadline=None)
@given(drawn_parts(), st.integers(0, 1000))
def test_inside_bounds_and_mesh_agree(part, seed):
    rng = np.random.default_rng(seed)
    low, high = parts.bounds([part])
    cloud = rng.uniform(low - 0.01, high + 0.01, size=(500, 3))
    within = parts.inside(part, cloud)
    assert ((cloud[within] >= low) & (cloud[within] <= high)).all()
    vertices, _ = parts.part_mesh(part, sections=64)
    assert (vertices >= low - 1e-9).all() and (vertices <= high + 1e-9).all()
    np.testing.assert_allclose(vertices.min(axis=0), low, atol=3e-3 * np.ptp(np.r_[low, high]))
    share = within.mean() * np.prod(high - low + 0.02)
    volume = parts.part_moments(part)[0]
    assert share == pytest.approx(volume, abs=5 * np.sqrt(volume * np.prod(high - low + 0.02) / 500) + 1e-9)


def test_surface_samples_lie_on_the_union_with_outward_normals():
    objects = small_objects()
    for o in range(0, len(objects), 5):
        pieces = objects.parts(o)
        points, normals = objects.points[o].astype(float), objects.normals[o].astype(float)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
        buried = np.any([parts.inside(p, points - 2e-3 * normals) for p in pieces], axis=0)
        outside = ~np.any([parts.inside(p, points, 1e-3) for p in pieces], axis=0)
        assert outside.all(), objects.name[o]
        assert buried.mean() > 0.95, objects.name[o]


def test_mass_properties_are_those_of_the_parts():
    objects = small_objects()
    for o in range(0, len(objects), 7):
        volume, centre, inertia = parts.combined_moments(objects.parts(o))
        axes = Rotation.from_quat(objects.iquat[o], scalar_first=True).as_matrix()
        rebuilt = axes @ np.diag(objects.inertia[o]) @ axes.T
        np.testing.assert_allclose(objects.com[o], centre, atol=1e-12)
        np.testing.assert_allclose(rebuilt, inertia * objects.mass[o] / volume, rtol=1e-6, atol=1e-12)


def test_origin_is_the_centre_and_rests_touch_the_ground():
    objects = small_objects()
    for o in range(len(objects)):
        pieces = objects.parts(o)
        low, high = parts.bounds(pieces)
        np.testing.assert_allclose(low, -high, atol=1e-9)
        np.testing.assert_allclose(objects.half_extent[o], high, atol=1e-12)
        for k in range(objects.rest_count[o]):
            turn = Rotation.from_quat(objects.rest_quat[o, k], scalar_first=True)
            soup = np.concatenate([parts.part_mesh(p, 64)[0] for p in pieces])
            assert turn.apply(soup)[:, 2].min() == pytest.approx(-objects.rest_height[o, k], abs=2e-4)
            assert lowest_height(pieces, objects.rest_quat[o, k]) == pytest.approx(objects.rest_height[o, k], abs=1e-12)


def test_principal_boxes_contain_the_object():
    objects = small_objects()
    for o in range(len(objects)):
        cloud = np.concatenate([parts.part_mesh(p)[0] for p in objects.parts(o)])
        covered = np.zeros(len(cloud), dtype=bool)
        for k in range(objects.box_count[o]):
            covered |= (np.abs(cloud - objects.box_pos[o, k]) <= objects.box_size[o, k] + 1e-9).all(axis=1)
        assert covered.all(), objects.name[o]
    assert (objects.box_count == 2).any() and (objects.box_count == 1).any()


def test_two_boxes_are_used_where_they_save_room():
    bar = [Part(BOX, (0.1, 0.01, 0.01)), Part(BOX, (0.01, 0.1, 0.1), (0.1, 0, 0))]
    assert len(principal_boxes(bar)) == 2
    assert (
        len(principal_boxes(centred([Part(BOX, (0.1, 0.02, 0.01)), Part(BOX, (0.1, 0.02, 0.01), (0, 0, 0.02))]))) == 1
    )


def test_too_many_parts_are_refused():
    entry = draw_objects(OBJECTS, 1)[0]
    crowded = type(entry)(**{**entry.__dict__, "parts": entry.parts * 9})
    with pytest.raises(ValueError, match="9 parts"):
        stack_objects([crowded])

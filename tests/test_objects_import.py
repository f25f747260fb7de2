"""Meshes from strangers: scale, repair, decomposition, caching, and files that are damaged or hostile."""

import json
import os
import struct
import time

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stages.cli import main
from wbm.scenes import cache, decompose, isolate, meshfile, parts, sources
from wbm.scenes.config import ObjectsConfig
from wbm.scenes.meshfile import MeshError

CFG = ObjectsConfig(source="meshes", path="given", count=0, max_faces=20_000, workers=2)


def icosphere(radius=0.04):
    return trimesh.creation.icosphere(subdivisions=2, radius=radius)


def tube():
    """A cup-like body that is far from convex."""
    outer = trimesh.creation.cylinder(0.04, 0.1, sections=20)
    inner = trimesh.creation.cylinder(0.034, 0.1, sections=20).apply_translation([0, 0, 0.01])
    return trimesh.boolean.difference([outer, inner], engine="manifold")


SOLID = icosphere()
FILES = {suffix: SOLID.export(file_type=suffix) for suffix in ("obj", "stl", "ply", "glb")}
FILES = {k: v.encode() if isinstance(v, str) else v for k, v in FILES.items()}


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("WBM_CACHE", str(tmp_path / "cache"))


@pytest.mark.parametrize("suffix", sorted(FILES))
def test_every_format_is_read(tmp_path, suffix):
    path = tmp_path / f"thing.{suffix}"
    path.write_bytes(FILES[suffix])
    mesh = meshfile.read_mesh(path, CFG)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(SOLID.volume, rel=1e-4)


@st.composite
def damages(draw):
    suffix = draw(st.sampled_from(sorted(FILES)))
    data = bytearray(FILES[suffix])
    kind = draw(st.sampled_from(("cut", "flip", "noise", "insert")))
    at = draw(st.integers(0, len(data) - 1))
    if kind == "cut":
        data = data[:at]
    elif kind == "flip":
        for _ in range(draw(st.integers(1, 6))):
            data[draw(st.integers(0, min(len(data), 1500) - 1))] = draw(st.integers(0, 255))
    else:
        noise = draw(st.binary(min_size=1, max_size=200))
        data[at : at + (len(noise) if kind == "noise" else 0)] = noise
    return suffix, bytes(data)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(damages())
def test_damaged_files_are_read_or_refused_with_a_reason(tmp_path, damage):
    suffix, data = damage
    path = tmp_path / f"damaged.{suffix}"
    path.write_bytes(data)
    try:
        mesh = meshfile.read_mesh(path, CFG)
    except MeshError as error:
        assert 3 < len(str(error)) < 200 and "\n" not in str(error)
    else:
        assert np.isfinite(mesh.vertices).all() and len(mesh.faces) >= 4
        assert np.ptp(mesh.vertices, axis=0).min() > 0


def glb(tree):
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text
    return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body


HOSTILE = {
    "empty.obj": (b"", "empty file"),
    "text.stl": (b"not a mesh at all", "truncated STL"),
    "points.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no triangles"),
    "nan.obj": (b"v 0 0 0\nv nan 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n", "not finite"),
    "far.obj": (b"v 0 0 0\nv 1e30 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n", "beyond"),
    "flat.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n", "flat"),
    "open.obj": (
        trimesh.Trimesh(SOLID.vertices, SOLID.faces[:150]).export(file_type="obj").encode(),
        "open beyond repair",
    ),
    "bomb.ply": (b"ply\nformat ascii 1.0\nelement vertex 999999999999\nproperty float x\nend_header\n", "declares"),
    "bomb.glb": (glb({"asset": {"version": "2.0"}, "accessors": [{"count": 10**12, "type": "VEC3"}]}), "declares"),
    "many.glb": (
        glb(
            {
                "accessors": [{"count": 9000, "type": "VEC3"}],
                "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
                "nodes": [{"mesh": 0}] * 5000,
            }
        ),
        "declares",
    ),
    "parts.glb": (glb({"accessors": [{"count": 100_000, "type": "VEC3"}] * 50}), "declares"),
    "outside.glb": (glb({"buffers": [{"uri": "../secret.bin", "byteLength": 4}]}), "another file"),
    "deep.glb": (glb({"accessors": [{"count": -5}]}), "negative"),
    "cut.stl": (FILES["stl"][:5000], "truncated"),
}


@pytest.mark.parametrize("name", sorted(HOSTILE))
def test_hostile_files_are_refused_quickly(tmp_path, name):
    data, reason = HOSTILE[name]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(MeshError, match=reason):
        meshfile.read_mesh(tmp_path / name, CFG)


def test_large_files_and_meshes_are_refused(tmp_path):
    path = tmp_path / "big.stl"
    path.write_bytes(FILES["stl"])
    with pytest.raises(MeshError, match="max_file_mb"):
        meshfile.read_mesh(path, ObjectsConfig(max_file_mb=0.001))
    with pytest.raises(MeshError, match="max_faces"):
        meshfile.read_mesh(path, ObjectsConfig(max_faces=50))


def test_small_holes_are_filled():
    mesh = trimesh.Trimesh(SOLID.vertices, SOLID.faces[:-1], process=False)
    assert not mesh.is_watertight
    assert meshfile.repaired(mesh).is_watertight


@given(st.floats(1e-3, 1e4))
def test_scale_brings_any_size_into_range(largest):
    extents = np.array([largest, 0.6 * largest, 0.5 * largest])
    factor, rule = meshfile.scale_rule(extents, (0.06, 0.14))
    assert (extents * factor).max() <= 0.14 + 1e-9
    assert (extents * factor).min() <= meshfile.GRASP_WIDTH + 1e-9
    assert rule


@pytest.mark.parametrize(
    ("largest", "factor", "rule"),
    [(0.1, 1.0, "metres"), (10.0, 0.01, "centimetres"), (100.0, 0.001, "millimetres"), (1e4, None, "unknown")],
)
def test_scale_rule_reads_units(largest, factor, rule):
    found, words = meshfile.scale_rule(np.array([largest, largest / 2, largest / 2]), (0.06, 0.14))
    assert rule in words
    if factor:
        assert found == pytest.approx(factor)


def test_convex_and_composite_meshes_need_no_decomposition():
    (hull,) = decompose.convex_parts(SOLID, CFG)
    assert len(hull) <= CFG.max_hull_vertices
    box = trimesh.creation.box((0.05, 0.05, 0.05))
    pair = trimesh.util.concatenate([box, box.copy().apply_translation([0.06, 0, 0])])
    assert len(decompose.convex_parts(pair, CFG)) == 2


def test_a_hollow_mesh_becomes_several_hulls_that_stay_hollow():
    cup = tube()
    hulls = decompose.convex_parts(cup, CFG)
    assert 2 <= len(hulls) <= 8
    assert all(len(h) <= CFG.max_hull_vertices for h in hulls)
    volume = sum(parts.part_moments(parts.hull_part(h))[0] for h in hulls)
    assert 0.7 * cup.volume < volume < 2.0 * cup.volume
    middle = np.array([[0.0, 0.0, 0.03]])
    assert not any(parts.inside(parts.hull_part(h), middle)[0] for h in hulls)


def test_standing_puts_a_stable_face_down():
    slab = trimesh.creation.box((0.02, 0.08, 0.06)).apply_transform(trimesh.transformations.random_rotation_matrix())
    (hull,) = decompose.standing([np.asarray(slab.vertices)])
    np.testing.assert_allclose(np.ptp(hull, axis=0)[2], 0.02, atol=1e-6)
    assert hull[:, 2].min() == pytest.approx(0.0, abs=1e-9)


def folder_with(tmp_path, bad=1):
    root = tmp_path / "meshes"
    for i, (suffix, factor) in enumerate([("obj", 1.0), ("stl", 1000.0), ("ply", 100.0), ("glb", 1.0)]):
        path = root / f"kind{i % 2}" / f"RedToy_{i}.{suffix}"
        path.parent.mkdir(parents=True, exist_ok=True)
        mesh = SOLID.copy().apply_scale(factor)
        data = mesh.export(file_type=suffix)
        path.write_bytes(data.encode() if isinstance(data, str) else data)
    for i in range(bad):
        (root / f"broken_{i}.obj").write_bytes(b"nonsense")
    return root


def test_a_folder_is_imported_and_broken_files_are_named(tmp_path):
    root = folder_with(tmp_path)
    cfg = ObjectsConfig(source="meshes", path=str(root), count=0, workers=2)
    objects, report = sources.collect_objects(cfg, 3)
    assert len(objects) == 4 and report["read"] == 5
    assert list(report["skipped"]) == ["broken_0.obj"]
    assert report["scaled"]["kind1/RedToy_1.stl"] == "read as millimetres"
    assert list(objects.name) == [
        "kind0/RedToy_0.obj",
        "kind0/RedToy_2.ply",
        "kind1/RedToy_1.stl",
        "kind1/RedToy_3.glb",
    ]
    assert set(objects.noun) == {"toy"}
    np.testing.assert_allclose(objects.half_extent[:, 2], 0.04, rtol=0.15)
    seen = []
    again, _ = sources.collect_objects(cfg, 3, lambda jobs: (seen.append(i) or i for i in jobs))
    assert sorted(seen) == list(range(5))
    np.testing.assert_array_equal(objects.hull_vertices, again.hull_vertices)


def test_results_come_from_the_cache(tmp_path, monkeypatch):
    root = folder_with(tmp_path, bad=0)
    cfg = ObjectsConfig(source="meshes", path=str(root), count=0, workers=1)
    first, _ = sources.collect_objects(cfg, 0)
    monkeypatch.setattr(
        sources, "run_isolated", lambda f, jobs, *_: iter(()) if not jobs else pytest.fail("worked again")
    )
    moved = root.rename(tmp_path / "elsewhere")
    second, _ = sources.collect_objects(ObjectsConfig(source="meshes", path=str(moved), count=0), 0)
    np.testing.assert_array_equal(first.hull_vertices, second.hull_vertices)
    for path in (cache.cache_folder() / "meshes").iterdir():
        path.write_bytes(b"damaged")
    assert decompose.cached_import(moved / "kind0" / "RedToy_0.obj", cfg) is None


def test_more_than_half_broken_stops_the_run(tmp_path):
    root = folder_with(tmp_path, bad=6)
    with pytest.raises(ValueError, match=r"6 of 10 meshes .* cannot be used \(broken_0.obj"):
        sources.collect_objects(ObjectsConfig(source="meshes", path=str(root), count=0, workers=2), 0)


def test_missing_and_empty_folders_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such folder"):
        sources.collect_objects(ObjectsConfig(source="meshes", path=str(tmp_path / "none")), 0)
    with pytest.raises(ValueError, match="no OBJ, STL, PLY, GLB"):
        sources.collect_objects(ObjectsConfig(source="meshes", path=str(tmp_path)), 0)


def test_jobs_that_crash_or_hang_or_raise_are_reported():
    started = time.monotonic()
    jobs = [(0.0,), (60.0,)]
    results = {i: (r, why) for i, r, why in isolate.run_isolated(time.sleep, jobs, 2, 5.0, 4000)}
    assert results[0] == (None, "") and "longer than 5 s" in results[1][1]
    assert time.monotonic() - started < 30
    ((_, result, reason),) = isolate.run_isolated(os._exit, [(3,)], 1, 20.0, 4000)
    assert result is None and "status 3" in reason
    ((_, result, reason),) = isolate.run_isolated(json.loads, [("{",)], 1, 20.0, 4000)
    assert result is None and reason.startswith("JSONDecodeError")


def test_pybullet_objects_are_found_or_explained(monkeypatch):
    monkeypatch.setattr(sources.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(FileNotFoundError, match="pip install"):
        sources.collect_objects(ObjectsConfig(source="pybullet", count=2), 0)


def test_pybullet_objects_are_imported():
    pytest.importorskip("pybullet_data")
    objects, report = sources.collect_objects(ObjectsConfig(source="pybullet", count=1, workers=2), 0)
    assert len(objects) == 1 and not report["skipped"]
    assert (2 * objects.half_extent.max(axis=1) <= 0.14 + 1e-6).all()


def test_families_are_held_out_where_folders_name_them():
    cfg = ObjectsConfig(held_out=())
    families = [f"kind{i % 6}" for i in range(60)]
    chosen = sources.choose_held_out(families, cfg, 0)
    assert len(set(chosen)) == 2 and set(chosen) <= set(families)
    assert sources.choose_held_out([f"own{i}" for i in range(60)], cfg, 0) == ()
    assert sources.choose_held_out(families, ObjectsConfig(held_out=("kind3",)), 0) == ("kind3",)


@pytest.mark.parametrize(
    ("stem", "noun"),
    [
        ("RedToyCar_03", "toy car"),
        ("tall_can", "can"),
        ("000", "object"),
        ("model_mesh", "object"),
        ("mug-blue", "mug"),
    ],
)
def test_nouns_come_from_file_names_without_colours_and_sizes(stem, noun):
    assert sources.noun_of(stem) == noun


def test_the_stage_fails_where_most_meshes_do_and_notices_a_changed_one(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def wbm(*arguments):
        with pytest.raises(SystemExit) as stop:
            main([*arguments, "objects=meshes", f"objects.path={folder_with(tmp_path, bad=6)}"])
        return stop.value.code, *capsys.readouterr()

    code, _, err = wbm("prepare-assets")
    assert code == 1 and "6 of 10 meshes" in err and "broken_0.obj" in err and "Traceback" not in err
    before = json.loads(wbm("plan", "--until", "prepare-assets", "--json")[1])["stages"][0]["key"]
    assert json.loads(wbm("plan", "--until", "prepare-assets", "--json")[1])["stages"][0]["key"] == before
    SOLID.copy().apply_scale(1.01).export(tmp_path / "meshes" / "kind0" / "more.obj")
    assert json.loads(wbm("plan", "--until", "prepare-assets", "--json")[1])["stages"][0]["key"] != before

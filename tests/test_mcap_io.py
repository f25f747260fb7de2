"""MCAP episodes: exact round trip, readable by Foxglove's and Rerun's own packages."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from mcap.reader import make_reader

from wbm.artifacts.mcap_io import (
    BOX,
    CAPSULE,
    CYLINDER,
    MESH,
    SPHERE,
    EpisodeTracks,
    Solid,
    mcap_to_zarr,
    read_mcap,
    write_mcap,
    zarr_to_mcap,
)

T, P, M = 12, 20, 8
NAMES = tuple(f"joint{i}" for i in range(32))


def make_tracks(seed: int = 0) -> EpisodeTracks:
    rng = np.random.default_rng(seed)
    unit = np.tile([1.0, 0, 0, 0], (T, 1))
    tetra = (np.eye(4, 3), np.array([[0, 1, 2], [0, 1, 3]]))
    still, turn = np.array([1.0, 0, 0.4]), np.array([np.sqrt(0.5), 0, np.sqrt(0.5), 0])
    return EpisodeTracks(
        times=np.arange(T) * 0.04,
        joint_names=NAMES,
        q=rng.normal(size=(T, 32)),
        qd=rng.normal(size=(T, 32)),
        action=rng.normal(size=(T, 32)).astype(np.float32),
        frames={"base": (rng.normal(size=(T, 3)), unit), "ee": (rng.normal(size=(T, 3)), unit)},
        camera=(
            rng.normal(size=(T, P, 3)).astype(np.float32),
            rng.integers(0, 256, (T, P, 3), dtype=np.uint8),
            rng.integers(0, 2, (T, P), dtype=np.uint8),
        ),
        lidar=(rng.normal(size=(T, M, 3)).astype(np.float32), np.ones((T, M), dtype=np.uint8)),
        solids=(
            Solid("table", BOX, (0.4, 0.6, 0.02), (0.6, 0.5, 0.4, 1), still, turn),
            Solid("target", CYLINDER, (0.03, 0.08, 0), (0.8, 0.1, 0.1, 1), rng.normal(size=(T, 3)), unit),
            Solid("ball", SPHERE, (0.03, 0, 0), (0.8, 0.1, 0.1, 1), still, turn),
            Solid("pill", CAPSULE, (0.03, 0.05, 0), (0.8, 0.1, 0.1, 1), still, turn),
            Solid("hull", MESH, (0, 0, 0), (0.8, 0.1, 0.1, 1), still, turn, *tetra),
        ),
        log=((0.0, "pick up the red can"), (0.3, "contact"), (9.0, "success")),
    )


def decoded(path) -> dict[str, list]:
    """Messages by topic, decoded with the schemas inside the file, as any other reader would."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    result: dict[str, list] = {}
    with open(path, "rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            if channel.message_encoding != "protobuf":
                continue
            pool = descriptor_pool.DescriptorPool()
            for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                pool.Add(file)
            kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            result.setdefault(channel.topic, []).append(kind.FromString(message.data))
    return result


def test_topics_and_values(tmp_path):
    tracks = make_tracks()
    count = write_mcap(tmp_path / "a.mcap", tracks, {}, {})
    topics = decoded(tmp_path / "a.mcap")
    assert {t: len(v) for t, v in topics.items()} == {
        "/tf": T, "/robot/joint_states": T, "/policy/action": T, "/camera/points": T, "/lidar/points": T,
        "/scene/update": T + 1, "/log": 3,
    }  # fmt: skip
    assert count == sum(len(v) for v in topics.values())
    k = 5
    joints = topics["/robot/joint_states"][k].joints
    assert [j.name for j in joints] == list(NAMES)
    np.testing.assert_array_equal([j.position for j in joints], tracks.q[k])
    np.testing.assert_array_equal([j.velocity for j in joints], tracks.qd[k])
    transform = topics["/tf"][k].transforms[1]
    assert (transform.parent_frame_id, transform.child_frame_id) == ("world", "ee")
    ee = transform.translation
    np.testing.assert_array_equal([ee.x, ee.y, ee.z], tracks.frames["ee"][0][k])
    cloud = topics["/camera/points"][k]
    kinds = {f.name: (f.offset, f.type) for f in cloud.fields}
    assert kinds["x"] == (0, 7) and kinds["red"] == (12, 1) and cloud.point_stride == 16
    points = np.frombuffer(cloud.data, dtype=np.dtype([("xyz", "<f4", 3), ("rgba", "u1", 4)]))
    xyz, rgb, valid = (a[k] for a in tracks.camera)
    np.testing.assert_array_equal(points["xyz"], xyz[valid != 0])
    np.testing.assert_array_equal(points["rgba"][:, :3], rgb[valid != 0])
    still = {e.id: e for e in topics["/scene/update"][0].entities}
    assert set(still) == {"table", "ball", "pill", "hull"}
    assert still["table"].cubes[0].size.x == 0.8 and still["hull"].triangles[0].indices == [0, 1, 2, 0, 1, 3]
    ends = sorted(s.pose.position.x for s in still["pill"].spheres)  # its axis lies along x
    np.testing.assert_allclose(ends, [0.95, 1.05], atol=1e-12)
    assert [entry.message for entry in topics["/log"]] == ["pick up the red can", "contact", "success"]


NUMBERS = st.one_of(
    hnp.floating_dtypes(endianness="<", sizes=(32, 64)),
    hnp.integer_dtypes(endianness="<"),
    st.just(np.dtype(bool)),
    st.just(np.dtype("u1")),
)


@settings(max_examples=40, deadline=None)
@given(data=st.data(), steps=st.integers(0, 9))
def test_arrays_survive_bit_for_bit(tmp_path_factory, data, steps):
    path = tmp_path_factory.getbasetemp() / "raw.mcap"
    arrays = {}
    for name in ("a", "b/c"):
        shape = (steps, *data.draw(hnp.array_shapes(min_dims=0, max_dims=3, min_side=1, max_side=4)))
        arrays[name] = data.draw(hnp.arrays(data.draw(NUMBERS), shape))
    write_mcap(path, EpisodeTracks(times=np.arange(steps) / 25), arrays, {"seed": 3})
    back, attrs = read_mcap(path)
    assert attrs == {"seed": 3} and set(back) == set(arrays)
    for name, values in arrays.items():
        assert back[name].dtype == values.dtype and back[name].shape == values.shape
        assert back[name].tobytes() == values.tobytes()


def test_zarr_round_trip(tmp_path):
    tracks, rng = make_tracks(), np.random.default_rng(1)
    group = zarr.create_group(tmp_path / "in.zarr")
    group.attrs.update({"instruction": "pick up the red can", "success": True})
    for name, values in {
        "proprio": rng.normal(size=(T, 94)).astype(np.float32),
        "depth_rgb": rng.integers(0, 256, (T, P, 3), dtype=np.uint8),
        "q": np.where(rng.random((T, 32)) < 0.1, np.nan, rng.normal(size=(T, 32))),
        "phase": rng.integers(0, 3, T, dtype=np.int8),
    }.items():
        group.create_array(name, data=values)
    zarr_to_mcap(group, tmp_path / "a.mcap", tracks)
    other = zarr.create_group(tmp_path / "out.zarr")
    mcap_to_zarr(tmp_path / "a.mcap", other)
    assert dict(other.attrs) == dict(group.attrs)
    assert sorted(n for n, _ in other.arrays()) == sorted(n for n, _ in group.arrays())
    for name, array in group.arrays():
        copy = other[name]
        assert copy.dtype == array.dtype and copy[:].tobytes() == array[:].tobytes()
    zarr_to_mcap(other, tmp_path / "b.mcap", tracks)
    assert (tmp_path / "b.mcap").read_bytes() == (tmp_path / "a.mcap").read_bytes()


def test_damage_is_refused(tmp_path):
    path = tmp_path / "a.mcap"
    with pytest.raises(ValueError, match="steps"):
        write_mcap(path, make_tracks(), {"x": np.zeros(3)}, {})
    with pytest.raises(ValueError, match="numbers"):
        write_mcap(path, make_tracks(), {"x": np.array(["a"] * T)}, {})
    from mcap.writer import Writer

    with open(path, "wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()
    with pytest.raises(ValueError, match="no episode"):
        read_mcap(path)


def test_rerun_opens_it(tmp_path):
    """Rerun's own importer in a process of its own: it must find our topics."""
    pytest.importorskip("rerun")
    write_mcap(tmp_path / "a.mcap", make_tracks(), {"x": np.zeros(T)}, {})
    script = f"""
import rerun as rr
recording = rr.RecordingStream("wbm")
recording.save({str(tmp_path / "a.rrd")!r})
recording.log_file_from_path({str(tmp_path / "a.mcap")!r})
recording.flush()
recording.disconnect()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    printed = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", str(tmp_path / "a.rrd")],
        capture_output=True,
        text=True,
        timeout=120,
    ).stdout
    chunks = [line for line in printed.splitlines() if line.startswith("Chunk(")]
    for topic, component in {
        "/camera/points": "Points3D:positions",
        "/lidar/points": "Points3D:positions",
        "/tf": "Transform3D:translation",
        "/log": "TextLog:text",
    }.items():
        assert any(f"- {topic} -" in c and component in c for c in chunks), (topic, chunks)

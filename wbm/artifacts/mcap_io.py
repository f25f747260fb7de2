"""Episodes as MCAP: Foxglove messages to look at, and every array bit for bit beside them.

Foxglove and Rerun show the topics with Foxglove's protobuf schemas. The topics under `/raw/` carry the arrays of the
dataset, one message a step, so that Zarr -> MCAP -> Zarr loses nothing.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import foxglove.messages as fg
import numpy as np
import zarr
from mcap.reader import make_reader
from mcap.writer import Writer

CHUNK_BYTES = 64 * 1024
RAW = "/raw/"
SPHERE, CAPSULE, CYLINDER, BOX, MESH = 2, 3, 5, 6, 7  # MuJoCo's numbers
_METADATA = "wbm-episode"
_MAX_STEPS = 1 << 20
_NUMERIC = fg.PackedElementFieldNumericType


@dataclass(frozen=True)
class Solid:
    """One thing in the scene.

    Attributes:
        id: name shown in the viewer.
        type: MuJoCo's geometry number; size: half sizes as MuJoCo means them.
        rgba: colour, 0 to 1.
        pos: world position [3], or [T,3] when it moves, m.
        quat: world orientation (w x y z) [4] or [T,4].
        vertices: [V,3] and faces [F,3] of a mesh, m.
    """

    id: str
    type: int
    size: Sequence[float]
    rgba: Sequence[float]
    pos: np.ndarray
    quat: np.ndarray
    vertices: np.ndarray | None = None
    faces: np.ndarray | None = None


@dataclass(frozen=True)
class EpisodeTracks:
    """What a viewer shows of an episode of T steps; absent parts are None or empty.

    Attributes:
        times: seconds since the episode's start [T].
        joint_names: names of the joints in `q`, `qd` and `action`.
        q, qd, action: [T,32].
        frames: world poses by frame name: positions [T,3] and quaternions (w x y z) [T,4].
        camera: points [T,P,3] in frame `cloud_frame`, colours [T,P,3] (uint8), valid [T,P].
        lidar: points [T,M,3] in frame `cloud_frame`, valid [T,M].
        cloud_frame: name of the frame of both clouds.
        solids: objects and supports.
        log: (time in s, message) remarks.
    """

    times: np.ndarray
    joint_names: tuple[str, ...] = ()
    q: np.ndarray | None = None
    qd: np.ndarray | None = None
    action: np.ndarray | None = None
    frames: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    camera: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    lidar: tuple[np.ndarray, np.ndarray] | None = None
    cloud_frame: str = "base"
    solids: tuple[Solid, ...] = ()
    log: tuple[tuple[float, str], ...] = ()


def write_mcap(path: str | Path, tracks: EpisodeTracks, arrays: dict[str, np.ndarray], attrs: dict[str, Any]) -> int:
    """Write an episode atomically.

    Args:
        path: the file.
        tracks: what viewers show.
        arrays: numeric arrays [T, ...] to carry losslessly.
        attrs: JSON-ready facts about the episode.

    Returns:
        Number of messages.

    Raises:
        ValueError: an array has another number of steps than `tracks.times`, or holds no plain numbers.
    """
    path = Path(path)
    partial = path.with_name(path.name + ".partial")
    with open(partial, "wb") as stream:
        writer = Writer(stream, chunk_size=CHUNK_BYTES)
        writer.start(profile="", library="wbm")
        writer.add_metadata(_METADATA, {"attrs": json.dumps(attrs, sort_keys=True), "steps": str(len(tracks.times))})
        count = _Topics(writer, tracks).write()
        count += _write_raw(writer, tracks.times, arrays)
        writer.finish()
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(partial, path)
    return count


def read_mcap(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and attributes as they were given to `write_mcap`.

    Raises:
        ValueError: the file holds no episode of this project, or steps are missing.
    """
    with open(path, "rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        facts = next((m.metadata for m in reader.iter_metadata() if m.name == _METADATA), None)
        if summary is None or facts is None:
            raise ValueError(f"{path} holds no episode; write one with `wbm evaluate` or `wbm generate-rollouts`")
        steps = int(facts["steps"])
        if not 0 <= steps <= _MAX_STEPS:
            raise ValueError(f"{path} says that it holds {steps} steps")
        channels = {c.id: c for c in summary.channels.values() if c.topic.startswith(RAW)}
        parts: dict[int, list[bytes]] = {i: [] for i in channels}
        topics = [c.topic for c in channels.values()]
        for _, channel, message in reader.iter_messages(topics=topics) if topics else ():
            parts[channel.id].append(message.data)
    arrays = {}
    for i, channel in channels.items():
        dtype, shape = np.dtype(channel.metadata["dtype"]), tuple(json.loads(channel.metadata["shape"]))
        data = b"".join(parts[i])
        if dtype.hasobject or len(parts[i]) != steps or len(data) != dtype.itemsize * int(np.prod((steps, *shape))):
            raise ValueError(f"{path}: {channel.topic} holds {len(parts[i])} of {steps} steps")
        arrays[channel.topic.removeprefix(RAW)] = np.frombuffer(data, dtype).reshape(steps, *shape)
    return arrays, json.loads(facts["attrs"])


def zarr_to_mcap(group: zarr.Group, path: str | Path, tracks: EpisodeTracks, steps: slice = slice(None)) -> int:
    """Write an episode that lies in a Zarr group (arrays [T, ...]) as MCAP; returns the number of messages."""
    arrays = {name: np.asarray(array[steps]) for name, array in sorted(group.arrays())}
    return write_mcap(path, tracks, arrays, dict(group.attrs))


def mcap_to_zarr(path: str | Path, group: zarr.Group) -> None:
    """Fill an empty Zarr group with the arrays and attributes of an MCAP episode."""
    arrays, attrs = read_mcap(path)
    for name, values in arrays.items():
        group.create_array(name, data=values, chunks=(min(64, max(1, len(values))), *values.shape[1:]))
    group.attrs.update(attrs)


def _write_raw(writer: Writer, times: np.ndarray, arrays: dict[str, np.ndarray]) -> int:
    channels = {}
    for name, values in arrays.items():
        values = np.asarray(values)
        if len(values) != len(times):
            raise ValueError(f"array {name!r} has {len(values)} steps, the episode has {len(times)}")
        if values.dtype.kind not in "biufc":
            raise ValueError(f"array {name!r} has type {values.dtype}, expected numbers")
        facts = {"dtype": values.dtype.str, "shape": json.dumps(list(values.shape[1:]))}
        channels[writer.register_channel(RAW + name, "raw-array", 0, facts)] = np.ascontiguousarray(values)
    for k, seconds in enumerate(times):
        stamp = _nanoseconds(seconds)
        for channel, values in channels.items():
            writer.add_message(channel, stamp, values[k].tobytes(), stamp, sequence=k)
    return len(times) * len(channels)


class _Topics:
    """Writes the Foxglove topics of one episode."""

    def __init__(self, writer: Writer, tracks: EpisodeTracks) -> None:
        self._writer, self._tracks, self._channels, self._count = writer, tracks, {}, 0

    def write(self) -> int:
        tracks = self._tracks
        self._static_solids()
        log = sorted(tracks.log)
        for k, seconds in enumerate(tracks.times):
            stamp = fg.Timestamp(*divmod(_nanoseconds(seconds), 10**9))
            if tracks.frames:
                self._send("/tf", seconds, fg.FrameTransforms(transforms=self._transforms(k, stamp)))
            if tracks.q is not None:
                velocity = None if tracks.qd is None else tracks.qd[k]
                self._send("/robot/joint_states", seconds, self._joints(stamp, tracks.q[k], velocity))
            if tracks.action is not None:
                self._send("/policy/action", seconds, self._joints(stamp, tracks.action[k], None))
            if tracks.camera is not None:
                xyz, rgb, valid = tracks.camera
                self._send("/camera/points", seconds, _cloud(stamp, tracks.cloud_frame, xyz[k], valid[k], rgb[k]))
            if tracks.lidar is not None:
                xyz, valid = tracks.lidar
                self._send("/lidar/points", seconds, _cloud(stamp, tracks.cloud_frame, xyz[k], valid[k]))
            moving = [_entity(s, stamp, s.pos[k], s.quat[k]) for s in tracks.solids if np.ndim(s.pos) == 2]
            if moving:
                self._send("/scene/update", seconds, fg.SceneUpdate(entities=moving))
            while log and log[0][0] <= seconds:
                self._log(*log.pop(0))
        for entry in log:
            self._log(*entry)
        return self._count

    def _send(self, topic: str, seconds: float, message: Any) -> None:
        if topic not in self._channels:
            schema = type(message).get_schema()
            number = self._writer.register_schema(schema.name, schema.encoding, schema.data)
            self._channels[topic] = self._writer.register_channel(topic, "protobuf", number)
        stamp = _nanoseconds(seconds)
        self._writer.add_message(self._channels[topic], stamp, message.encode(), stamp)
        self._count += 1

    def _static_solids(self) -> None:
        if not len(self._tracks.times):
            return
        seconds = float(self._tracks.times[0])
        stamp = fg.Timestamp(*divmod(_nanoseconds(seconds), 10**9))
        still = [_entity(s, stamp, s.pos, s.quat) for s in self._tracks.solids if np.ndim(s.pos) == 1]
        if still:
            self._send("/scene/update", seconds, fg.SceneUpdate(entities=still))

    def _transforms(self, k: int, stamp: Any) -> list[Any]:
        return [
            fg.FrameTransform(
                timestamp=stamp,
                parent_frame_id="world",
                child_frame_id=name,
                translation=_vector(pos[k]),
                rotation=_quaternion(quat[k]),
            )
            for name, (pos, quat) in self._tracks.frames.items()
        ]

    def _joints(self, stamp: Any, position: np.ndarray, velocity: np.ndarray | None) -> Any:
        rates = [None] * len(position) if velocity is None else [float(v) for v in velocity]
        states = [
            fg.JointState(name=n, position=float(p), velocity=v)
            for n, p, v in zip(self._tracks.joint_names, position, rates, strict=True)
        ]
        return fg.JointStates(timestamp=stamp, joints=states)

    def _log(self, seconds: float, text: str) -> None:
        stamp = fg.Timestamp(*divmod(_nanoseconds(seconds), 10**9))
        self._send("/log", seconds, fg.Log(timestamp=stamp, level=fg.LogLevel.Info, message=text, name="episode"))


def _nanoseconds(seconds: float) -> int:
    return round(float(seconds) * 1e9)


def _vector(v: np.ndarray) -> Any:
    return fg.Vector3(x=float(v[0]), y=float(v[1]), z=float(v[2]))


def _quaternion(q: np.ndarray) -> Any:
    return fg.Quaternion(w=float(q[0]), x=float(q[1]), y=float(q[2]), z=float(q[3]))


def _cloud(stamp: Any, frame: str, xyz: np.ndarray, valid: np.ndarray, rgb: np.ndarray | None = None) -> Any:
    """Valid points as x y z (float32) and, with colours, red green blue alpha (uint8), as Foxglove expects them."""
    keep = np.asarray(valid) != 0
    kinds: list[tuple[str, str]] = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    if rgb is not None:
        kinds += [("red", "u1"), ("green", "u1"), ("blue", "u1"), ("alpha", "u1")]
    packed = np.zeros(int(keep.sum()), dtype=kinds)
    for i, axis in enumerate("xyz"):
        packed[axis] = xyz[keep, i]
    if rgb is not None:
        for i, channel in enumerate(("red", "green", "blue")):
            packed[channel] = rgb[keep, i]
        packed["alpha"] = 255
    offsets = np.cumsum([0] + [4 if k == "<f4" else 1 for _, k in kinds])
    fields = [
        fg.PackedElementField(name=n, offset=int(o), type=_NUMERIC.Float32 if k == "<f4" else _NUMERIC.Uint8)
        for (n, k), o in zip(kinds, offsets, strict=False)
    ]
    pose = fg.Pose(position=fg.Vector3(), orientation=fg.Quaternion(w=1.0, x=0.0, y=0.0, z=0.0))
    return fg.PointCloud(
        timestamp=stamp,
        frame_id=frame,
        pose=pose,
        point_stride=packed.dtype.itemsize,
        fields=fields,
        data=packed.tobytes(),
    )


def _entity(solid: Solid, stamp: Any, pos: np.ndarray, quat: np.ndarray) -> Any:
    """A scene entity in the world; a capsule is a cylinder and two spheres."""
    pose = fg.Pose(position=_vector(pos), orientation=_quaternion(quat))
    r, g, b, a = (float(c) for c in solid.rgba)
    color, size = fg.Color(r=r, g=g, b=b, a=a), [float(s) for s in solid.size]
    parts: dict[str, Any] = {}
    if solid.type == BOX:
        parts["cubes"] = [fg.CubePrimitive(pose=pose, size=_vector(2 * np.array(size)), color=color)]
    elif solid.type == SPHERE:
        parts["spheres"] = [fg.SpherePrimitive(pose=pose, size=_vector(2 * np.full(3, size[0])), color=color)]
    elif solid.type in (CYLINDER, CAPSULE):
        tube = _vector(2 * np.array([size[0], size[0], size[1]]))
        parts["cylinders"] = [fg.CylinderPrimitive(pose=pose, size=tube, bottom_scale=1.0, top_scale=1.0, color=color)]
        if solid.type == CAPSULE:
            w, x, y, z = quat
            axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
            parts["spheres"] = [
                fg.SpherePrimitive(
                    pose=fg.Pose(position=_vector(pos + s * size[1] * axis), orientation=_quaternion(quat)),
                    size=_vector(2 * np.full(3, size[0])),
                    color=color,
                )
                for s in (-1, 1)
            ]
    elif solid.type == MESH and solid.vertices is not None and solid.faces is not None:
        points = [fg.Point3(x=float(v[0]), y=float(v[1]), z=float(v[2])) for v in solid.vertices]
        indices = [int(i) for i in np.ravel(solid.faces)]
        parts["triangles"] = [fg.TriangleListPrimitive(pose=pose, points=points, color=color, indices=indices)]
    else:
        raise ValueError(f"solid {solid.id!r} has geometry type {solid.type}, which cannot be drawn")
    return fg.SceneEntity(timestamp=stamp, frame_id="world", id=solid.id, **parts)

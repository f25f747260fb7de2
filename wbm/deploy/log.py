"""Logs of what the robot saw, what it was told, and what was refused, as MCAP (needs the `mcap` package).

While running, messages go unchunked into `NAME.partial` and reach the operating system on a timer, so a killed process
loses at most one flush interval. Closing packs them into indexed 64 KiB chunks, syncs and renames; `recover` does the
same to a log whose process was killed.
"""

from __future__ import annotations

import json
import os
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from wbm.deploy.bundle import Bundle
from wbm.deploy.driver import Command, Reading
from wbm.deploy.faults import Refused

CHUNK_BYTES = 64 * 1024
_STAMP = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_NUMBERS = {"type": "array", "items": {"type": "number"}}
_SCHEMAS: dict[str, tuple[str, dict[str, Any]]] = {
    "/robot/joint_states": (
        "foxglove.JointStates",
        {
            "timestamp": _STAMP,
            "joints": {
                "type": "array",
                "items": {
                    "type": "object",
                    "properties": {
                        "name": {"type": "string"},
                        "position": {"type": "number"},
                        "velocity": {"type": "number"},
                    },
                },
            },
        },
    ),
    "/policy/action": (
        "wbm.Command",
        {"timestamp": _STAMP, "action": _NUMBERS, "q_target": _NUMBERS, "qd_target": _NUMBERS},
    ),
    "/log": (
        "foxglove.Log",
        {"timestamp": _STAMP, "level": {"type": "integer"}, "message": {"type": "string"}, "name": {"type": "string"}},
    ),
}
_OBSERVATION = "/policy/observation"
INFO, WARNING = 2, 3  # foxglove.Log levels


def encode_arrays(arrays: dict[str, np.ndarray]) -> bytes:
    """Arrays as one message, bit for bit: header length (uint32), JSON header, then the raw bytes in order."""
    header = json.dumps({k: [v.dtype.str, list(v.shape)] for k, v in arrays.items()}).encode()
    return b"".join(
        [struct.pack("<I", len(header)), header, *(np.ascontiguousarray(v).tobytes() for v in arrays.values())]
    )


def decode_arrays(data: bytes) -> dict[str, np.ndarray]:
    """Inverse of `encode_arrays`.

    Raises:
        ValueError: the message does not hold what its header says.
    """
    (size,) = struct.unpack_from("<I", data)
    header, offset, arrays = json.loads(data[4 : 4 + size]), 4 + size, {}
    for name, (dtype, shape) in header.items():
        kind = np.dtype(dtype)
        count = int(np.prod(shape))
        if kind.hasobject or offset + count * kind.itemsize > len(data):
            raise ValueError(f"array {name!r} does not fit its message")
        arrays[name] = np.frombuffer(data, kind, count, offset).reshape(shape)
        offset += count * kind.itemsize
    return arrays


class RunLog:
    """Writes one run; use as a context manager.

    Args:
        path: the finished file; `.partial` is appended while running.
        flush_s: how much time a kill may cost, s.
        observations: also store what the network saw, so that `replay` can run another bundle on it.

    Raises:
        ImportError: the `mcap` package is missing.
    """

    def __init__(self, path: str | Path, flush_s: float = 0.25, observations: bool = True) -> None:
        from mcap.writer import CompressionType, Writer

        self.path = Path(path)
        self.partial = self.path.with_name(self.path.name + ".partial")
        self._flush_s = flush_s
        self._stream = open(self.partial, "wb")  # noqa: SIM115 - closed by `close`
        self._writer = Writer(self._stream, use_chunking=False, compression=CompressionType.NONE)
        self._writer.start(profile="", library="wbm")
        self._channels = {}
        for topic, (name, properties) in _SCHEMAS.items():
            schema = json.dumps({"title": name, "type": "object", "properties": properties}).encode()
            self._channels[topic] = self._writer.register_channel(
                topic, "json", self._writer.register_schema(name, "jsonschema", schema)
            )
        self._observations = observations
        if observations:
            self._channels[_OBSERVATION] = self._writer.register_channel(_OBSERVATION, "wbm-arrays", 0)
        self._synced = time.monotonic()
        self._flush()

    def __enter__(self) -> RunLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def reading(self, reading: Reading) -> None:
        """Log measured joints at their stamp."""
        joints = [
            {"name": n, "position": float(p), "velocity": float(v)}
            for n, p, v in zip(reading.joint_names, reading.q, reading.qd, strict=True)
        ]
        self._json("/robot/joint_states", reading.stamps["joints"], {"joints": joints})

    def command(self, command: Command, observation: dict[str, np.ndarray]) -> None:
        """Log what was commanded and, if wished, what the network saw."""
        values = {
            k: np.asarray(getattr(command, k), dtype=np.float64).tolist() for k in ("action", "q_target", "qd_target")
        }
        self._json("/policy/action", command.stamp, values)
        if self._observations:
            answer = {**observation, "action": np.asarray(command.action, dtype=np.float32)}
            self._write(_OBSERVATION, command.stamp, encode_arrays(answer))

    def refusal(self, stamp: float, refused: Refused) -> None:
        """Log a refusal under its name."""
        self._json("/log", stamp, {"level": WARNING, "name": refused.fault.value, "message": refused.detail})

    def note(self, stamp: float, message: str) -> None:
        """Log a remark."""
        self._json("/log", stamp, {"level": INFO, "name": "runtime", "message": message})

    def close(self) -> None:
        """Pack into chunks, sync and rename to the final name."""
        if self._stream.closed:
            return
        self._writer.finish()
        self._stream.close()
        recover(self.partial, self.path)

    def _json(self, topic: str, stamp: float, data: dict[str, Any]) -> None:
        nanoseconds = round(stamp * 1e9)
        data["timestamp"] = {"sec": nanoseconds // 10**9, "nsec": nanoseconds % 10**9}
        self._write(topic, stamp, json.dumps(data).encode())

    def _write(self, topic: str, stamp: float, data: bytes) -> None:
        time_ns = max(0, round(stamp * 1e9))
        self._writer.add_message(self._channels[topic], log_time=time_ns, data=data, publish_time=time_ns)
        if time.monotonic() - self._synced >= self._flush_s:
            self._flush()

    def _flush(self) -> None:
        self._stream.flush()  # what the operating system has survives a kill of this process
        self._synced = time.monotonic()


def recover(partial: str | Path, path: str | Path) -> int:
    """Turn a (possibly cut) log into a finished one and remove the partial file.

    Args:
        partial: what a killed process left.
        path: where the finished file goes, by fsync and rename.

    Returns:
        Number of messages saved.
    """
    from mcap.writer import Writer

    partial, path = Path(partial), Path(path)
    packed = path.with_name(path.name + ".packed")
    count = 0
    with open(packed, "wb") as stream:
        writer = Writer(stream, chunk_size=CHUNK_BYTES)
        writer.start(profile="", library="wbm")
        schemas: dict[int, int] = {0: 0}
        channels: dict[int, int] = {}
        for record in _records(partial):
            kind = type(record).__name__
            if kind == "Schema" and record.id not in schemas:
                schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            elif kind == "Channel" and record.id not in channels:
                channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
                )
            elif kind == "Message":
                writer.add_message(channels[record.channel_id], record.log_time, record.data, record.publish_time)
                count += 1
        writer.finish()
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(packed, path)
    partial.unlink()
    return count


def _records(path: Path) -> Iterator[Any]:
    """Records of an MCAP file up to its end or to the first one that was cut."""
    from mcap.exceptions import McapError
    from mcap.stream_reader import StreamReader

    with open(path, "rb") as stream:
        try:
            yield from StreamReader(stream, record_size_limit=1 << 28).records
        except (McapError, struct.error, EOFError):
            return


def read_messages(path: str | Path, topic: str) -> Iterator[tuple[float, Any]]:
    """Messages of one topic of a run's log: (stamp in s, decoded JSON or dictionary of arrays).

    Raises:
        ValueError: no MCAP file, or one that a killed process left unfinished.
    """
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    with open(path, "rb") as stream:
        try:
            for _, channel, message in make_reader(stream).iter_messages(topics=[topic]):
                arrays = channel.message_encoding == "wbm-arrays"
                yield message.log_time / 1e9, decode_arrays(message.data) if arrays else json.loads(message.data)
        except (McapError, struct.error, EOFError) as error:
            advice = "wbm.deploy.log.recover(LOG, NEW) saves what a killed process left"
            raise ValueError(f"{path} is no finished MCAP log; {advice}") from error


def replay(path: str | Path, bundle: Bundle) -> dict[str, float]:
    """Run another bundle on what the network saw in a logged run.

    Returns:
        `steps`, `max_difference` and `mean_difference` between logged and new actions (action units).

    Raises:
        ValueError: the log has no observations, or they do not fit the bundle's schema.
    """
    policy, limit, gaps = bundle.policy(), bundle.contract.schema.action.limit, []
    for _, arrays in read_messages(path, _OBSERVATION):
        observation = {k: v[None] for k, v in arrays.items() if k != "action"}
        gaps.append(np.abs(np.clip(policy(observation)[0], -limit, limit) - arrays["action"]))
    if not gaps:
        raise ValueError(f"{path} holds no {_OBSERVATION} messages; record with observations=True")
    return {"steps": len(gaps), "max_difference": float(np.max(gaps)), "mean_difference": float(np.mean(gaps))}

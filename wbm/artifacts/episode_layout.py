"""How one step of an episode becomes one row of bytes, and back (NumPy only).

A row holds every field of a step, so a random step costs one read. Clouds are stored as float16 (at most 1 mm of
rounding within 2 m), flags as bits; everything else keeps its type. The instruction's embedding is stored once a
sentence, not once a step.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

FORMAT_VERSION = 1
CHUNK_STEPS = 8
SHARD_STEPS = 4096

TEXT_FIELD = "text"
"""The observation field that an episode stores once, not each step."""


@dataclass(frozen=True)
class StepField:
    """One array of a step.

    Attributes:
        name: key in an episode.
        shape: per step.
        dtype: NumPy name, as given and returned.
        stored: NumPy name on disk, or "bits" for flags.
    """

    name: str
    shape: tuple[int, ...]
    dtype: str
    stored: str

    @property
    def num_bytes(self) -> int:
        """Bytes of a step on disk, before compression."""
        count = int(np.prod(self.shape, dtype=np.int64))
        return (count + 7) // 8 if self.stored == "bits" else count * np.dtype(self.stored).itemsize


def shard_index(folder: str | os.PathLike[str], number: int) -> Path:
    """Where the index of a shard lies; the shard is complete when it exists."""
    return Path(folder) / f"shard-{number:05d}.json"


STARTS = ("full", "pregrasp", "scattered")
"""How an episode starts: from the scene's start pose, at a pre-grasp, or somewhere on the way, off the usual path."""


@dataclass(frozen=True)
class EpisodeInfo:
    """What is known of a whole episode.

    Attributes:
        first: row of the first step in its shard (set by the writer).
        length: number of steps (set by the writer).
        instructions: rows of the shard's sentence table, the phrasings that fit (set by the writer).
        scene: scene id.
        object: object id.
        teacher: name of the teacher that was routed to.
        noise: factor of the noise injected into what was executed; 0 for none.
        start: one of `STARTS`.
        success: whether the episode ended in success.
        seed: that the episode can be made again from.
    """

    first: int
    length: int
    instructions: tuple[int, ...]
    scene: str
    object: str
    teacher: str
    noise: float
    start: str
    success: bool
    seed: int


LABELS: tuple[StepField, ...] = (
    StepField("action", (32,), "float32", "float32"),
    StepField("executed", (32,), "float32", "float32"),
    StepField("p_obj_b", (3,), "float32", "float32"),
    StepField("p_obj_w", (3,), "float32", "float32"),
    StepField("base_pose", (3,), "float32", "float32"),
    StepField("ee_distance", (), "float32", "float32"),
    StepField("stamp", (), "float32", "float32"),
    StepField("phase", (), "uint8", "uint8"),
)
"""What a step holds beside the observation, equation (7): the clean label a_t, the action that was executed (label and
noise), p_obj_t [m] in the base frame and in the world, the base's x, y [m] and yaw [rad] in the world, the distance [m]
from grasp frame to object, seconds since the start, and the phase (0 free space, 1 contact)."""


def _stored_as(name: str, dtype: str) -> str:
    if name.endswith("_xyz"):
        return "float16"
    if name.endswith(("_valid", "_target")):
        return "bits"
    return dtype


class StepLayout:
    """Packs steps into rows of bytes and unpacks them.

    Attributes:
        fields: in the order of the row.
        row_bytes: length of a row.
    """

    def __init__(self, fields: tuple[StepField, ...]) -> None:
        self.fields = fields
        ends = np.cumsum([f.num_bytes for f in fields])
        self._span = {f.name: (int(e) - f.num_bytes, int(e)) for f, e in zip(fields, ends, strict=True)}
        self._field = {f.name: f for f in fields}
        self.row_bytes = int(ends[-1])

    @staticmethod
    def of_schema(schema: Any) -> StepLayout:
        """The layout of a policy schema's observation (all but the text) and the labels."""
        items = [f for f in schema.observation if f.name != TEXT_FIELD]
        return StepLayout(
            tuple(StepField(f.name, tuple(f.shape), f.dtype, _stored_as(f.name, f.dtype)) for f in items) + LABELS
        )

    def to_list(self) -> list[dict[str, Any]]:
        """JSON-ready description, with each field's place in the row."""
        return [
            {
                "name": f.name,
                "shape": list(f.shape),
                "dtype": f.dtype,
                "stored": f.stored,
                "offset": self._span[f.name][0],
            }
            for f in self.fields
        ]

    @staticmethod
    def from_list(data: list[dict[str, Any]]) -> StepLayout:
        """The inverse of `to_list`."""
        return StepLayout(tuple(StepField(d["name"], tuple(d["shape"]), d["dtype"], d["stored"]) for d in data))

    def pack(self, steps: dict[str, np.ndarray]) -> np.ndarray:
        """Rows [T, row_bytes] uint8 of arrays [T, *shape].

        Raises:
            ValueError: a field is missing, misshapen, not finite, or out of the range of its stored type.
        """
        length = len(next(iter(steps.values())))
        rows = np.empty((length, self.row_bytes), np.uint8)
        for item in self.fields:
            if item.name not in steps:
                raise ValueError(f"episode field {item.name!r} is missing")
            array = np.asarray(steps[item.name])
            if array.shape != (length, *item.shape):
                raise ValueError(
                    f"episode field {item.name!r} has shape {array.shape}, expected {(length, *item.shape)}"
                )
            flat = array.reshape(length, -1)
            start, end = self._span[item.name]
            if item.stored == "bits":
                rows[:, start:end] = np.packbits(flat != 0, axis=1, bitorder="little")
                continue
            with np.errstate(over="ignore", invalid="ignore"):
                flat = np.ascontiguousarray(flat.astype(item.stored))
            if flat.dtype.kind == "f" and not np.isfinite(flat).all():
                raise ValueError(f"episode field {item.name!r} holds values that are not finite as {item.stored}")
            rows[:, start:end] = flat.view(np.uint8)
        return rows

    def unpack(self, rows: np.ndarray, names: tuple[str, ...] | None = None) -> dict[str, np.ndarray]:
        """Arrays [T, *shape] of rows [T, row_bytes], of all fields or of those named."""
        out: dict[str, np.ndarray] = {}
        for name in names if names is not None else tuple(self._field):
            item = self._field[name]
            start, end = self._span[name]
            part = rows[:, start:end]
            if item.stored == "bits":
                count = int(np.prod(item.shape, dtype=np.int64))
                flat = np.unpackbits(part, axis=1, count=count, bitorder="little")
            else:
                flat = np.ascontiguousarray(part).view(item.stored)
            out[name] = flat.astype(item.dtype, copy=False).reshape(len(rows), *item.shape)
        return out

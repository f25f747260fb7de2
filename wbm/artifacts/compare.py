"""Where two artifacts first differ: which step, which tensor, which element."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wbm.artifacts.manifest import LOGS
from wbm.artifacts.store import Artifact

_BLOCK = 1 << 20
_SAFETENSORS = {"F64": "<f8", "F32": "<f4", "F16": "<f2", "I64": "<i8", "I32": "<i4", "I16": "<i2", "I8": "|i1",
                "U8": "|u1", "BOOL": "|b1", "BF16": "<u2"}  # fmt: skip


@dataclass(frozen=True)
class FirstDifference:
    """The first place where two artifacts differ.

    Attributes:
        path: file, or Zarr group, relative to the artifact.
        tensor: array or tensor within it; empty for other files.
        step: index along the first axis, or the byte offset; -1 when one side has no such file or another layout.
        detail: values on both sides.
        count: how many files or tensors differ in all.
    """

    path: str
    tensor: str
    step: int
    detail: str
    count: int

    def __str__(self) -> str:
        place = f"{self.path}: {self.tensor}" if self.tensor else self.path
        unit = "step" if self.tensor else "byte"
        at = f" at {unit} {self.step}" if self.step >= 0 else ""
        return f"{place}{at}: {self.detail} ({self.count} differ in all)"


def first_difference(old: Artifact, new: Artifact) -> FirstDifference | None:
    """Compare the payloads, logs left out; None when they are the same.

    Time series come first, by step over all their arrays; then tensors, then other files in the order of their names.
    """
    found: list[tuple[int, FirstDifference]] = []
    groups = sorted(_groups(old) | _groups(new))
    for group in groups:
        found += [(0, d) for d in _compare_groups(old.path / group, new.path / group, group)]
    before = {e.path: e.content or e.digest for e in old.manifest.files}
    after = {e.path: e.content or e.digest for e in new.manifest.files}
    for path in sorted(before.keys() | after.keys()):
        if path.startswith((LOGS, *(f"{g}/" for g in groups))) or before.get(path) == after.get(path):
            continue
        if path not in before or path not in after:
            side = "second" if path not in before else "first"
            found.append((2, FirstDifference(path, "", -1, f"only in the {side}", 0)))
        elif path.endswith((".safetensors", ".npz")):
            found += [(1, d) for d in _compare_tensors(old.path / path, new.path / path, path)]
        else:
            found.append((2, _compare_bytes(old.path / path, new.path / path, path)))
    if not found:
        return None
    _, first = min(found, key=lambda item: (item[0], item[1].step if item[0] == 0 else 0))
    return FirstDifference(first.path, first.tensor, first.step, first.detail, len(found))


def _groups(artifact: Artifact) -> set[str]:
    paths = {e.path.removesuffix("/zarr.json") for e in artifact.manifest.files if e.path.endswith("/zarr.json")}
    return {p for p in paths if not any(p.startswith(f"{other}/") for other in paths)}


def _compare_groups(old: Path, new: Path, where: str) -> Iterator[FirstDifference]:
    import zarr

    if not old.is_dir() or not new.is_dir():
        yield FirstDifference(where, "", -1, f"only in the {'first' if old.is_dir() else 'second'}", 0)
        return
    left, right = (dict(zarr.open_group(p, mode="r").members(max_depth=None)) for p in (old, new))
    for name in sorted(left.keys() | right.keys()):
        a, b = left.get(name), right.get(name)
        if isinstance(a, zarr.Group) and isinstance(b, zarr.Group):
            continue
        if not isinstance(a, zarr.Array) or not isinstance(b, zarr.Array):
            yield FirstDifference(where, name, -1, f"only in the {'second' if a is None else 'first'}", 0)
            continue
        if a.shape != b.shape and (not a.shape or not b.shape or a.shape[1:] != b.shape[1:]):
            yield FirstDifference(where, name, -1, f"shape {a.shape} and {b.shape}", 0)
            continue
        if not a.shape:
            found = _first_row(np.atleast_1d(np.asarray(a[...])), np.atleast_1d(np.asarray(b[...])))
            if found:
                yield FirstDifference(where, name, *found, 0)
            continue
        rows, step = min(a.shape[0], b.shape[0]), (a.shards or a.chunks)[0]
        for start in range(0, rows, step):
            stop = min(start + step, rows)
            found = _first_row(np.asarray(a[start:stop]), np.asarray(b[start:stop]))
            if found:
                yield FirstDifference(where, name, start + found[0], found[1], 0)
                break
        else:
            if a.shape != b.shape:
                yield FirstDifference(where, name, rows, f"shape {a.shape} and {b.shape}", 0)


def _compare_tensors(old: Path, new: Path, where: str) -> Iterator[FirstDifference]:
    left, right = _tensors(old), _tensors(new)
    for name in sorted(left.keys() | right.keys()):
        if name not in left or name not in right:
            yield FirstDifference(where, name, -1, f"only in the {'second' if name not in left else 'first'}", 0)
        elif left[name].shape != right[name].shape or left[name].dtype != right[name].dtype:
            shapes = f"{left[name].dtype}{left[name].shape} and {right[name].dtype}{right[name].shape}"
            yield FirstDifference(where, name, -1, shapes, 0)
        else:
            found = _first_row(np.atleast_1d(left[name]), np.atleast_1d(right[name]))
            if found:
                yield FirstDifference(where, name, found[0], found[1], 0)


def _tensors(path: Path) -> dict[str, np.ndarray]:
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    data = path.read_bytes()
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    out = {}
    for name, entry in header.items():
        if name != "__metadata__":
            begin, end = entry["data_offsets"]
            raw = np.frombuffer(data[8 + size + begin : 8 + size + end], dtype=_SAFETENSORS.get(entry["dtype"], "|u1"))
            out[name] = raw.reshape(entry["shape"] if entry["dtype"] in _SAFETENSORS else (-1,))
    return out


def _first_row(a: np.ndarray, b: np.ndarray) -> tuple[int, str] | None:
    """First index along axis 0 whose bits differ, and what is there."""
    if a.shape != b.shape or a.dtype != b.dtype:
        return 0, f"{a.dtype}{a.shape} and {b.dtype}{b.shape}"
    differ = (a != b) & ~((a != a) & (b != b))
    if not differ.any():
        return None
    index = tuple(int(i[0]) for i in np.nonzero(differ))
    return index[0], f"{a[index]!s} and {b[index]!s} at {list(index[1:])}, {int(differ.sum())} elements differ"


def _compare_bytes(old: Path, new: Path, where: str) -> FirstDifference:
    offset = 0
    with open(old, "rb") as left, open(new, "rb") as right:
        while True:
            a, b = left.read(_BLOCK), right.read(_BLOCK)
            if a != b:
                at = next((i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))
                detail = f"{a[at : at + 1]!r} and {b[at : at + 1]!r}"
                return FirstDifference(where, "", offset + at, detail, 0)
            if not a:
                return FirstDifference(where, "", -1, "same bytes", 0)
            offset += len(a)

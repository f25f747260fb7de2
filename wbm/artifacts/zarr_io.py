"""Sharded Zarr v3 arrays: a writer whose unit is a whole shard, a reader that trusts the manifest only.

A missing shard reads back as zeros in Zarr, without an error. So every shard is written even when it is all zeros, and
opening an array for reading checks that each shard of its grid is listed in the manifest and lies on the disk.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.codecs import BloscCodec, BloscShuffle

from wbm.artifacts.errors import ArtifactError
from wbm.artifacts.files import fsync_path, fsync_tree
from wbm.artifacts.manifest import Manifest


@dataclass(frozen=True)
class ArraySpec:
    """Layout of an array.

    Attributes:
        shape: full shape; the first axis is the one that is written shard by shard.
        dtype: NumPy dtype name.
        chunk: length of a chunk along the first axis: what reading a window costs.
        shard: length of a shard along the first axis, a multiple of `chunk`: one file, one writer, the unit of resume.
        attrs: JSON attributes, such as units and frame.
    """

    shape: tuple[int, ...]
    dtype: str
    chunk: int
    shard: int
    attrs: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        if self.chunk < 1 or self.shard % self.chunk:
            raise ValueError(f"shard {self.shard} is no multiple of chunk {self.chunk}")


def create(folder: Path, arrays: Mapping[str, ArraySpec], attrs: Mapping[str, Any] | None = None) -> zarr.Group:
    """Create, or open again after an interruption, a Zarr group with these arrays.

    Raises:
        ArtifactError: the group exists with another layout.
    """
    group = zarr.open_group(folder, mode="a", zarr_format=3)
    if attrs:
        group.attrs.update(dict(attrs))
    for name, spec in arrays.items():
        if name in group:
            found = group[name]
            assert isinstance(found, zarr.Array)
            if found.shape != spec.shape or found.dtype != np.dtype(spec.dtype):
                raise ArtifactError(f"{folder}/{name}: exists with shape {found.shape}; remove it or use --force")
            continue
        group.create_array(
            name,
            shape=spec.shape,
            dtype=spec.dtype,
            chunks=(spec.chunk, *spec.shape[1:]),
            shards=(spec.shard, *spec.shape[1:]),
            compressors=BloscCodec(cname="zstd", clevel=3, shuffle=BloscShuffle.shuffle),
            fill_value=0,
            attributes=dict(spec.attrs or {}),
        )
    fsync_tree(folder)
    fsync_path(folder.parent)
    return group


def write_shard(group: zarr.Group, index: int, data: Mapping[str, np.ndarray]) -> None:
    """Write shard `index` (counted along the first axis) of several arrays and flush it to the disk.

    Raises:
        ValueError: the data does not fill the shard.
    """
    root = getattr(group.store, "root", None)
    for name, values in data.items():
        array = group[name]
        assert isinstance(array, zarr.Array) and array.shards is not None
        start = index * array.shards[0]
        stop = min(start + array.shards[0], array.shape[0])
        if values.shape != (stop - start, *array.shape[1:]):
            raise ValueError(f"{name}: shard {index} has shape {(stop - start, *array.shape[1:])}, got {values.shape}")
        array.with_config({"write_empty_chunks": True})[start:stop] = values  # the setting is not stored in the group
        if root is not None:
            shards = Path(root) / array.path / "c"
            fsync_tree(shards / str(index)) if (shards / str(index)).is_dir() else fsync_path(shards / str(index))
            fsync_path(shards)
            fsync_path(shards.parent)


def open_group(folder: Path, manifest: Manifest) -> zarr.Group:
    """Open a published group for reading.

    Args:
        folder: the group, below the artifact's folder.
        manifest: the artifact's manifest.

    Raises:
        ArtifactError: a shard is missing, truncated or not listed.
    """
    folder = Path(folder)
    base = _artifact_folder(folder)
    prefix = folder.relative_to(base).as_posix()
    prefix = "" if prefix == "." else prefix + "/"
    sizes = {e.path.removeprefix(prefix): e.size for e in manifest.files if e.path.startswith(prefix)}
    if "zarr.json" not in sizes:
        raise ArtifactError(f"{folder}: the manifest lists no Zarr group here")
    wanted = set()
    for path in sizes:
        if path.endswith("zarr.json"):
            wanted.add(path)
            wanted |= _shards(folder, path.removesuffix("zarr.json"))
    for path in sorted(wanted):
        if path not in sizes:
            raise ArtifactError(f"{folder}/{path}: this shard is not in the manifest; rebuild the artifact")
        found = folder / path
        if not found.is_file() or found.stat().st_size != sizes[path]:
            raise ArtifactError(f"{found}: missing or truncated; `wbm artifacts verify` lists all damage")
    return zarr.open_group(folder, mode="r", zarr_format=3, use_consolidated=False)


def _artifact_folder(folder: Path) -> Path:
    for base in (folder, *folder.parents):
        if (base / "manifest.json").is_file():
            return base
    raise ArtifactError(f"{folder}: not inside an artifact")


def _shards(folder: Path, array: str) -> set[str]:
    """Paths of the shards that the array's metadata asks for."""
    meta = json.loads((folder / array / "zarr.json").read_text())
    if meta["node_type"] != "array":
        return set()
    shard = meta["chunk_grid"]["configuration"]["chunk_shape"]
    counts = [-(-length // step) for length, step in zip(meta["shape"], shard, strict=True)]
    separator = meta["chunk_key_encoding"].get("configuration", {}).get("separator", "/")
    return {
        f"{array}c{separator}{separator.join(map(str, index))}" if index else f"{array}c"
        for index in itertools.product(*map(range, counts))
    }

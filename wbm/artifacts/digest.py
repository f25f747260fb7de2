"""Content digests of values, files and trees: BLAKE2b-256, the same bytes on every machine."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path, PurePath
from typing import Any

_CHUNK = 1 << 20
_ZIP_SUFFIXES = {".npz", ".pt", ".pth"}
_MAX_HEADER = 64 << 20
KEY_LENGTH = 12


def new_hash() -> Any:
    """A fresh hash object of the one algorithm used everywhere."""
    return hashlib.blake2b(digest_size=32)


def digest_bytes(data: bytes) -> str:
    """Hex digest of `data`."""
    digest = new_hash()
    digest.update(data)
    return digest.hexdigest()


def plain(value: Any, *, key_only: bool = False) -> Any:
    """Turn dataclasses, tuples and paths into JSON values.

    Args:
        value: any tree of dataclasses, mappings, sequences and scalars.
        key_only: leave out dataclass fields with `metadata={"key": False}`: settings such as a number of worker
            processes, which never change a result.

    Raises:
        TypeError: a leaf that JSON cannot hold.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return {
            f.name: plain(getattr(value, f.name), key_only=key_only)
            for f in fields(value)
            if not (key_only and f.metadata.get("key") is False)
        }
    if isinstance(value, Mapping):
        return {str(k): plain(v, key_only=key_only) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v, key_only=key_only) for v in value]
    if isinstance(value, PurePath):
        return value.as_posix()
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if getattr(value, "shape", None) == ():  # a NumPy scalar
        return value.tolist()  # pyright: ignore[reportAttributeAccessIssue]
    raise TypeError(f"cannot write a {type(value).__name__} into a manifest")


def canonical_json(value: Any) -> bytes:
    """Serialise with sorted keys and no spaces, so that equal values have equal bytes."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=True).encode()


def digest_value(value: Any) -> str:
    """Hex digest of a tree of plain values or dataclasses."""
    return digest_bytes(canonical_json(plain(value)))


def digest_file(path: Path) -> str:
    """Hex digest of a file's bytes."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, new_hash).hexdigest()


def digest_content(path: Path) -> str:
    """Hex digest of what a file means, where its bytes also hold names or metadata.

    Tensors are taken one by one: a `.safetensors` file without its free-form metadata, the members of an `.npz` or a
    torch archive without time stamps and without the archive's own name. Other files count as their bytes.

    Raises:
        ValueError: a tensor file whose header is damaged.
    """
    if path.suffix == ".safetensors":
        return _digest_safetensors(path)
    if path.suffix in _ZIP_SUFFIXES and zipfile.is_zipfile(path):
        return _digest_zip(path)
    return digest_file(path)


def _digest_safetensors(path: Path) -> str:
    total = new_hash()
    with open(path, "rb") as stream:
        size = int.from_bytes(stream.read(8), "little")
        if size > _MAX_HEADER:
            raise ValueError(f"{path}: the safetensors header is damaged")
        try:
            header = json.loads(stream.read(size))
        except ValueError as error:
            raise ValueError(f"{path}: the safetensors header is damaged") from error
        header.pop("__metadata__", None)
        for name in sorted(header):
            entry = header[name]
            begin, end = entry["data_offsets"]
            total.update(canonical_json([name, entry["dtype"], entry["shape"], end - begin]))
            stream.seek(8 + size + begin)
            _update(total, stream, end - begin)
    return total.hexdigest()


def _digest_zip(path: Path) -> str:
    total = new_hash()
    with zipfile.ZipFile(path) as archive:
        members = {}
        for info in archive.infolist():
            name = info.filename
            if path.suffix != ".npz":  # torch.save prefixes every member with the file's name
                name = name.split("/", 1)[-1]
            if name != ".data/serialization_id":  # a hash over member names
                members[name] = info
        for name in sorted(members):
            total.update(canonical_json([name, members[name].file_size]))
            with archive.open(members[name]) as stream:
                _update(total, stream, members[name].file_size)
    return total.hexdigest()


def _update(total: Any, stream: Any, count: int) -> None:
    while count > 0:
        block = stream.read(min(_CHUNK, count))
        if not block:
            raise ValueError(f"{getattr(stream, 'name', 'archive')}: ends before its last tensor")
        total.update(block)
        count -= len(block)


def digest_payload(entries: Iterable[tuple[str, str]]) -> str:
    """Content digest of an artifact from its `(relative path, content digest)` pairs, in any order."""
    return digest_value(sorted([path, content] for path, content in entries))

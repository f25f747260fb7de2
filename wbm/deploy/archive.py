"""The container of a bundle: a stored (uncompressed) zip whose comment seals every byte before it.

The SHA-256 of everything before the comment stands in the comment, so that a flipped bit anywhere, also in places that
zip readers skip, is found before any member is looked at. Reading never extracts to disk.
"""

from __future__ import annotations

import hashlib
import io
import zipfile
from pathlib import Path

import numpy as np

from wbm.deploy.faults import BundleError, Fault

MAGIC = b"wbm-bundle/"
VERSION = 1
MAX_TOTAL = 1 << 30
MAX_MEMBER = {"policy.onnx": 1 << 29, "golden.npz": 1 << 28, "instructions.npz": 1 << 28}
MAX_JSON = 1 << 24
_SEAL = MAGIC + b"%d sha256=%s"
_SEAL_SIZE = len(_SEAL % (VERSION, b"0" * 64))
_EPOCH = (1980, 1, 1, 0, 0, 0)


def pack(members: dict[str, bytes]) -> bytes:
    """The bytes of a sealed archive: same members, same bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(members):
            info = zipfile.ZipInfo(name, _EPOCH)
            info.create_system = 3
            info.external_attr = 0o644 << 16
            archive.writestr(info, members[name])
        archive.comment = b"0" * _SEAL_SIZE
    body = buffer.getvalue()[:-_SEAL_SIZE]
    return body + _SEAL % (VERSION, hashlib.sha256(body).hexdigest().encode())


def unpack(path: Path, allowed: frozenset[str]) -> dict[str, bytes]:
    """Read every member of a sealed archive into memory.

    Args:
        path: the file.
        allowed: names that may occur.

    Raises:
        FileNotFoundError: no such file.
        BundleError: `NOT_A_BUNDLE`, `TRUNCATED`, `BUNDLE_VERSION`, `CHECKSUM`, `TOO_LARGE`, `UNSAFE_PATH` or
            `UNKNOWN_MEMBER`.
    """
    size = path.stat().st_size
    if size > MAX_TOTAL:
        raise BundleError(Fault.TOO_LARGE, f"{path} has {size} bytes, at most {MAX_TOTAL} are read")
    data = path.read_bytes()
    _check_seal(path, data)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members: dict[str, bytes] = {}
        for info in archive.infolist():
            name = info.filename
            # A name is a plain file name: no folders, no drive, no parent, so nothing can leave a directory.
            if name in ("", ".", "..") or any(c in name for c in "/\\:\0"):
                raise BundleError(
                    Fault.UNSAFE_PATH, f"{path} holds a member named {name!r}; the bundle must not be trusted"
                )
            if name in members or name not in allowed:
                raise BundleError(
                    Fault.UNKNOWN_MEMBER,
                    f"{path} holds {name!r} {'twice' if name in members else ''}; expected {sorted(allowed)}",
                )
            if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
                raise BundleError(
                    Fault.NOT_A_BUNDLE, f"{path}: member {name} is compressed; bundles store members as they are"
                )
            if info.file_size > MAX_MEMBER.get(name, MAX_JSON):
                raise BundleError(
                    Fault.TOO_LARGE, f"{path}: member {name} has {info.file_size} bytes, more than is read"
                )
            try:
                members[name] = archive.read(info)
            except (zipfile.BadZipFile, OSError, EOFError, ValueError) as error:
                raise BundleError(Fault.CHECKSUM, f"{path}: member {name} cannot be read ({error})") from error
    return members


def _check_seal(path: Path, data: bytes) -> None:
    if data[:4] != b"PK\x03\x04":
        if data.rfind(b"PK\x05\x06") > 0 and data[-_SEAL_SIZE:].startswith(MAGIC):
            raise BundleError(Fault.CHECKSUM, f"{path} is damaged at its start; fetch it again")
        raise BundleError(Fault.NOT_A_BUNDLE, f"{path} is not a bundle; export one with `wbm deploy-export`")
    seal = data[-_SEAL_SIZE:]
    if not seal.startswith(MAGIC):
        raise BundleError(Fault.TRUNCATED, f"{path} ends without a seal: it is cut short or damaged; fetch it again")
    version, _, digest = seal[len(MAGIC) :].partition(b" sha256=")
    if digest != hashlib.sha256(data[:-_SEAL_SIZE]).hexdigest().encode():
        raise BundleError(Fault.CHECKSUM, f"{path} does not match its seal: bytes were changed; fetch it again")
    if version != b"%d" % VERSION:
        raise BundleError(
            Fault.BUNDLE_VERSION,
            f"{path} has container version {version.decode(errors='replace')}, this runtime reads {VERSION}",
        )


def save_arrays(arrays: dict[str, np.ndarray]) -> bytes:
    """An uncompressed npz; same arrays, same bytes."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def load_arrays(data: bytes, name: str) -> dict[str, np.ndarray]:
    """Arrays of an uncompressed npz; nothing is unpickled and nothing can expand.

    Raises:
        BundleError: `CONTRACT` with the member's name.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as inner:
            if any(i.compress_type != zipfile.ZIP_STORED or i.file_size > len(data) for i in inner.infolist()):
                raise ValueError("entries must be stored uncompressed")
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            return {key: arrays[key] for key in arrays.files}
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise BundleError(Fault.CONTRACT, f"{name} cannot be read: {error}") from error

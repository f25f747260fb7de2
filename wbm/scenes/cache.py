"""Results of slow work on assets, kept across runs by content in the user's cache folder."""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
import zipfile
from functools import cache
from pathlib import Path

import numpy as np


def cache_folder() -> Path:
    """`$WBM_CACHE`, or `wbm` in the platform's cache folder."""
    if os.environ.get("WBM_CACHE"):
        return Path(os.environ["WBM_CACHE"])
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "wbm"


def load_arrays(section: str, key: str) -> dict[str, np.ndarray] | None:
    """What `store_arrays` kept under this key; None when there is nothing, or nothing readable."""
    path = cache_folder() / section / f"{key}.npz"
    try:
        with np.load(path, allow_pickle=False) as data:
            return dict(data)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, KeyError):
        return None


def store_arrays(section: str, key: str, **arrays: np.ndarray) -> None:
    """Keep arrays under a key. A cache that cannot be written is no error: the work is only done again."""
    folder = cache_folder() / section
    temporary = ""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder, suffix=".tmp", delete=False) as stream:
            temporary = stream.name
            np.savez_compressed(stream, **arrays)  # pyright: ignore[reportArgumentType]
        os.replace(temporary, folder / f"{key}.npz")
    except OSError:
        if temporary and os.path.exists(temporary):
            os.unlink(temporary)


@cache
def code_digest() -> str:
    """Digest of the sources of this room and of the robot's: what is drawn and settled depends on both."""
    here = Path(__file__).parent
    digest = hashlib.blake2b(digest_size=16)
    for folder in (here, here.parent / "robot"):
        for path in sorted(folder.glob("*.py")) + sorted(folder.glob("*.yaml")):
            digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()


def array_digest(*parts: object) -> str:
    """Digest of arrays and of anything whose `repr` says what it is."""
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(f"{part.dtype.str}{part.shape}".encode())
            digest.update(np.ascontiguousarray(part).tobytes())
        else:
            digest.update(repr(part).encode())
    return digest.hexdigest()

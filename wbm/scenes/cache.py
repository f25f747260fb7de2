"""Results of slow work on assets, kept across runs by content in the user's cache folder."""

from __future__ import annotations

import os
import sys
import tempfile
import zipfile
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
            np.savez_compressed(stream, **arrays)
        os.replace(temporary, folder / f"{key}.npz")
    except OSError:
        if temporary and os.path.exists(temporary):
            os.unlink(temporary)

"""Collects the objects of a run: procedural ones, a folder of meshes, or the 1,000 that pybullet bundles."""

from __future__ import annotations

import importlib.util
import os
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from wbm.scenes.cache import array_digest
from wbm.scenes.config import ObjectsConfig
from wbm.scenes.decompose import Imported, cached_import, import_key, import_mesh, keep_import
from wbm.scenes.families import Draft
from wbm.scenes.isolate import run_isolated
from wbm.scenes.meshfile import SUFFIXES
from wbm.scenes.objects import ObjectEntry, ObjectSet, stack_objects
from wbm.scenes.parts import IDENTITY, hull_part
from wbm.scenes.procedural import COLORS, SIZE_WORDS, draw_mass, draw_objects, size_word

TIMEOUT = 300.0
_FILLER = {"mesh", "model", "textured", "visual", "collision", "obj", "blob", "object", *SIZE_WORDS, *COLORS}
MEMORY_MB = 6000
MIN_FAMILIES = 5
"""With at least this many folders, two of them are held out as whole families."""

Track = Callable[[Iterable], Iterable]


def collect_objects(cfg: ObjectsConfig, seed: int, track: Track = iter) -> tuple[ObjectSet, dict[str, Any]]:
    """The object set, and a report: what was read, what was skipped and why, how meshes were scaled.

    Args:
        track: wraps an iterable with a progress bar.

    Raises:
        ValueError: nothing usable, or more than half of the meshes failed.
        FileNotFoundError: the folder or the package does not exist.
    """
    if cfg.source == "procedural":
        entries = list(track(draw_objects(cfg, seed)))
        return stack_objects(entries), {"source": cfg.source, "read": len(entries), "skipped": {}, "scaled": {}}
    root = mesh_folder(cfg)
    files = find_meshes(root, cfg)
    return import_objects(root, files, cfg, seed, track)


def mesh_folder(cfg: ObjectsConfig) -> Path:
    """The folder that meshes are read from.

    Raises:
        FileNotFoundError: with what to do.
    """
    if cfg.source == "meshes":
        root = Path(cfg.path).expanduser()
        if not root.is_dir():
            raise FileNotFoundError(f"objects.path={cfg.path}: no such folder")
        return root
    spec = importlib.util.find_spec("pybullet_data")
    places = list(spec.submodule_search_locations or ()) if spec else []
    if not places:
        raise FileNotFoundError("objects=pybullet needs the bundled objects: `pip install 'wbm[objects]'`")
    return Path(places[0]) / "random_urdfs"


def find_meshes(root: Path, cfg: ObjectsConfig) -> list[Path]:
    """Mesh files under `root`, sorted by path; at most `cfg.count` spread over them when that is positive.

    Raises:
        ValueError: there are none.
    """
    files = sorted(p for p in root.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())
    if not files:
        raise ValueError(f"{root}: no {', '.join(s[1:].upper() for s in SUFFIXES)} files in it")
    if 0 < cfg.count < len(files):
        files = [files[i] for i in np.linspace(0, len(files) - 1, cfg.count).round().astype(int)]
    return files


def sources_digest(cfg: ObjectsConfig) -> str:
    """Digest of the names and contents of the mesh files that a run would read.

    Raises:
        FileNotFoundError: the folder or the package does not exist.
        ValueError: there are no meshes.
    """
    root = mesh_folder(cfg)
    keys = []
    for path in find_meshes(root, cfg):
        try:
            content = import_key(path, cfg)
        except OSError:  # such a file is skipped by name
            content = ""
        keys.append((path.relative_to(root).as_posix(), content))
    return array_digest(*keys)


def import_objects(
    root: Path, files: list[Path], cfg: ObjectsConfig, seed: int, track: Track
) -> tuple[ObjectSet, dict[str, Any]]:
    """Import files in parallel; the order of the objects is that of the files.

    Raises:
        ValueError: more than half of the files failed.
    """
    workers = cfg.workers or os.cpu_count() or 1
    results: list[Imported] = [Imported([])] * len(files)
    for _ in track(_Imports(results, files, cfg, workers)):
        pass
    names = [path.relative_to(root).as_posix() for path in files]
    skipped = {n: r.reason for n, r in zip(names, results, strict=True) if not r.hulls}
    if len(skipped) * 2 > len(files):
        some = "; ".join(f"{n}: {r}" for n, r in list(skipped.items())[:3])
        raise ValueError(f"objects: {len(skipped)} of {len(files)} meshes in {root} cannot be used ({some})")
    families = [Path(n).parent.name or "mesh" for n in names]
    usable = [k for k, r in enumerate(results) if r.hulls]
    held_out = choose_held_out([families[k] for k in usable], cfg, seed)
    entries = [imported_entry(names[k], families[k], results[k], k, held_out, cfg, seed) for k in usable]
    scaled = {names[k]: results[k].rule for k in usable}
    return stack_objects(entries), {"source": cfg.source, "read": len(files), "skipped": skipped, "scaled": scaled}


class _Imports:
    """Iterates over finished imports, filling `results`; its length is the number of files, for a progress bar."""

    def __init__(self, results: list[Imported], files: list[Path], cfg: ObjectsConfig, workers: int) -> None:
        self._results, self._files, self._cfg, self._workers = results, files, cfg, workers

    def __len__(self) -> int:
        return len(self._files)

    def __iter__(self) -> Iterator[int]:
        fresh = []
        for index, path in enumerate(self._files):
            kept = cached_import(path, self._cfg)
            if kept is None:
                fresh.append(index)
                continue
            self._results[index] = kept
            yield index
        jobs = [(self._files[index], self._cfg) for index in fresh]
        for number, result, reason in run_isolated(import_mesh, jobs, self._workers, TIMEOUT, MEMORY_MB):
            index = fresh[number]
            if result is None:  # a crash or a time-out may be the machine's fault: it is not kept
                self._results[index] = Imported([], reason)
            else:
                self._results[index] = result
                keep_import(self._files[index], self._cfg, result)
            yield index


def choose_held_out(families: list[str], cfg: ObjectsConfig, seed: int) -> tuple[str, ...]:
    """Families that are all test: the configured ones that exist, else two by seed where there are enough folders."""
    present = sorted(set(families))
    configured = tuple(f for f in cfg.held_out if f in present)
    if configured or len(present) < MIN_FAMILIES:
        return configured
    # When every mesh has a folder of its own, folders say nothing about kinds; the split by object is all there is.
    if len(present) > len(families) / 2:
        return ()
    return tuple(np.random.default_rng([seed, 0xFA]).choice(present, 2, replace=False).tolist())


def imported_entry(
    name: str, family: str, imported: Imported, index: int, held_out: tuple[str, ...], cfg: ObjectsConfig, seed: int
) -> ObjectEntry:
    """The object of an imported mesh; colour, mass and split are drawn from (seed, index)."""
    rng = np.random.default_rng([seed, index, 0x0B2])
    draft = Draft([hull_part(h) for h in imported.hulls])
    color = list(COLORS)[rng.integers(len(COLORS))]
    rgb = np.clip(np.array(COLORS[color]) + rng.normal(0, 0.02, 3), 0.02, 0.98)
    u = rng.random()
    split = (
        "test" if family in held_out or u < cfg.test_share else "val" if u < cfg.test_share + cfg.val_share else "train"
    )
    return ObjectEntry(
        name=name,
        noun=noun_of(Path(name).stem),
        family=family,
        color=color,
        size_word=size_word(draft),
        rgb=tuple(rgb),
        parts=draft.parts,
        mass=draw_mass(draft, rng, cfg),
        split=split,
        rests=[IDENTITY],
        seed=int(rng.integers(2**31)),
    )


def noun_of(stem: str) -> str:
    """Words of a file's name without numbers, filler, colours and sizes; `object` when none are left.

    Colours and sizes are drawn for imported meshes: a "red toy" that is blue would mislead.
    """
    spaced = re.sub(r"([a-z])([A-Z])", r"\1 \2", stem)
    words = re.findall(r"[a-z]{3,}", spaced.lower())
    words = [w for w in words if w not in _FILLER]
    return " ".join(words[:3]) or "object"

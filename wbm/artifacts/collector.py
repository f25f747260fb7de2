"""What nothing needs any more, and how it is deleted."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from wbm.artifacts.files import remove_tree
from wbm.artifacts.lease import is_held, is_live
from wbm.artifacts.lineage import load_all
from wbm.artifacts.manifest import Manifest
from wbm.artifacts.store import Store

GRACE_S = 24 * 3600.0


@dataclass(frozen=True)
class Garbage:
    """What `gc` would delete: artifacts that nothing reaches, and folders of interrupted or failed attempts."""

    artifacts: list[str] = field(default_factory=list)
    folders: list[Path] = field(default_factory=list)
    bytes: int = 0


def garbage(store: Store, grace_s: float = GRACE_S) -> Garbage:
    """Find what nothing reaches from `latest` references and pins, through the inputs of each artifact.

    Args:
        store: where to look.
        grace_s: leave alone what is younger: artifacts by creation, folders by last change (seconds).
    """
    manifests = load_all(store)
    latest = {m.ref for m in (store.latest(*name) for name in {(m.kind, m.name) for m in manifests.values()}) if m}
    reached = _closure(latest | set(store.pins()), manifests)
    artifacts = sorted(set(manifests) - reached)
    folders = _stale_folders(store, grace_s)
    size = sum(manifests[ref].size for ref in artifacts)
    size += sum(f.stat().st_size for folder in folders for f in folder.rglob("*") if f.is_file())
    return Garbage(artifacts, folders, size)


def _closure(roots: Iterable[str], manifests: Mapping[str, Manifest]) -> set[str]:
    reached: set[str] = set()
    todo = list(roots)
    while todo:
        ref = todo.pop()
        if ref not in reached:
            reached.add(ref)
            todo += [i.ref for i in manifests[ref].inputs.values()] if ref in manifests else []
    return reached


def _stale_folders(store: Store, grace_s: float) -> list[Path]:
    """Staging and quarantine folders that no live process holds and nobody touched for `grace_s` seconds."""
    found = []
    for area in (".staging", ".quarantine"):
        for path in sorted((store.backend.work / area).glob("*/*/*")):
            ref = path.relative_to(store.backend.work / area).as_posix().removesuffix(".scratch")
            idle = time.time() - max(path.stat().st_mtime, path.stat().st_ctime)
            if idle >= grace_s and not (area == ".staging" and is_held(store.backend, ref)):
                found.append(path)
    return found


def collect(store: Store, found: Garbage, grace_s: float = GRACE_S) -> None:
    """Delete what `garbage` found, users before what they were made from."""
    manifests = {ref: store.manifest(ref) for ref in found.artifacts}
    left = set(found.artifacts)
    while left:
        used = {i.ref for ref in left for i in manifests[ref].inputs.values()}
        for ref in sorted(left - used) or sorted(left):
            store.remove(ref, force=True)
            left.discard(ref)
    for folder in found.folders:
        remove_tree(folder)
    _forget_leases(store)
    store.backend.sweep(grace_s)


def _forget_leases(store: Store) -> None:
    """Delete the records of leases that nobody holds and whose attempt left nothing behind."""
    for path in store.backend.records("leases"):
        staging = store.staging(path.removeprefix("leases/"))
        if not is_live(store.backend, path) and not staging.exists():
            store.backend.delete(path)

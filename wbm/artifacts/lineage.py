"""What an artifact came from, what came from it, and what differs between two."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from wbm.artifacts.errors import ArtifactError
from wbm.artifacts.manifest import Manifest
from wbm.artifacts.store import Store


@dataclass(frozen=True)
class Lineage:
    """A tree of artifacts; `slot` says as what the artifact served its parent in the tree."""

    ref: str
    slot: str
    manifest: Manifest | None  # None: no longer in the store
    branches: tuple[Lineage, ...] = ()


def load_all(store: Store) -> dict[str, Manifest]:
    """Manifests of all readable artifacts by full name."""
    found = {}
    for ref in store.names():
        try:
            found[ref] = store.manifest(ref)
        except ArtifactError:
            continue  # `verify` reports it
    return found


def ancestors(ref: str, manifests: Mapping[str, Manifest], slot: str = "") -> Lineage:
    """What `ref` was made from, up to the first stage."""
    manifest = manifests.get(ref)
    inputs = manifest.inputs if manifest else {}
    return Lineage(ref, slot, manifest, tuple(ancestors(i.ref, manifests, s) for s, i in sorted(inputs.items())))


def descendants(ref: str, manifests: Mapping[str, Manifest], slot: str = "") -> Lineage:
    """What was made from `ref`."""
    branches = []
    for user, manifest in sorted(manifests.items()):
        branches += [descendants(user, manifests, s) for s, i in sorted(manifest.inputs.items()) if i.ref == ref]
    return Lineage(ref, slot, manifests.get(ref), tuple(branches))


@dataclass(frozen=True)
class Difference:
    """What differs between two artifacts, section by section; each entry is `(name, old, new)`."""

    config: list[tuple[str, Any, Any]]
    code: list[tuple[str, Any, Any]]
    inputs: list[tuple[str, Any, Any]]
    versions: list[tuple[str, Any, Any]]
    environment: list[tuple[str, Any, Any]]
    metrics: list[tuple[str, Any, Any]]
    files: list[tuple[str, Any, Any]]


def compare(old: Manifest, new: Manifest) -> Difference:
    """Differences of two manifests."""
    return Difference(
        config=differences(old.config, new.config),
        code=differences(old.code, new.code, nested=False),
        inputs=differences(
            {slot: f"{i.ref} {i.content_digest[:12]}" for slot, i in old.inputs.items()},
            {slot: f"{i.ref} {i.content_digest[:12]}" for slot, i in new.inputs.items()},
            nested=False,
        ),
        versions=differences(old.versions, new.versions, nested=False),
        environment=differences(old.environment, new.environment),
        metrics=differences(old.metrics, new.metrics),
        files=differences(
            {e.path: e.content or e.digest for e in old.files},
            {e.path: e.content or e.digest for e in new.files},
            nested=False,
        ),
    )


def differences(old: Any, new: Any, where: str = "", *, nested: bool = True) -> list[tuple[str, Any, Any]]:
    """Leaves that differ between two trees of plain values; an absent leaf counts as None."""
    if isinstance(old, Mapping) and isinstance(new, Mapping) and (nested or not where):
        out = []
        for name in sorted(old.keys() | new.keys()):
            path = f"{where}.{name}" if where else str(name)
            if name not in old or name not in new:
                out.append((path, old.get(name), new.get(name)))
            else:
                out += differences(old[name], new[name], path, nested=nested)
        return out
    same = old == new or (old != old and new != new)  # NaN equals NaN here
    return [] if same else [(where, old, new)]

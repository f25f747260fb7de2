"""Copies artifacts between stores, inputs first, taking up again where an earlier copy stopped."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from wbm.artifacts.lineage import ancestors, load_all
from wbm.artifacts.manifest import Manifest
from wbm.artifacts.store import Store


def copy_all(
    source: Store, target: Store, names: Sequence[str], task: Callable[..., Any]
) -> tuple[list[str], list[str]]:
    """Copy the named artifacts and all they were made from; without a name, everything.

    Args:
        source: read from here.
        target: write here.
        names: `kind/name[/key]`.
        task: `task(description, total)` opens a progress bar with `update(n)`.

    Returns:
        What was copied, and what was there already.

    Raises:
        ArtifactError: a missing or damaged artifact, or an unreachable store. What was copied before stays, and a half
            copied artifact is continued by the next call.
    """
    manifests = load_all(source)
    wanted = [source.manifest(name).ref for name in names] or sorted(manifests)
    order: list[str] = []
    for ref in wanted:
        _collect(ref, manifests, order)
    copied, present = [], []
    for ref in order:
        manifest = manifests[ref]
        found = target.find(manifest.kind, manifest.name, manifest.key)
        if found is not None and found.content_digest == manifest.content_digest:
            present.append(ref)
            continue
        with task(f"copy {ref}", 2 * manifest.size) as bar:
            folder = source.backend.fetch(ref, bar.update)
            target.backend.receive(folder, ref, bar.update)
        newest = target.latest(manifest.kind, manifest.name)
        if newest is None or newest.created <= manifest.created:
            target.set_latest(manifest.kind, manifest.name, manifest.key)
        copied.append(ref)
    return copied, present


def _collect(ref: str, manifests: dict[str, Manifest], order: list[str]) -> None:
    for branch in ancestors(ref, manifests).branches:
        if branch.ref in manifests:
            _collect(branch.ref, manifests, order)
    if ref not in order:
        order.append(ref)

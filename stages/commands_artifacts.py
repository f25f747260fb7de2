"""The commands behind `wbm artifacts`."""

from __future__ import annotations

import sys
from dataclasses import asdict
from typing import Any

from typer import Exit

from stages.commands import composer, emit, open_store
from stages.compose import to_yaml
from stages.tables import metrics_text, seconds, table
from wbm.artifacts.manifest import Manifest
from wbm.artifacts.store import Store

_MAX_FILES = 20


def split(items: list[str]) -> tuple[Store, list[str]]:
    """Separate `KEY=VALUE` overrides from artifact names and open the store."""
    overrides = [item for item in items if "=" in item]
    return open_store(composer(overrides)), [item for item in items if "=" not in item]


def size_text(count: int) -> str:
    """Bytes as people write them."""
    value = float(count)
    for unit in ("B", "KiB", "MiB", "GiB"):
        if value < 1024:
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1024
    return f"{value:.1f} TiB"


def ls(items: list[str], as_json: bool) -> None:
    """List artifacts, all or those below the given kinds and names."""
    store, wanted = split(items)
    refs = [r for r in store.names() if not wanted or any(r == w or r.startswith(w.rstrip("/") + "/") for w in wanted)]
    pins = set(store.pins())
    rows: list[dict[str, Any]] = []
    for ref in refs:
        manifest = store.manifest(ref)
        newest = store.latest(manifest.kind, manifest.name)
        rows.append(
            {
                "artifact": ref,
                "created": manifest.created,
                "latest": newest is not None and newest.key == manifest.key,
                "pinned": ref in pins,
                "bytes": manifest.size,
                "files": len(manifest.files),
                "wall_time_s": manifest.wall_time_s,
                "metrics": manifest.metrics,
            }
        )
    if as_json:
        emit(rows)
        return
    if not rows:
        sys.stdout.write(f"nothing published in {store.backend.url}\n")
        return
    body = [
        [r["artifact"], ("latest" if r["latest"] else "") + (" pinned" if r["pinned"] else ""), r["created"],
         size_text(r["bytes"]), seconds(r["wall_time_s"]), metrics_text(r["metrics"])]
        for r in rows
    ]  # fmt: skip
    sys.stdout.write(table(["artifact", "ref", "created", "size", "time", "metrics"], body))


def show(items: list[str], as_json: bool) -> None:
    """Print a manifest."""
    store, names = split(items)
    for name in names:
        manifest = store.manifest(name)
        if as_json:
            emit(asdict(manifest))
        else:
            sys.stdout.write(_describe(manifest, str(store.backend.fetch(manifest.ref))))


def _describe(manifest: Manifest, path: str) -> str:
    values: dict[str, Any] = {
        "artifact": manifest.ref,
        "path": path,
        "stage": manifest.stage,
        "created": manifest.created,
        "wall_time_s": manifest.wall_time_s,
        "content_digest": manifest.content_digest,
        "inputs": {slot: ref.ref for slot, ref in manifest.inputs.items()},
        "metrics": manifest.metrics,
        "config": manifest.config,
        "git": {k: v for k, v in manifest.git.items() if k != "patch"},
        "versions": manifest.versions,
        "environment": manifest.environment,
        "files": {e.path: e.size for e in manifest.files[:_MAX_FILES]},
    }
    more = len(manifest.files) - _MAX_FILES
    return to_yaml(values) + (f"  # and {more} more files\n" if more > 0 else "")


def verify(items: list[str], as_json: bool) -> None:
    """Check every byte; exit with 1 when something is wrong."""
    store, names = split(items)
    refs = names or store.names()
    problems = store.verify(refs)
    if as_json:
        emit({"checked": refs, "problems": problems})
    else:
        for line in problems:
            sys.stdout.write(line + "\n")
        sys.stdout.write(f"{len(refs)} artifacts checked, {len(problems)} problems\n")
    if problems:
        raise Exit(1)

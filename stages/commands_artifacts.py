"""The commands behind `wbm artifacts` and `wbm repro-diff`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from typer import Exit

from stages.commands import composer, emit, open_store
from stages.compose import to_yaml
from stages.convert import ConfigError
from stages.progress import Progress
from stages.tables import metrics_text, seconds, size, table
from wbm.artifacts import collector, lineage
from wbm.artifacts.compare import first_difference
from wbm.artifacts.manifest import Manifest
from wbm.artifacts.reference import WORD, is_reference, publish_reference
from wbm.artifacts.store import Store
from wbm.artifacts.transfer import copy_all

_MAX_FILES = 20


def split(items: Sequence[str], count: int | None = None) -> tuple[Store, list[str]]:
    """Separate `KEY=VALUE` overrides from artifact names and open the store.

    Raises:
        ConfigError: not `count` names (-1: at least one).
    """
    store = open_store(composer([item for item in items if "=" in item]))
    names = [item for item in items if "=" not in item]
    if (count == -1 and not names) or (count is not None and count >= 0 and len(names) != count):
        wanted = {-1: "at least one artifact", 0: "no artifact", 1: "one artifact"}.get(
            count or 0, f"{count} artifacts"
        )
        raise ConfigError(f"name {wanted}, as kind/name[/key]; `wbm artifacts ls` lists them")
    return store, names


def ls(items: Sequence[str], as_json: bool) -> None:
    """List artifacts, all or those below the given kinds and names."""
    store, wanted = split(items)
    if wanted and all(is_reference(w) for w in wanted):
        _list_references(store, wanted, as_json)
        return
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
                "content_digest": manifest.content_digest,
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
        [
            r["artifact"],
            ("latest" if r["latest"] else "") + (" pinned" if r["pinned"] else ""),
            r["created"],
            size(r["bytes"]),
            seconds(r["wall_time_s"]),
            metrics_text(r["metrics"]),
        ]
        for r in rows
    ]
    sys.stdout.write(table(["artifact", "ref", "created", "size", "time", "metrics"], body))


def _list_references(store: Store, wanted: Sequence[str], as_json: bool) -> None:
    names = [n for n in store.references.names() if WORD in wanted or n in wanted]
    found = {name: store.references.get(name).manifest for name in names}
    if as_json:
        emit(
            [
                {
                    "artifact": name,
                    "ref": m.ref,
                    "created": m.created,
                    "bytes": m.size,
                    "files": len(m.files),
                    "wall_time_s": m.wall_time_s,
                    "content_digest": m.content_digest,
                    "metrics": m.metrics,
                }
                for name, m in found.items()
            ]
        )
        return
    body = [
        [name, m.ref, m.created, size(m.size), seconds(m.wall_time_s), metrics_text(m.metrics)]
        for name, m in found.items()
    ]
    header = ["artifact", "published as", "created", "size", "time", "metrics"]
    sys.stdout.write(table(header, body) if body else f"no reference results in {store.references.folder}\n")


def show(items: Sequence[str], as_json: bool) -> None:
    """Print manifests."""
    store, names = split(items, -1)
    for name in names:
        artifact = store.resolve(name)
        if as_json:
            emit({"path": str(artifact.path), **asdict(artifact.manifest)})
        else:
            sys.stdout.write(_describe(artifact.manifest, str(artifact.path)))


def _describe(manifest: Manifest, path: str) -> str:
    values: dict[str, Any] = {
        "artifact": manifest.ref,
        "path": path,
        "stage": manifest.stage,
        "command": manifest.command,
        "note": manifest.note,
        "created": manifest.created,
        "wall_time_s": manifest.wall_time_s,
        "content_digest": manifest.content_digest,
        "inputs": {slot: ref.ref for slot, ref in manifest.inputs.items()},
        "metrics": manifest.metrics,
        "config": manifest.config,
        "seeds": manifest.seeds,
        "git": {k: v for k, v in manifest.git.items() if k != "patch"},
        "versions": manifest.versions,
        "environment": manifest.environment,
        "files": {e.path: e.size for e in manifest.files[:_MAX_FILES]},
    }
    more = len(manifest.files) - _MAX_FILES
    return to_yaml(values) + (f"  # and {more} more files\n" if more > 0 else "")


def why(items: Sequence[str], as_json: bool) -> None:
    """Print what an artifact was made from, and what was made from it."""
    store, names = split(items, 1)
    ref = store.manifest(names[0]).ref
    manifests = {m.ref: m for m in map(store.manifest, store.references.names())} | lineage.load_all(store)
    up, down = lineage.ancestors(ref, manifests), lineage.descendants(ref, manifests)
    if as_json:
        emit({"artifact": ref, "made_from": _branches(up), "used_by": _branches(down)})
        return
    sys.stdout.write(f"{ref}  {_origin(up.manifest)}\nmade from\n{_tree(up.branches)}used by\n{_tree(down.branches)}")


def _branches(node: lineage.Lineage) -> list[dict[str, Any]]:
    return [{"artifact": b.ref, "slot": b.slot, "branches": _branches(b)} for b in node.branches]


def _tree(branches: Sequence[lineage.Lineage], depth: int = 1) -> str:
    if not branches and depth == 1:
        return "  nothing\n"
    lines = ""
    for branch in branches:
        lines += f"{'  ' * depth}{branch.ref}  {_origin(branch.manifest)}\n" + (
            _tree(branch.branches, depth + 1) if branch.branches else ""
        )
    return lines


def _origin(manifest: Manifest | None) -> str:
    if manifest is None:
        return "(no longer in the store)"
    commit = manifest.git.get("commit", "")[:10] + ("+changes" if manifest.git.get("dirty") else "")
    return f"({', '.join(part for part in (manifest.created, manifest.command, commit) if part)})"


def diff(items: Sequence[str], as_json: bool) -> None:
    """Print what differs between two artifacts."""
    store, names = split(items, 2)
    found = asdict(lineage.compare(store.manifest(names[0]), store.manifest(names[1])))
    if as_json:
        emit(
            {section: [dict(zip(("name", "old", "new"), e, strict=True)) for e in es] for section, es in found.items()}
        )
        return
    for section, entries in found.items():
        for name, old, new in entries:
            if section in ("code", "files"):
                what = "added" if old is None else "removed" if new is None else "changed"
                sys.stdout.write(f"{section:12} {name} {what}\n")
            else:
                sys.stdout.write(f"{section:12} {name} {old} -> {new}\n")
    if not any(found.values()):
        sys.stdout.write("no difference\n")


def repro_diff(items: Sequence[str], as_json: bool) -> None:
    """Name the first differing step and tensor of two artifacts; exit with 1 when there is one."""
    store, names = split(items, 2)
    found = first_difference(store.resolve(names[0]), store.resolve(names[1]))
    if as_json:
        emit({"same": found is None, "first": asdict(found) if found else None})
    else:
        sys.stdout.write(f"{found}\n" if found else "same content\n")
    if found:
        raise Exit(1)


def verify(items: Sequence[str], as_json: bool) -> None:
    """Check every byte, of the reference results too; exit with 1 when something is wrong."""
    store, names = split(items)
    everything = [*store.names(), *store.references.names()]
    refs = [r for n in names for r in (store.references.names() if n == WORD else [n])] if names else everything
    problems = [] if names else store.dangling()
    with Progress() as progress:
        for ref in progress.track(refs, "verify"):
            problems += store.verify([ref])
    if as_json:
        emit({"checked": refs, "problems": problems})
    else:
        for line in problems:
            sys.stdout.write(line + "\n")
        sys.stdout.write(f"{len(refs)} artifacts checked, {len(problems)} problems\n")
    if problems:
        raise Exit(1)


def gc(items: Sequence[str], delete: bool, grace_h: float, as_json: bool) -> None:
    """List, or delete, what nothing reaches."""
    store, _ = split(items, 0)
    found = collector.garbage(store, grace_h * 3600.0)
    if delete:
        collector.collect(store, found, grace_h * 3600.0)
    if as_json:
        emit(
            {
                "deleted": delete,
                "artifacts": found.artifacts,
                "folders": list(map(str, found.folders)),
                "bytes": found.bytes,
            }
        )
        return
    for name in [*found.artifacts, *map(str, found.folders)]:
        sys.stdout.write(f"{'deleted' if delete else 'would delete'} {name}\n")
    hint = "" if delete or not found.bytes else "; add --delete to do it"
    sys.stdout.write(f"{len(found.artifacts)} artifacts, {len(found.folders)} folders, {size(found.bytes)}{hint}\n")


def pin(items: Sequence[str], remove: bool, as_json: bool) -> None:
    """Pin or unpin artifacts; without a name, list the pins."""
    store, names = split(items)
    changed = [store.pin(name, remove=remove) for name in names]
    if as_json:
        emit({"pins": store.pins()})
    else:
        for name in changed or store.pins():
            sys.stdout.write(f"{'unpinned' if remove else 'pinned'} {name}\n")


def publish(items: Sequence[str], name: str | None, without: Sequence[str], limit_mb: float, as_json: bool) -> None:
    """Copy an artifact to the reference results."""
    store, names = split(items, 1)
    done = publish_reference(store.resolve(names[0]), store.references, name, without, limit_mb)
    manifest, total = done.artifact.manifest, store.references.size()
    if as_json:
        emit(
            {
                "artifact": done.text,
                "ref": manifest.ref,
                "path": str(done.artifact.path),
                "content_digest": manifest.content_digest,
                "bytes": manifest.size,
                "total_bytes": total,
                "missing_inputs": done.missing_inputs,
            }
        )
        return
    sys.stdout.write(f"{done.text}  {size(manifest.size)} in {len(manifest.files)} files at {done.artifact.path}\n")
    for ref in done.missing_inputs:
        sys.stdout.write(f"  input {ref} is no reference result: known by its digest only\n")
    if manifest.git.get("dirty"):
        sys.stdout.write("  made with uncommitted changes: the manifest holds the patch\n")
    sys.stdout.write(f"all reference results: {size(total)}; commit {store.references.folder}\n")


def rm(items: Sequence[str], force: bool, as_json: bool) -> None:
    """Delete artifacts."""
    store, names = split(items, -1)
    removed = [store.remove(name, force=force) for name in names]
    if as_json:
        emit({"removed": removed})
    else:
        for name in removed:
            sys.stdout.write(f"removed {name}\n")


def transfer(url: str, items: Sequence[str], push: bool, as_json: bool) -> None:
    """Copy artifacts with all their inputs between this store and another one; without a name, everything."""
    if "=" in url:
        raise ConfigError(f"{url}: name the other store first, as s3://bucket/prefix or a directory")
    store, names = split(items)
    other = Store.open(url)
    source, target = (store, other) if push else (other, store)
    with Progress() as progress:
        copied, skipped = copy_all(source, target, names, progress.task)
    if as_json:
        emit({"copied": copied, "present": skipped})
    else:
        for name in copied:
            sys.stdout.write(f"copied {name}\n")
        sys.stdout.write(f"{len(copied)} copied, {len(skipped)} present already\n")

"""The artifact store: resolve names, draft and publish artifacts, move references, pin, verify, remove."""

from __future__ import annotations

import json
import os
import random
import shutil
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from wbm.artifacts.backend import ABSENT, Backend, LocalBackend
from wbm.artifacts.digest import KEY_LENGTH
from wbm.artifacts.errors import ArtifactError, Conflict, Missing
from wbm.artifacts.files import fsync_path, make_dirs
from wbm.artifacts.lease import Lease, acquire
from wbm.artifacts.manifest import MANIFEST, NAME, Artifact, Manifest, check_files, parse_manifest, seal
from wbm.artifacts.reference import References, is_reference

KINDS = ("assets", "teacher", "rollouts", "student", "evaluation", "bundle")
_RETRIES = 100


@dataclass
class Draft:
    """An artifact in the making.

    Attributes:
        path: staging folder; what it holds at `publish` becomes the artifact. It is the same for the same key, so that
            an interrupted stage finds its finished shards again. Files below `logs/` are no part of the content.
        scratch: folder for checkpoints and other state of the running stage; it survives interruption, not publication.
        metrics: numbers for the manifest and the final table.
        seeds: seeds in use, for the manifest.
    """

    store: Store
    manifest: Manifest
    path: Path
    scratch: Path
    lease: Lease
    replace: bool = False
    metrics: dict[str, Any] = field(default_factory=dict)
    seeds: dict[str, int] = field(default_factory=dict)
    started: float = field(default_factory=time.monotonic)

    def publish(self) -> Artifact:
        """Seal, flush and rename the staging folder, then move `latest`.

        Raises:
            Conflict: another process took the lease over; nothing is published.
        """
        manifest = replace(
            self.manifest,
            created=datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
            wall_time_s=round(time.monotonic() - self.started, 3),
            metrics=dict(self.metrics),
            seeds={**self.manifest.seeds, **self.seeds},
        )
        manifest = seal(manifest, self.path)
        (self.path / MANIFEST).write_bytes(manifest.to_bytes())
        backend = self.store.backend
        backend.publish(self.path, manifest.ref, replace=self.replace, guard=self.lease.check)
        self.store.set_latest(manifest.kind, manifest.name, manifest.key)
        if self.path.exists():  # the artifact that this one replaced
            self.store.quarantine(self.path, manifest.ref)
        shutil.rmtree(self.scratch, ignore_errors=True)
        self.lease.release()
        return self.store.resolve(manifest.ref)

    def keep(self) -> None:
        """Leave the staging folder for the next attempt."""
        self.lease.release()

    def discard(self) -> Path:
        """Move the staging folder to quarantine and return where it is."""
        target = self.store.quarantine(self.path, self.manifest.ref)
        shutil.rmtree(self.scratch, ignore_errors=True)
        self.lease.release()
        return target


def scratch_of(staging: Path) -> Path:
    """The folder for checkpoints that belongs to a staging folder."""
    return staging.with_name(staging.name + ".scratch")


class Store:
    """Artifacts under one root."""

    def __init__(self, backend: Backend, reference: Path | None = None) -> None:
        self.backend = backend
        self.references = References(reference or backend.work / "reference")

    @classmethod
    def open(cls, url: str | os.PathLike[str], reference: Path | None = None) -> Store:
        """Open a store.

        Args:
            url: a directory (created when missing) or `s3://bucket/prefix`.
            reference: folder of the committed reference results; default `<root>/reference`.

        Raises:
            ArtifactError: the root cannot be used.
        """
        text = os.fspath(url)
        if "://" in text and not text.startswith("file://"):
            from wbm.artifacts.remote import ObjectBackend

            return cls(ObjectBackend(text), reference)
        return cls(LocalBackend(Path(text.removeprefix("file://")).expanduser().absolute()), reference)

    def names(self, kind: str | None = None) -> list[str]:
        """`kind/name/key12` of all published artifacts, or those of one kind, sorted."""
        return [ref for ref in self.backend.artifacts() if kind is None or ref.startswith(f"{kind}/")]

    def manifest(self, text: str, kinds: Sequence[str] = ()) -> Manifest:
        """Manifest of a published artifact without fetching its files; arguments and errors as `resolve`."""
        found = self._find(text, kinds)
        return (
            found.manifest if isinstance(found, Artifact) else parse_manifest(self.backend.read_manifest(found), found)
        )

    def resolve(self, text: str, kinds: Sequence[str] = ()) -> Artifact:
        """Find `kind/name[/key|/latest]`, a unique `kind`, `reference/<name>`, or `reference`.

        Args:
            text: a name; with a key it may be that of a reference result too.
            kinds: what bare `reference` stands for: the main result of the first of these kinds that there is.

        Raises:
            Missing: no such artifact; the message names near ones.
            ArtifactError: the manifest is damaged.
        """
        found = self._find(text, kinds)
        if isinstance(found, Artifact):
            return found
        manifest = parse_manifest(self.backend.read_manifest(found), found)
        return Artifact(self.backend.fetch(found), manifest)

    def _find(self, text: str, kinds: Sequence[str]) -> Artifact | str:
        """A reference result, or the full name of an artifact of the store."""
        if is_reference(text):
            return self.references.get(text, kinds)
        try:
            return self._expand(text)
        except Missing:
            found = self.references.with_ref(text)
            if found is None:
                raise
            return found

    def find(self, kind: str, name: str, key: str) -> Manifest | None:
        """Manifest of the artifact with exactly this key, None when it is not published."""
        ref = f"{kind}/{name}/{key[:KEY_LENGTH]}"
        if not self.backend.has(ref):
            return None
        manifest = parse_manifest(self.backend.read_manifest(ref), ref)
        return manifest if manifest.key == key else None

    def latest(self, kind: str, name: str) -> Manifest | None:
        """Manifest that `latest` points to, None when nothing was published."""
        found = self.backend.read(f"refs/{kind}/{name}/latest")
        if not found:
            return None
        ref = f"{kind}/{name}/{json.loads(found[0])['key'][:KEY_LENGTH]}"
        return parse_manifest(self.backend.read_manifest(ref), ref) if self.backend.has(ref) else None

    def set_latest(self, kind: str, name: str, key: str) -> None:
        """Move the reference `latest` by compare-and-swap."""
        path = f"refs/{kind}/{name}/latest"
        for attempt in range(_RETRIES):
            found = self.backend.read(path)
            current = json.loads(found[0]) if found else {"generation": 0, "key": None}
            if current["key"] == key:
                return
            record = json.dumps({"generation": current["generation"] + 1, "key": key}).encode()
            try:
                self.backend.write(path, record, found[1] if found else ABSENT)
                return
            except Conflict:
                time.sleep(
                    random.uniform(0.0, min(0.5, 0.002 * 2 ** min(attempt, 9)))
                )  # many writers must not keep step
        raise Conflict(f"{path}: other processes keep changing it; try again")

    def staging(self, ref: str) -> Path:
        """Where an artifact is written before it is published."""
        return self.backend.work / ".staging" / ref

    def forget(self, ref: str) -> None:
        """Delete what an interrupted attempt left."""
        shutil.rmtree(self.staging(ref), ignore_errors=True)
        shutil.rmtree(scratch_of(self.staging(ref)), ignore_errors=True)

    def begin(self, manifest: Manifest, *, force: bool = False, resume: bool = False, wait_s: float = 0.0) -> Draft:
        """Start, or resume, the artifact with `manifest.key`.

        Args:
            manifest: kind, name, key and what else is known before the stage runs.
            force: forget an interrupted attempt and replace an artifact with this key.
            resume: continue an interrupted attempt even so.
            wait_s: how long to wait for another process that writes the same artifact.

        Raises:
            Conflict: another process is writing it, or it is published already.
            ArtifactError: a bad name, or a root that cannot be written.
        """
        if not NAME.fullmatch(manifest.kind) or not NAME.fullmatch(manifest.name):
            raise ArtifactError(
                f"{manifest.kind}/{manifest.name}: names hold letters, digits, dot, dash and underscore"
            )
        staging = self.staging(manifest.ref)
        scratch = scratch_of(staging)
        try:
            lease = acquire(self.backend, f"leases/{manifest.ref}", wait_s=wait_s)
        except OSError as error:
            raise ArtifactError(
                f"{self.backend.url}: cannot write ({error.strerror}); set artifacts.root=DIR"
            ) from error
        try:
            if self.backend.has(manifest.ref) and not force:
                raise Conflict(f"{manifest.ref}: already published")
            if force and not resume:
                self.forget(manifest.ref)
            make_dirs(staging)
            (staging / MANIFEST).unlink(missing_ok=True)
            make_dirs(scratch)
        except BaseException:
            lease.release()
            raise
        return Draft(self, manifest, staging, scratch, lease, replace=force)

    def quarantine(self, folder: Path, ref: str) -> Path:
        """Move a folder out of the way, for a look, and return where it is."""
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S")
        target = self.backend.work / ".quarantine" / f"{ref}-{stamp}-{os.getpid()}-{time.monotonic_ns() % 1000000}"
        make_dirs(target.parent)
        os.rename(folder, target)
        fsync_path(target.parent)
        return target

    def verify(self, refs: Iterable[str] | None = None) -> list[str]:
        """Problems of the named artifacts: one line for each missing, changed or unlisted file.

        Without names, of all of them, and of references to artifacts that are gone.
        """
        problems = [] if refs is not None else self.dangling()
        for ref in self.names() if refs is None else refs:
            try:
                if is_reference(ref):
                    artifact = self.references.get(ref)
                    problems += check_files(artifact.manifest, artifact.path)
                    continue
                name = self._expand(ref)
                problems += self.backend.check(name)
                if self.manifest(name).ref != name:
                    problems.append(f"{name}: the manifest belongs to {self.manifest(name).ref}")
            except (ArtifactError, OSError) as error:
                problems.append(str(error) if str(error).startswith(ref) else f"{ref}: {error}")
        return problems

    def dangling(self) -> list[str]:
        """Artifacts without a manifest, and references and pins of artifacts that are gone; a line for each."""
        problems = [f"{ref}: manifest.json is missing" for ref in self.backend.strays()]
        known = set(self.names())
        for path in self.backend.records("refs"):
            kind, name = path.split("/")[1:3]
            found = self.backend.read(path)
            ref = f"{kind}/{name}/{json.loads(found[0])['key'][:KEY_LENGTH]}" if found else ""
            if found and ref not in known:
                problems.append(f"{path}: points to {ref}, which is gone")
        return problems + [f"pins/{ref}: the pinned artifact is gone" for ref in self.pins() if ref not in known]

    def pin(self, text: str, *, remove: bool = False) -> str:
        """Keep an artifact, and what it was made from, out of `gc`'s reach; or stop doing so. Returns its full name."""
        ref = self._expand(text)
        if remove:
            self.backend.delete(f"pins/{ref}")
        else:
            self.backend.write(f"pins/{ref}", b"{}", None)
        return ref

    def pins(self) -> list[str]:
        """Pinned artifacts."""
        return [path.removeprefix("pins/") for path in self.backend.records("pins")]

    def remove(self, text: str, *, force: bool = False) -> str:
        """Delete an artifact; a reference to it moves to the newest one left. Returns its full name.

        Raises:
            Conflict: pinned, or another artifact was made from it (unless `force`).
        """
        ref = self._expand(text)
        if not force:
            if ref in self.pins():
                raise Conflict(f"{ref}: pinned; `wbm artifacts pin --remove {ref}` first")
            users = [user for user in self.names() if ref in (i.ref for i in self.manifest(user).inputs.values())]
            if users:
                raise Conflict(f"{ref}: {users[0]} was made from it; add --force to delete it all the same")
        kind, name, key = ref.split("/")
        self.backend.delete(f"pins/{ref}")
        found = self.backend.read(f"refs/{kind}/{name}/latest")
        if found and json.loads(found[0])["key"][:KEY_LENGTH] == key:
            left = [self.manifest(r) for r in self.names(kind) if r.startswith(f"{kind}/{name}/") and r != ref]
            if left:
                newest = max(left, key=lambda m: m.created)
                self.set_latest(kind, name, newest.key)
            else:
                self.backend.delete(f"refs/{kind}/{name}/latest")
        self.backend.remove(ref)  # after the reference, which must never point to nothing
        return ref

    def _expand(self, text: str) -> str:
        parts = text.strip("/").split("/")
        if len(parts) == 1 and NAME.fullmatch(parts[0]):
            names = sorted({ref.split("/")[1] for ref in self.names(parts[0])})
            if len(names) != 1:
                hint = (
                    f"choose one of {', '.join(f'{parts[0]}/{n}' for n in names)}" if names else "run its stage first"
                )
                raise Missing(f"{text}: {'ambiguous' if names else 'nothing published'}; {hint}")
            parts.append(names[0])
        if len(parts) not in (2, 3) or not all(NAME.fullmatch(p) for p in parts):
            raise Missing(f"{text}: not an artifact; write kind/name, kind/name/key or reference/name")
        kind, name = parts[:2]
        if len(parts) == 2 or parts[2] == "latest":
            manifest = self.latest(kind, name)
            if manifest is None:
                known = sorted({"/".join(ref.split("/")[:2]) for ref in self.names(kind)})
                hint = f"there are {', '.join(known)}" if known else "run its stage first"
                raise Missing(f"{text}: nothing published under this name in {self.backend.url}; {hint}")
            return manifest.ref
        matches = [r for r in self.names(kind) if r.startswith(f"{kind}/{name}/{parts[2][:KEY_LENGTH]}")]
        if len(matches) != 1:
            raise Missing(f"{text}: {'ambiguous key' if matches else 'not published in ' + self.backend.url}")
        return matches[0]

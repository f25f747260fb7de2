"""The manifest: everything that is known about an artifact, in one canonical JSON file."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from wbm.artifacts.digest import canonical_json, digest_bytes, digest_content, digest_file, digest_payload
from wbm.artifacts.errors import ArtifactError

SCHEMA_VERSION = 1
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
KEY = re.compile(r"[0-9a-f]{12,64}")
MANIFEST = "manifest.json"
LOGS = "logs/"  # listed and verified, but no part of the content: logs hold times and host names


@dataclass(frozen=True)
class FileEntry:
    """One file: path relative to the artifact, size in bytes, digest of its bytes, digest of its content."""

    path: str
    size: int
    digest: str
    content: str


@dataclass(frozen=True)
class InputRef:
    """An input artifact as it was when the stage ran."""

    ref: str  # kind/name/key
    content_digest: str


@dataclass(frozen=True)
class Manifest:
    """Header and file list of an artifact (schema version 1)."""

    kind: str
    name: str
    key: str
    stage: str = ""
    created: str = ""  # UTC, ISO 8601
    wall_time_s: float = 0.0
    config: dict[str, Any] = field(default_factory=dict)
    inputs: dict[str, InputRef] = field(default_factory=dict)
    code: dict[str, str] = field(default_factory=dict)  # file -> digest of its normalised syntax tree
    code_digest: str = ""
    versions: dict[str, str] = field(default_factory=dict)
    git: dict[str, Any] = field(default_factory=dict)
    environment: dict[str, Any] = field(default_factory=dict)
    seeds: dict[str, int] = field(default_factory=dict)
    note: str | None = None
    command: str = ""
    metrics: dict[str, Any] = field(default_factory=dict)
    content_digest: str = ""
    files: tuple[FileEntry, ...] = ()
    trimmed: dict[str, Any] = field(default_factory=dict)  # a reference result that lacks files of its original
    schema_version: int = SCHEMA_VERSION

    @property
    def ref(self) -> str:
        """`kind/name/key12`."""
        return f"{self.kind}/{self.name}/{self.key[:12]}"

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(entry.size for entry in self.files)

    def to_bytes(self) -> bytes:
        """Canonical bytes; the last line is the digest of the rest, so that a flipped byte shows."""
        record = {f.name: getattr(self, f.name) for f in fields(self)}
        record["inputs"] = {slot: [ref.ref, ref.content_digest] for slot, ref in self.inputs.items()}
        record["files"] = [[e.path, e.size, e.digest, e.content] for e in self.files]
        body = canonical_json(record)
        return body + b"\n" + digest_bytes(body).encode() + b"\n"


@dataclass(frozen=True)
class Artifact:
    """A published artifact: a folder that nobody writes any more, and its manifest."""

    path: Path
    manifest: Manifest

    @property
    def ref(self) -> str:
        """`kind/name/key12`."""
        return self.manifest.ref


def parse_manifest(data: bytes, where: str) -> Manifest:
    """Read a manifest.

    Args:
        data: bytes of `manifest.json`.
        where: named in errors.

    Raises:
        ArtifactError: damaged, or of a schema this program does not know.
    """
    body, _, tail = data.partition(b"\n")
    if tail.rstrip(b"\n").decode("ascii", "replace") != digest_bytes(body) or not tail.endswith(b"\n"):
        raise ArtifactError(f"{where}: manifest.json is damaged; run `wbm artifacts verify` or rebuild the artifact")
    from wbm.artifacts.migrate import migrate

    record = migrate(json.loads(body), where)
    known = {f.name for f in fields(Manifest)}
    record = {name: value for name, value in record.items() if name in known}
    record["inputs"] = {slot: InputRef(*ref) for slot, ref in record["inputs"].items()}
    record["files"] = tuple(FileEntry(*entry) for entry in record["files"])
    manifest = Manifest(**record)
    _check_names(manifest, where)
    return manifest


def _check_names(manifest: Manifest, where: str) -> None:
    """An artifact from a stranger is data: no name in it may lead out of its folder."""
    if not NAME.fullmatch(manifest.kind) or not NAME.fullmatch(manifest.name) or not KEY.fullmatch(manifest.key):
        raise ArtifactError(f"{where}: manifest.json holds a name or key that is not allowed; do not use this artifact")
    for entry in manifest.files:
        parts = entry.path.split("/")
        if ".." in parts or "" in parts or "." in parts or "\\" in entry.path or "\0" in entry.path:
            raise ArtifactError(f"{where}: manifest.json lists the path {entry.path!r}; do not use this artifact")
        if not KEY.fullmatch(entry.digest) or entry.path == MANIFEST:
            raise ArtifactError(f"{where}: manifest.json has a bad entry for {entry.path!r}; do not use this artifact")


def read_manifest(folder: Path) -> Manifest:
    """Read `folder/manifest.json`.

    Raises:
        ArtifactError: missing or damaged.
    """
    try:
        data = (folder / MANIFEST).read_bytes()
    except OSError as error:
        raise ArtifactError(f"{folder}: cannot read manifest.json ({error.strerror})") from error
    return parse_manifest(data, str(folder))


def walk_files(folder: Path) -> Iterator[Path]:
    """All regular files below `folder` in sorted order, the manifest left out.

    Raises:
        ArtifactError: a link or a special file, which an artifact may not hold.
    """
    for base, dirs, names in os.walk(folder):
        dirs.sort()
        for name in sorted(names):
            path = Path(base) / name
            if path.is_symlink() or not path.is_file():
                raise ArtifactError(f"{path}: an artifact holds regular files only; write a copy")
            if not (base == str(folder) and name == MANIFEST):
                yield path
        for name in dirs:
            if (Path(base) / name).is_symlink():
                raise ArtifactError(f"{Path(base) / name}: an artifact holds no links; write a copy")


def scan_files(folder: Path) -> tuple[FileEntry, ...]:
    """Digest every file below `folder`."""

    def entry(path: Path) -> FileEntry:
        digest = digest_file(path)
        content = digest_content(path)
        relative = path.relative_to(folder).as_posix()
        return FileEntry(relative, path.stat().st_size, digest, "" if content == digest else content)

    with ThreadPoolExecutor(max_workers=2) as pool:
        return tuple(pool.map(entry, walk_files(folder)))


def seal(manifest: Manifest, folder: Path) -> Manifest:
    """Return `manifest` with the files of `folder` and their content digest."""
    files = scan_files(folder)
    payload = [(e.path, e.content or e.digest) for e in files if not e.path.startswith(LOGS)]
    return replace(manifest, files=files, content_digest=digest_payload(payload))


def check_files(manifest: Manifest, folder: Path) -> list[str]:
    """Compare the files of `folder` with the manifest.

    Args:
        manifest: what should be there.
        folder: where it should be.

    Returns:
        One line for each missing, changed or unlisted file; empty when all is well.
    """
    problems = []
    listed = {entry.path: entry for entry in manifest.files}
    found = {path.relative_to(folder).as_posix(): path for path in walk_files(folder)}
    for name, entry in listed.items():
        path = found.get(name)
        if path is None:
            problems.append(f"{manifest.ref}: {name} is missing")
        elif path.stat().st_size != entry.size:
            problems.append(f"{manifest.ref}: {name} has {path.stat().st_size} bytes instead of {entry.size}")
        elif digest_file(path) != entry.digest:
            problems.append(f"{manifest.ref}: {name} has changed")
    problems.extend(f"{manifest.ref}: {name} is not in the manifest" for name in sorted(found.keys() - listed.keys()))
    payload = [(e.path, e.content or e.digest) for e in manifest.files if not e.path.startswith(LOGS)]
    if digest_payload(payload) != manifest.content_digest:
        problems.append(f"{manifest.ref}: the content digest does not follow from the files")
    return problems

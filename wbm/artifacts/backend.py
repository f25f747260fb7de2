"""Where a store keeps its bytes: small records with compare-and-swap, and published folders."""

from __future__ import annotations

import errno
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from wbm.artifacts.digest import digest_bytes, digest_file
from wbm.artifacts.errors import ArtifactError, Conflict, Missing
from wbm.artifacts.files import exchange, fsync_path, fsync_tree, locked, make_dirs, remove_tree, write_atomic
from wbm.artifacts.manifest import MANIFEST, check_files, read_manifest

ABSENT = ""  # expected version of a record that must not exist yet
Advance = Callable[[float], None]  # told how many bytes were dealt with


def ignore(_: float) -> None:
    """An `Advance` for nobody."""


class Backend(Protocol):
    """The operations that the local directory and the object store share."""

    work: Path  # local directory for staging, quarantine and fetched artifacts
    url: str

    def read(self, path: str) -> tuple[bytes, str] | None:
        """Bytes and version of a record, None when there is none."""
        ...

    def write(self, path: str, data: bytes, expect: str | None) -> None:
        """Write a record if its version is still `expect` (`ABSENT`: none yet; None: whatever it is).

        Raises:
            Conflict: another process was faster.
        """
        ...

    def delete(self, path: str) -> None:
        """Remove a record; one that is gone already is no error."""
        ...

    def records(self, prefix: str) -> list[str]:
        """Paths of the records below `prefix`, sorted."""
        ...

    def artifacts(self) -> list[str]:
        """`kind/name/key12` of every published artifact, sorted."""
        ...

    def strays(self) -> list[str]:
        """Folders where an artifact should be but that hold no manifest."""
        ...

    def has(self, ref: str) -> bool:
        """Whether an artifact is published."""
        ...

    def read_manifest(self, ref: str) -> bytes:
        """Bytes of a published manifest.

        Raises:
            Missing: not published.
        """
        ...

    def publish(self, staged: Path, ref: str, *, replace: bool, guard: Callable[[], None]) -> None:
        """Make a finished staging folder visible as `ref`, all of it or nothing.

        With `replace`, an artifact of that name takes the staging folder's place. `guard` raises when the writer has
        lost its lease.
        """
        ...

    def fetch(self, ref: str, advance: Advance = ignore) -> Path:
        """Local folder with the artifact's files."""
        ...

    def receive(self, folder: Path, ref: str, advance: Advance) -> None:
        """Publish a copy of another store's artifact.

        Raises:
            ArtifactError: the copy does not agree with its manifest.
            Conflict: published meanwhile.
        """
        ...

    def check(self, ref: str) -> list[str]:
        """Read every byte of an artifact and return one line for each problem."""
        ...

    def remove(self, ref: str) -> None:
        """Unpublish and delete an artifact."""
        ...

    def sweep(self, grace_s: float) -> int:
        """Delete contents that no artifact names and that are older than `grace_s` seconds. Returns the bytes freed."""
        ...


class LocalBackend:
    """A directory on one file system."""

    def __init__(self, root: Path) -> None:
        self.work = root
        self.url = str(root)
        self._meta = root / ".store"

    def _lock(self, path: str) -> Path:
        return self._meta / "locks" / digest_bytes(path.encode())[:2]  # 256 locks for any number of records

    def read(self, path: str) -> tuple[bytes, str] | None:
        try:
            data = (self._meta / path).read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return None
        return data, digest_bytes(data)

    def write(self, path: str, data: bytes, expect: str | None) -> None:
        with locked(self._lock(path)):
            if expect is not None:
                current = self.read(path)
                if (current[1] if current else ABSENT) != expect:
                    raise Conflict(f"{path}: changed by another process; try again")
            write_atomic(self._meta / path, data)

    def delete(self, path: str) -> None:
        with locked(self._lock(path)):
            if (self._meta / path).exists():
                (self._meta / path).unlink()
                fsync_path((self._meta / path).parent)

    def records(self, prefix: str) -> list[str]:
        base = self._meta / prefix
        paths = base.rglob("*") if base.is_dir() else []
        return sorted(p.relative_to(self._meta).as_posix() for p in paths if p.is_file() and p.name[0] != ".")

    def _all_folders(self) -> list[str]:
        kinds = [kind for kind in _folders(self.work) if kind.name != "reference"]
        return sorted(f"{kind.name}/{n.name}/{k.name}" for kind in kinds for n in _folders(kind) for k in _folders(n))

    def artifacts(self) -> list[str]:
        return [ref for ref in self._all_folders() if self.has(ref)]

    def strays(self) -> list[str]:
        return [ref for ref in self._all_folders() if not self.has(ref)]

    def has(self, ref: str) -> bool:
        return (self.work / ref / MANIFEST).is_file()

    def read_manifest(self, ref: str) -> bytes:
        try:
            return (self.work / ref / MANIFEST).read_bytes()
        except FileNotFoundError:
            raise Missing(f"{ref}: not in {self.url}") from None

    def publish(self, staged: Path, ref: str, *, replace: bool, guard: Callable[[], None]) -> None:
        target = self.work / ref
        fsync_tree(staged)
        make_dirs(target.parent)
        with locked(self._lock(f"artifact/{ref}")):
            guard()
            if target.exists():
                if not replace:
                    raise Conflict(f"{ref}: published by another process meanwhile")
                swap(staged, target)
            else:
                _rename(staged, target)
            fsync_path(target.parent)
            fsync_path(staged.parent)

    def fetch(self, ref: str, advance: Advance = ignore) -> Path:
        folder = self.work / ref
        advance(sum(entry.size for entry in read_manifest(folder).files))
        return folder

    def receive(self, folder: Path, ref: str, advance: Advance) -> None:
        incoming = self.work / ".staging" / f"{ref}.incoming"
        manifest = read_manifest(folder)
        make_dirs(incoming)
        for entry in manifest.files:
            path = incoming / entry.path
            if not (path.is_file() and path.stat().st_size == entry.size and digest_file(path) == entry.digest):
                path.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(folder / entry.path, path)
                if digest_file(path) != entry.digest:
                    raise ArtifactError(f"{ref}: {entry.path} has changed in {folder}")
            advance(entry.size)
        shutil.copyfile(folder / MANIFEST, incoming / MANIFEST)
        self.publish(incoming, ref, replace=self.has(ref), guard=lambda: None)
        remove_tree(incoming)

    def check(self, ref: str) -> list[str]:
        return check_files(read_manifest(self.work / ref), self.work / ref)

    def remove(self, ref: str) -> None:
        with locked(self._lock(f"artifact/{ref}")):
            remove_tree(self.work / ref)

    def sweep(self, grace_s: float) -> int:
        before = time.time() - grace_s
        doomed = [p for p in self.work.glob("*/*/.*.doomed") if p.stat().st_mtime <= before]
        freed = sum(f.stat().st_size for folder in doomed for f in folder.rglob("*") if f.is_file())
        for folder in doomed:
            shutil.rmtree(folder)
        return freed


def swap(left: Path, right: Path) -> None:
    """Exchange two folders, in one step where the file system can."""
    try:
        exchange(left, right)
    except OSError as error:
        if error.errno not in (errno.ENOSYS, errno.EINVAL):
            raise
        aside = right.with_name(f".{right.name}.replaced")
        os.rename(right, aside)
        os.rename(left, right)
        os.rename(aside, left)


def _rename(staged: Path, target: Path) -> None:
    """Rename, believing the result rather than the error: NFS reports a repeated request as a failure."""
    try:
        os.rename(staged, target)
    except OSError:
        if staged.exists() or not (target / MANIFEST).is_file():
            raise


def _folders(base: Path) -> list[Path]:
    return [p for p in base.iterdir() if p.is_dir() and p.name[0] != "."] if base.is_dir() else []

"""A store in an object store (S3 and whatever else `obstore` speaks), with the semantics of the local one.

File contents are blobs named by their digest, so that uploads are resumable and never collide. An artifact exists when
its manifest exists; the manifest is written last, create-only. Records use ETag compare-and-swap. Files are fetched
into a local cache, each checked against its digest.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import obstore
from obstore.exceptions import AlreadyExistsError, BaseError, NotFoundError, PreconditionError
from obstore.store import from_url

from wbm.artifacts.backend import ABSENT, Advance, ignore
from wbm.artifacts.digest import digest_bytes, digest_file
from wbm.artifacts.errors import ArtifactError, Conflict, Missing
from wbm.artifacts.files import fsync_tree, make_dirs, remove_tree
from wbm.artifacts.manifest import MANIFEST, FileEntry, parse_manifest

_META = ".store/"
_BLOBS = "blobs/"
_PARALLEL = 8


def cache_dir() -> Path:
    """Folder for fetched artifacts and staging: `$WBM_CACHE`, or `wbm` below the user's cache folder."""
    base = os.environ.get("WBM_CACHE")
    return Path(base) if base else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "wbm"


class ObjectBackend:
    """Artifacts below an `obstore` URL. Credentials and endpoint come from the usual variables (`AWS_*`)."""

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        self.work = cache_dir() / digest_bytes(self.url.encode())[:16]
        try:
            self._store: Any = from_url(self.url)
        except (BaseError, ValueError) as error:
            raise ArtifactError(f"{self.url}: {_first_line(error)}; write s3://bucket/prefix or a directory") from error

    def _get(self, path: str) -> tuple[bytes, str] | None:
        try:
            found = obstore.get(self._store, path)
            return bytes(found.bytes()), str(found.meta["e_tag"])
        except (NotFoundError, FileNotFoundError):
            return None
        except BaseError as error:
            raise self._unreachable(error) from error

    def _put(self, path: str, data: bytes | Path, mode: Any) -> None:
        try:
            obstore.put(self._store, path, data, mode=mode, use_multipart=False if mode != "overwrite" else None)
        except (AlreadyExistsError, PreconditionError, NotFoundError) as error:
            raise Conflict(f"{path}: changed by another process; try again") from error
        except BaseError as error:
            if "ConditionalRequestConflict" in str(error) or "409" in str(error):
                raise Conflict(f"{path}: changed by another process; try again") from error
            raise self._unreachable(error) from error

    def _unreachable(self, error: Exception) -> ArtifactError:
        return ArtifactError(f"{self.url}: {_first_line(error)}; check the address, AWS_* variables and the network")

    def _list(self, prefix: str) -> list[Any]:
        try:
            return [meta for batch in obstore.list(self._store, prefix) for meta in batch]
        except (NotFoundError, FileNotFoundError):
            return []
        except BaseError as error:
            raise self._unreachable(error) from error

    def _delete(self, path: str) -> None:
        try:
            obstore.delete(self._store, path)
        except (NotFoundError, FileNotFoundError):
            return
        except BaseError as error:
            raise self._unreachable(error) from error

    def read(self, path: str) -> tuple[bytes, str] | None:
        return self._get(_META + path)

    def write(self, path: str, data: bytes, expect: str | None) -> None:
        mode = "overwrite" if expect is None else "create" if expect == ABSENT else {"e_tag": expect}
        self._put(_META + path, data, mode)

    def delete(self, path: str) -> None:
        self._delete(_META + path)

    def records(self, prefix: str) -> list[str]:
        return sorted(str(m["path"]).removeprefix(_META) for m in self._list(f"{_META}{prefix}/"))

    def artifacts(self) -> list[str]:
        paths = (str(m["path"]) for m in self._list("artifacts/"))
        return sorted(p.removeprefix("artifacts/").removesuffix(f"/{MANIFEST}") for p in paths if p.endswith(MANIFEST))

    def strays(self) -> list[str]:
        return []

    def has(self, ref: str) -> bool:
        try:
            obstore.head(self._store, _manifest_path(ref))
            return True
        except (NotFoundError, FileNotFoundError):
            return False
        except BaseError as error:
            raise self._unreachable(error) from error

    def read_manifest(self, ref: str) -> bytes:
        found = self._get(_manifest_path(ref))
        if found is None:
            raise Missing(f"{ref}: not in {self.url}")
        return found[0]

    def publish(self, staged: Path, ref: str, *, replace: bool, guard: Callable[[], None]) -> None:
        guard()
        self._upload(staged, ref, replace, guard, ignore)
        cached = self.work / ref
        remove_tree(cached)
        make_dirs(cached.parent)
        os.rename(staged, cached)

    def receive(self, folder: Path, ref: str, advance: Advance) -> None:
        self._upload(folder, ref, False, lambda: None, advance)

    def _upload(self, folder: Path, ref: str, replace: bool, guard: Callable[[], None], advance: Advance) -> None:
        data = (folder / MANIFEST).read_bytes()
        entries = parse_manifest(data, ref).files
        present = {str(m["path"]) for m in self._list(_BLOBS)} if len(entries) > _PARALLEL else None

        def upload(entry: FileEntry) -> None:
            path = _blob_path(entry.digest)
            if not (self._has_blob(path) if present is None else path in present):
                if digest_file(folder / entry.path) != entry.digest:
                    raise ArtifactError(f"{ref}: {entry.path} changed while it was sent; run verify")
                self._put(path, folder / entry.path, "overwrite")
            advance(entry.size)

        with ThreadPoolExecutor(_PARALLEL) as pool:
            for _ in pool.map(upload, entries):
                pass
        guard()
        current = self._get(_manifest_path(ref)) if replace else None
        self._put(_manifest_path(ref), data, {"e_tag": current[1]} if current else "create")

    def _has_blob(self, path: str) -> bool:
        try:
            obstore.head(self._store, path)
            return True
        except (NotFoundError, FileNotFoundError):
            return False
        except BaseError as error:
            raise self._unreachable(error) from error

    def fetch(self, ref: str, advance: Advance = ignore) -> Path:
        data = self.read_manifest(ref)
        target = self.work / ref
        if (target / MANIFEST).is_file() and (target / MANIFEST).read_bytes() == data:
            return target
        incoming = self.work / ".staging" / f"{ref}.incoming"
        make_dirs(incoming)

        def download(entry: FileEntry) -> None:
            path = incoming / entry.path
            if not (path.is_file() and path.stat().st_size == entry.size and digest_file(path) == entry.digest):
                self._download(ref, entry, path)
            advance(entry.size)

        with ThreadPoolExecutor(_PARALLEL) as pool:
            for _ in pool.map(download, parse_manifest(data, ref).files):
                pass
        (incoming / MANIFEST).write_bytes(data)
        fsync_tree(incoming)
        remove_tree(target)
        make_dirs(target.parent)
        os.rename(incoming, target)
        return target

    def _download(self, ref: str, entry: FileEntry, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f".{path.name}.partial")
        try:
            with open(partial, "wb") as stream:
                for block in obstore.get(self._store, _blob_path(entry.digest)).stream():
                    stream.write(block)
        except (NotFoundError, FileNotFoundError):
            partial.unlink(missing_ok=True)
            raise ArtifactError(f"{ref}: {entry.path} is missing from {self.url}") from None
        except BaseError as error:
            raise self._unreachable(error) from error
        if digest_file(partial) != entry.digest:
            partial.unlink()
            raise ArtifactError(f"{ref}: {entry.path} has changed in {self.url}")
        os.rename(partial, path)

    def check(self, ref: str) -> list[str]:
        """Download and digest every blob of an artifact, whatever the cache holds; one line for each problem."""
        shutil.rmtree(self.work / ref, ignore_errors=True)
        shutil.rmtree(self.work / ".staging" / f"{ref}.incoming", ignore_errors=True)
        try:
            self.fetch(ref)
        except ArtifactError as error:
            return [str(error)]
        return []

    def remove(self, ref: str) -> None:
        self._delete(_manifest_path(ref))
        remove_tree(self.work / ref)

    def sweep(self, grace_s: float) -> int:
        before = datetime.now(UTC) - timedelta(seconds=grace_s)
        blobs = [m for m in self._list(_BLOBS) if m["last_modified"] <= before]
        used = {
            _blob_path(e.digest) for ref in self.artifacts() for e in parse_manifest(self.read_manifest(ref), ref).files
        }
        doomed = [m for m in blobs if str(m["path"]) not in used]
        for meta in doomed:
            self._delete(str(meta["path"]))
        return sum(int(meta["size"]) for meta in doomed)


def _manifest_path(ref: str) -> str:
    return f"artifacts/{ref}/{MANIFEST}"


def _blob_path(digest: str) -> str:
    return f"{_BLOBS}{digest[:2]}/{digest}"


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]

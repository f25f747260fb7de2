"""Shards of an artifact in the making, written by several processes, each shard by one of them.

A shard is a folder. It is written under a name that holds its writer's fencing token and takes its own name in one
rename, after the writer has shown that it still holds the lease: a writer that was replaced meanwhile leaves nothing.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from wbm.artifacts.files import fsync_path, fsync_tree, locked, make_dirs
from wbm.artifacts.lease import Lease, acquire
from wbm.artifacts.store import Store


@dataclass
class Shard:
    """A claimed shard.

    Attributes:
        path: write here; it is empty at first.
        final: where `commit` puts it.
    """

    path: Path
    final: Path
    lease: Lease

    def commit(self) -> Path:
        """Flush the shard and give it its name.

        Raises:
            Conflict: another process took the shard over.
        """
        fsync_tree(self.path)
        with locked(self.final.parent / ".commit"):
            self.lease.check()
            os.rename(self.path, self.final)
            fsync_path(self.final.parent)
        return self.final


@contextmanager
def claim_shard(store: Store, ref: str, folder: Path, name: str, *, wait_s: float = 0.0) -> Iterator[Shard | None]:
    """Take a shard for this process; None when it is finished.

    Args:
        store: whose leases are used.
        ref: the artifact in the making, `kind/name/key12`.
        folder: where its shards are, below the draft's `path`.
        name: the shard's name.
        wait_s: how long to wait for a writer that may be alive elsewhere.

    Raises:
        Conflict: another living process writes it.
    """
    final = folder / name
    if final.is_dir():
        yield None
        return
    lease = acquire(store.backend, f"leases/{ref}.shards/{name}", wait_s=wait_s)
    try:
        if final.is_dir():  # finished between the look and the lease
            yield None
            return
        make_dirs(folder)
        for leftover in folder.glob(f".{name}.*.partial"):
            shutil.rmtree(leftover)
        path = folder / f".{name}.{lease.token}.partial"
        path.mkdir()
        yield Shard(path, final, lease)
    finally:
        lease.release()


def sweep_partials(folder: Path) -> None:
    """Remove what unfinished writers left, before the artifact is published."""
    for leftover in folder.glob(".*.partial"):
        shutil.rmtree(leftover)
    (folder / ".commit").unlink(missing_ok=True)

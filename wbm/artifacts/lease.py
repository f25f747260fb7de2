"""Leases with fencing tokens: one writer at a time, and a writer that was replaced can publish nothing.

A lease is a record that counts its renewals. Whether a holder is alive is never read off a wall clock: on one host the
process table answers, between hosts a waiter watches the count for one term of its own monotonic clock.
"""

from __future__ import annotations

import json
import os
import socket
import threading
import time
import uuid
from dataclasses import asdict, dataclass, replace
from typing import Any

from wbm.artifacts.backend import ABSENT, Backend
from wbm.artifacts.errors import ArtifactError, Conflict

TERM_S = 60.0
_ACTIVE: set[str] = set()  # nonces of the leases that this process holds


@dataclass(frozen=True)
class Holder:
    """A process: host with its boot, process id with its start time, and a nonce for the lease within it."""

    host: str
    boot: str
    pid: int
    start: str
    nonce: str

    @classmethod
    def here(cls) -> Holder:
        """This process."""
        return cls(socket.gethostname(), _boot_id(), os.getpid(), _start_time(os.getpid()), uuid.uuid4().hex)

    def known_dead(self) -> bool:
        """True when the process table of this very host and boot shows that the holder is gone."""
        if self.host != socket.gethostname():
            return False
        if self.boot == _boot_id() and self.pid == os.getpid() and self.nonce not in _ACTIVE:
            return True  # released by this process, though a full disk kept it from saying so
        return self.boot != _boot_id() or _start_time(self.pid) != self.start


@dataclass(frozen=True)
class _Record:
    token: int
    beat: int
    holder: Holder | None

    def to_bytes(self) -> bytes:
        return json.dumps(asdict(self)).encode()

    @classmethod
    def parse(cls, data: bytes) -> _Record:
        raw: dict[str, Any] = json.loads(data)
        return cls(raw["token"], raw["beat"], Holder(**raw["holder"]) if raw["holder"] else None)


def _boot_id() -> str:
    try:
        with open("/proc/sys/kernel/random/boot_id", encoding="ascii") as stream:
            return stream.read().strip()
    except OSError:
        return ""


def _start_time(pid: int) -> str:
    """Start time of a process in clock ticks since boot; empty when it does not run (a zombie does not)."""
    try:
        with open(f"/proc/{pid}/stat", encoding="ascii", errors="replace") as stream:
            rest = stream.read().rsplit(")", 1)[1].split()
    except OSError:
        return ""
    return "" if rest[0] in "ZX" else rest[19]


class Lease:
    """An acquired lease, renewed by a thread until it is released.

    Attributes:
        token: grows with every new holder; what an older holder writes afterwards is refused.
    """

    def __init__(self, backend: Backend, path: str, record: _Record) -> None:
        self._backend = backend
        self._path = path
        self._record = record
        self.token = record.token
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._renew, name=f"lease {path}", daemon=True)
        self._thread.start()

    def _renew(self) -> None:
        while not self._stop.wait(TERM_S / 3):
            try:
                self.check()
                fresh = replace(self._record, beat=self._record.beat + 1)
                self._backend.write(self._path, fresh.to_bytes(), self._version)
                self._record = fresh
            except Conflict:
                return  # check() reports it to the writer
            except (ArtifactError, OSError):
                continue  # a full disk or an unreachable server may recover before the term ends

    def check(self) -> None:
        """Make sure that this process is still the writer.

        Raises:
            Conflict: another process took over.
        """
        found = self._backend.read(self._path)
        current = _Record.parse(found[0]) if found else None
        if current is None or current.token != self.token or current.holder != self._record.holder:
            raise Conflict(f"{self._path}: another process took this work over; this one stops without publishing")
        self._version = found[1] if found else ABSENT

    def release(self) -> None:
        """Stop renewing and let others in; the token stays as a mark."""
        self._stop.set()
        self._thread.join()
        _ACTIVE.discard(self._record.holder.nonce if self._record.holder else "")
        try:
            self.check()
            self._backend.write(self._path, replace(self._record, holder=None).to_bytes(), self._version)
        except (ArtifactError, OSError):
            return  # taken over, or the store is out of reach: a dead holder is recognised anyway


def acquire(backend: Backend, path: str, *, wait_s: float = 0.0) -> Lease:
    """Take the lease at `path`.

    Args:
        backend: where the record lives.
        path: name of the record.
        wait_s: how long to wait for a holder that runs, or may run, elsewhere.

    Raises:
        Conflict: the holder is alive.
    """
    deadline = time.monotonic() + wait_s
    watched: tuple[int, int] | None = None
    watched_since = 0.0
    while True:
        found = backend.read(path)
        current = _Record.parse(found[0]) if found else None
        holder = current.holder if current else None
        now = time.monotonic()
        if current and (current.token, current.beat) != watched:
            watched, watched_since = (current.token, current.beat), now
        if holder is None or holder.known_dead() or now - watched_since > TERM_S:
            here = Holder.here()
            fresh = _Record((current.token if current else 0) + 1, 0, here)
            _ACTIVE.add(here.nonce)  # before others can read it
            try:
                backend.write(path, fresh.to_bytes(), found[1] if found else ABSENT)
            except BaseException as error:
                _ACTIVE.discard(here.nonce)
                if isinstance(error, Conflict):
                    continue
                raise
            return Lease(backend, path, fresh)
        if now >= deadline:
            raise Conflict(
                f"{path.removeprefix('leases/')}: being written by process {holder.pid} on {holder.host}; "
                "wait for it or stop it"
            )
        time.sleep(min(0.2, max(0.01, deadline - now)))


def is_live(backend: Backend, path: str) -> bool:
    """Whether the lease at `path` has a holder that is not known to be dead."""
    found = backend.read(path)
    holder = _Record.parse(found[0]).holder if found else None
    return holder is not None and not holder.known_dead()


def is_held(backend: Backend, ref: str) -> bool:
    """Whether a living process writes the artifact `ref` or one of its shards."""
    return any(is_live(backend, path) for path in (f"leases/{ref}", *backend.records(f"leases/{ref}.shards")))

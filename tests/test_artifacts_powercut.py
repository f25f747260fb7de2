"""Power cuts: what was not flushed may be lost, in any combination, and still nothing broken is visible.

The simulated disk follows `fsync`: it remembers the bytes of flushed files and the entries of flushed directories.
At the cut every file and directory falls back, by lot, to its flushed state or keeps its present one.
"""

import os
import random
from pathlib import Path

import pytest
from artifacts_support import manifest, publish

from wbm.artifacts import files, lease
from wbm.artifacts.store import Store

FULL = bool(os.environ.get("WBM_FULL"))


class PowerCut(BaseException):
    pass


class Disk:
    """Watches `fsync` and `rename` below `root` and stops the world at the call number `cut`."""

    def __init__(self, root, monkeypatch, cut=None):
        self.root, self.cut, self.calls = root, cut, 0
        self.contents, self.entries, self.held, self.seen = {}, {}, [], set()
        self.real = {name: getattr(os, name) for name in ("fsync", "rename")}
        self.exchange = files.exchange
        monkeypatch.setattr(os, "fsync", self.fsync)
        monkeypatch.setattr(os, "rename", lambda a, b: self.step(self.real["rename"], a, b))
        monkeypatch.setattr("wbm.artifacts.backend.exchange", lambda a, b: self.step(self.exchange, a, b))
        self.flushed(root)

    def step(self, call, *arguments):
        self.calls += 1
        if self.calls == self.cut:
            raise PowerCut
        call(*arguments)

    def fsync(self, handle):
        self.step(self.real["fsync"], handle)
        self.flushed(Path(os.readlink(f"/proc/self/fd/{handle}")))

    def flushed(self, path):
        inode = os.stat(path).st_ino
        if path.is_dir():
            self.entries[inode] = {e.name: (e.inode(), e.is_dir()) for e in os.scandir(path)}
            for child in path.iterdir():
                self.hold(child)
        else:
            self.contents[inode] = path.read_bytes()

    def hold(self, path):
        """Keep a file open, so that its inode number is not given to another one."""
        if os.stat(path).st_ino not in self.seen:
            self.seen.add(os.stat(path).st_ino)
            self.held.append(os.open(path, os.O_RDONLY))

    def after_the_cut(self, target, rng):
        """Write what a disk may hold now to `target`."""
        present = {}
        for base, dirs, names in os.walk(self.root):
            present[os.stat(base).st_ino] = {n: (os.stat(Path(base, n)).st_ino, n in dirs) for n in dirs + names}
            present |= {os.stat(Path(base, n)).st_ino: Path(base, n).read_bytes() for n in names}

        def write(inode, folder, path):
            if folder:
                old, new = self.entries.get(inode, {}), present.get(inode, {})
                path.mkdir(parents=True, exist_ok=True)
                for name in sorted(old.keys() | new.keys()):
                    entry = rng.choice([old.get(name), new.get(name)])
                    if entry:
                        write(*entry, path / name)
            else:
                old, new = self.contents.get(inode), present.get(inode)
                choices = [c for c in (old, new) if c is not None] if old is not None else [b"", new or b""]
                path.write_bytes(rng.choice(choices))

        write(os.stat(self.root).st_ino, True, target)
        for handle in self.held:
            os.close(handle)


def story(store):
    """Publish, build on it, replace by force, remove."""
    assets = publish(store, {"a": b"1" * 100, "sub/b": b"2" * 100})
    student = publish(store, {"c": b"3" * 100}, kind="student", inputs={"assets": assets})
    publish(store, {"a": b"4" * 100}, force=True)
    draft = store.begin(manifest(seed=9))
    (draft.path / "half").write_bytes(b"5" * 100)
    draft.keep()
    store.remove(student.ref)


@pytest.mark.parametrize("seed", range(40 if FULL else 2))
def test_a_power_cut_at_any_point_leaves_nothing_broken(tmp_path, monkeypatch, seed):
    rng = random.Random(seed)
    finished, cut = False, 0
    monkeypatch.setattr(lease, "TERM_S", 1e6)  # the renewals of the dead would count as calls
    while not finished:
        cut += 1 if FULL else rng.randint(1, 7)
        base, after = tmp_path / f"{cut}", tmp_path / f"{cut}-after"
        (base / "store").mkdir(parents=True)
        with monkeypatch.context() as patch:
            disk = Disk(base, patch, cut)
            try:
                story(Store.open(base / "store"))
                finished = True
            except PowerCut:
                disk.cut = None
        disk.after_the_cut(after, rng)
        store = Store.open(after / "store")
        assert store.verify() == [], f"cut {cut}"
        publish(store, {"z": b"1"}, name="afterwards")
    assert cut > 60, "the story should have many points to cut at"

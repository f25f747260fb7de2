"""Damage is found, failures of the disk lose nothing, and equal contents have equal digests."""

import errno
import os
import random
import re
import resource
import subprocess
import zipfile
from datetime import UTC, datetime

import numpy as np
import pytest
import torch
import zarr
from artifacts_support import manifest, publish
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import save_file

from wbm.artifacts import backend, collector, compare, migrate, zarr_io
from wbm.artifacts import manifest as manifests
from wbm.artifacts import store as stores
from wbm.artifacts.digest import canonical_json, digest_bytes, digest_content, digest_file, plain
from wbm.artifacts.errors import ArtifactError
from wbm.artifacts.manifest import MANIFEST, parse_manifest
from wbm.artifacts.store import Store

FLIPS = 10_000 if os.environ.get("WBM_FULL") else 400


def zarr_artifact(root, rows=12, seed=0, change=None):
    store = Store.open(root)
    draft = store.begin(manifest(seed=seed))
    spec = {"x": zarr_io.ArraySpec((rows, 2), "float32", 2, 4), "y": zarr_io.ArraySpec((rows,), "int64", 2, 4)}
    group = zarr_io.create(draft.path / "data.zarr", spec)
    values = np.arange(rows * 2, dtype=np.float32).reshape(rows, 2)
    if change:
        values[change] += 1
    for i in range(rows // 4):
        zarr_io.write_shard(group, i, {"x": values[4 * i : 4 * i + 4], "y": np.zeros(4, np.int64)})
    return store, draft.publish()


def test_every_flipped_byte_is_found(tmp_path):
    store, artifact = zarr_artifact(tmp_path)
    files = [p for p in artifact.path.rglob("*") if p.is_file()]
    places = [(path, offset) for path in files for offset in range(path.stat().st_size)]
    rng = random.Random(0)
    for path, offset in rng.choices(places, k=FLIPS):
        data = path.read_bytes()
        path.write_bytes(data[:offset] + bytes([data[offset] ^ (1 << rng.randrange(8))]) + data[offset + 1 :])
        assert store.verify(), f"{path} byte {offset}"
        path.write_bytes(data)
    assert store.verify() == []


def test_missing_extra_and_truncated_files_are_found(tmp_path):
    store, artifact = zarr_artifact(tmp_path)
    for path in [p for p in artifact.path.rglob("*") if p.is_file()]:
        data = path.read_bytes()
        path.unlink()
        assert any(path.name in line or "manifest" in line for line in store.verify()), path
        path.write_bytes(data[:-1])
        assert store.verify(), path
        path.write_bytes(data)
    (artifact.path / "extra").touch()
    assert store.verify() == [f"{artifact.ref}: extra is not in the manifest"]


def test_a_missing_shard_is_refused_where_zarr_reads_zeros(tmp_path):
    _, artifact = zarr_artifact(tmp_path)
    group = zarr_io.open_group(artifact.path / "data.zarr", artifact.manifest)
    assert group["x"][4:8].tolist() == [[8, 9], [10, 11], [12, 13], [14, 15]]
    shard = artifact.path / "data.zarr/x/c/1/0"
    data = shard.read_bytes()
    shard.unlink()
    with pytest.raises(ArtifactError, match="c/1/0: missing"):
        zarr_io.open_group(artifact.path / "data.zarr", artifact.manifest)
    shard.write_bytes(data[:-1])
    with pytest.raises(ArtifactError, match="truncated"):
        zarr_io.open_group(artifact.path / "data.zarr", artifact.manifest)


def test_a_shard_that_was_never_written_is_refused(tmp_path):
    store = Store.open(tmp_path)
    draft = store.begin(manifest())
    group = zarr_io.create(draft.path / "data.zarr", {"x": zarr_io.ArraySpec((8,), "float32", 2, 4)})
    zarr_io.write_shard(group, 0, {"x": np.ones(4, np.float32)})
    artifact = draft.publish()
    with pytest.raises(ArtifactError, match="c/1: this shard is not in the manifest"):
        zarr_io.open_group(artifact.path / "data.zarr", artifact.manifest)


def test_a_shard_is_written_whole(tmp_path):
    group = zarr_io.create(tmp_path / "d.zarr", {"x": zarr_io.ArraySpec((6,), "float32", 2, 4)})
    with pytest.raises(ValueError, match="shard 0 has shape"):
        zarr_io.write_shard(group, 0, {"x": np.ones(3, np.float32)})
    zarr_io.write_shard(group, 1, {"x": np.ones(2, np.float32)})  # the last one may be short
    with pytest.raises(ArtifactError, match="exists with shape"):
        zarr_io.create(tmp_path / "d.zarr", {"x": zarr_io.ArraySpec((8,), "float32", 2, 4)})


def test_content_is_independent_of_names_and_times(tmp_path):
    tensors = {"b": np.arange(5.0), "a": np.ones((2, 3), np.float32)}
    for i, name in enumerate(("one", "two")):
        save_file(tensors, tmp_path / f"{name}.safetensors", metadata={"written": name})
        torch.save({k: torch.from_numpy(v) for k, v in tensors.items()}, tmp_path / f"{name}.pt")
        np.savez(tmp_path / "x.npz", **tensors)
        with zipfile.ZipFile(tmp_path / "x.npz") as old, zipfile.ZipFile(tmp_path / f"{name}.npz", "w") as new:
            for member in old.namelist():
                new.writestr(zipfile.ZipInfo(member, (2000 + i, 1, 1, 0, 0, 0)), old.read(member))
    for suffix in ("safetensors", "pt", "npz"):
        one, two = tmp_path / f"one.{suffix}", tmp_path / f"two.{suffix}"
        assert digest_file(one) != digest_file(two), "otherwise this test shows nothing"
        assert digest_content(one) == digest_content(two)
    tensors["a"][0, 0] = 2
    save_file(tensors, tmp_path / "two.safetensors")
    assert digest_content(tmp_path / "one.safetensors") != digest_content(tmp_path / "two.safetensors")


def test_logs_are_verified_but_are_no_content(tmp_path):
    store = Store.open(tmp_path)
    one = publish(store, {"a": b"1", "logs/t": b"12:00"}, seed=1)
    two = publish(store, {"a": b"1", "logs/t": b"13:00"}, seed=2)
    assert one.manifest.content_digest == two.manifest.content_digest
    (one.path / "logs/t").write_bytes(b"14:00")
    assert store.verify() == [f"{one.ref}: logs/t has changed"]


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**60), 2**60) | st.floats(allow_nan=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=12,
)


@given(JSON)
@settings(max_examples=100, deadline=None)
def test_manifests_survive_the_round_trip(value):
    before = manifests.replace(manifest(), config={"x": value}, metrics={"m": value})
    after = parse_manifest(before.to_bytes(), "here")
    assert after == before
    assert after.to_bytes() == before.to_bytes()


@given(st.dictionaries(st.text(max_size=5), JSON, max_size=5))
@settings(max_examples=50, deadline=None)
def test_order_of_keys_does_not_matter(tree):
    again = dict(reversed(list(tree.items())))
    assert canonical_json(plain(tree)) == canonical_json(plain(again))


def rewrite(artifact, **changes):
    """Write a manifest with changed fields and a right checksum."""
    import json

    record = json.loads((artifact.path / MANIFEST).read_bytes().split(b"\n")[0])
    record.update(changes)
    body = canonical_json(record)
    (artifact.path / MANIFEST).write_bytes(body + b"\n" + digest_bytes(body).encode() + b"\n")


def test_a_manifest_from_a_stranger_cannot_lead_out_of_its_folder(tmp_path):
    store = Store.open(tmp_path)
    artifact = publish(store, {"a": b"1"})
    for path in ("../../a", "/etc/passwd", "x/../a", "", "a//b", MANIFEST):
        rewrite(artifact, files=[[path, 1, "0" * 64, ""]])
        with pytest.raises(ArtifactError, match="do not use this artifact"):
            store.resolve(artifact.ref)


def test_links_are_refused(tmp_path):
    store = Store.open(tmp_path)
    draft = store.begin(manifest())
    (draft.path / "link").symlink_to("/etc/passwd")
    with pytest.raises(ArtifactError, match="regular files only"):
        draft.publish()


def test_older_manifests_are_migrated_or_refused_with_what_to_do(tmp_path, monkeypatch):
    store = Store.open(tmp_path)
    artifact = publish(store, {"a": b"1"})
    rewrite(artifact, schema_version=manifests.SCHEMA_VERSION + 1)
    with pytest.raises(ArtifactError, match="install a newer wbm"):
        store.resolve(artifact.ref)
    rewrite(artifact, schema_version=0, remarks="old")
    with pytest.raises(ArtifactError, match="rebuild the artifact"):
        store.resolve(artifact.ref)
    monkeypatch.setitem(migrate.STEPS, 0, lambda record: {**record, "note": record["remarks"]})
    assert store.resolve(artifact.ref).manifest.note == "old"


@pytest.fixture
def small_disk(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    if os.geteuid() or subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", disk]).returncode:
        pytest.skip("needs the right to mount a small file system")
    yield disk
    subprocess.run(["umount", disk], check=True)


def test_disk_full_at_any_point_loses_nothing(small_disk):
    """Room for 0, 1, 2 ... pages: wherever publishing stops, nothing is lost, and with more room it goes on."""
    store = Store.open(small_disk)
    kept = publish(store, {"a": b"1" * 5000}, name="kept")
    finished, room = False, 0
    while not finished:
        ballast = small_disk / "ballast"
        stat = os.statvfs(small_disk)
        ballast.write_bytes(b"0" * max(0, stat.f_bavail * stat.f_frsize - room))
        finished = attempt(store, room)
        assert set(store.names()) <= {kept.ref, manifest(name="next", seed=room).ref}
        assert store.verify() == [], f"room for {room} bytes"
        ballast.unlink()
        assert attempt(store, room), "with room the same call goes on"
        assert store.verify() == []
        store.remove("assets/next")
        collector.collect(store, collector.garbage(store, grace_s=0), grace_s=0)
        room += 4096
    assert room > 10 * 4096, "there should be many points to stop at"
    assert store.names() == [kept.ref]


def attempt(store, seed):
    """Publish some files, the missing ones of an earlier attempt; whether it worked."""
    asked = manifest(name="next", seed=seed)
    if store.find(asked.kind, asked.name, asked.key):
        store.set_latest(asked.kind, asked.name, asked.key)
        return True
    draft = None
    try:
        draft = store.begin(asked)
        for i in range(4):
            (draft.path / f"{i}").write_bytes(b"2" * 6000)
        draft.publish()
        return True
    except (ArtifactError, OSError) as error:
        assert "No space left" in str(error) or "File too large" in str(error)
        if draft:
            draft.keep()
        return False


def test_a_limit_on_the_size_of_files_loses_nothing(tmp_path):
    """The same without a file system of one's own: every write beyond the limit fails."""
    store = Store.open(tmp_path)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    results = []
    for limit in (0, 50, 300, 1500, 5999, 6000):
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
        try:
            results.append(attempt(store, limit))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert store.verify() == []
        assert attempt(store, limit)
    assert results == [False] * 5 + [True]
    assert len(store.names()) == 6 and store.verify() == []


def test_a_store_over_two_file_systems_says_so(tmp_path, monkeypatch):
    store = Store.open(tmp_path)
    draft = store.begin(manifest())
    (draft.path / "a").write_text("1")
    with monkeypatch.context() as patch:
        patch.setattr(backend.os, "rename", lambda *_: (_ for _ in ()).throw(OSError(errno.EXDEV, "cross-device")))
        with pytest.raises(ArtifactError, match=r"another file system .*artifacts\.root=DIR"):
            draft.publish()
    draft.keep()
    assert store.names() == []
    store.begin(manifest()).publish()
    assert (store.resolve("assets").path / "a").read_text() == "1"


def test_a_read_only_store_says_so_and_still_reads(small_disk):
    artifact = publish(Store.open(small_disk), {"a": b"1"})
    subprocess.run(["mount", "-o", "remount,ro", small_disk], check=True)
    store = Store.open(small_disk)
    assert store.resolve("assets").ref == artifact.ref
    assert store.verify() == []
    with pytest.raises(ArtifactError, match=r"cannot write .*artifacts\.root=DIR"):
        store.begin(manifest(seed=1))


def test_a_clock_that_goes_backwards_does_not_matter(tmp_path, monkeypatch):
    store = Store.open(tmp_path)
    publish(store, {"a": b"1"}, seed=1)

    class Past(datetime):
        @classmethod
        def now(cls, tz=None):
            return datetime(1999, 1, 1, tzinfo=UTC)

    monkeypatch.setattr(stores, "datetime", Past)
    second = publish(store, {"a": b"2"}, seed=2)
    assert second.manifest.created.startswith("1999")
    assert store.resolve("assets").ref == second.ref


@pytest.mark.parametrize("code", [errno.EIO, errno.ESTALE, errno.ENOENT])
@pytest.mark.parametrize("late", [False, True])
def test_a_rename_that_fails_as_on_nfs(tmp_path, monkeypatch, late, code):
    """NFS may report an error before, or after, the rename took place."""
    store = Store.open(tmp_path)
    draft = store.begin(manifest())
    (draft.path / "a").write_text("1")
    real, failed = os.rename, []

    def rename(source, target):
        if str(source) == str(draft.path) and not failed:
            failed.append(1)
            if late:
                real(source, target)
            raise OSError(code, os.strerror(code))
        return real(source, target)

    monkeypatch.setattr(backend.os, "rename", rename)
    if late:
        draft.publish()
    else:
        with pytest.raises(OSError, match=re.escape(os.strerror(code))):
            draft.publish()
        assert store.names() == []
        draft.keep()
        store.begin(manifest()).publish()
    assert (store.resolve("assets").path / "a").read_text() == "1"
    assert store.verify() == []


def test_the_first_difference_is_named(tmp_path):
    _, one = zarr_artifact(tmp_path, seed=1)
    _, two = zarr_artifact(tmp_path, seed=2, change=(7, 1))
    assert compare.first_difference(one, one) is None
    found = compare.first_difference(one, two)
    assert (found.path, found.tensor, found.step) == ("data.zarr", "x", 7)
    assert "15.0 and 16.0 at [1]" in found.detail
    store = Store.open(tmp_path)
    scalars = [store.begin(manifest(name="s", seed=i)) for i in range(2)]
    for value, draft in enumerate(scalars):
        zarr.open_group(draft.path / "g.zarr", mode="w").create_array("total", data=np.array(value))
    assert compare.first_difference(*(draft.publish() for draft in scalars)).tensor == "total"
    left = store.begin(manifest(name="w", seed=1))
    right = store.begin(manifest(name="w", seed=2))
    save_file({"a": np.zeros(3), "b": np.zeros(3)}, left.path / "w.safetensors")
    save_file({"a": np.zeros(3), "b": np.array([0, 0, 1.0])}, right.path / "w.safetensors")
    found = compare.first_difference(left.publish(), right.publish())
    assert (found.tensor, found.step) == ("b", 2)

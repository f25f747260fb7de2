"""Several processes write the shards of one artifact; each shard is written by one of them, whole."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from artifacts_support import manifest

from wbm.artifacts import lease
from wbm.artifacts.errors import Conflict
from wbm.artifacts.shards import claim_shard, sweep_partials
from wbm.artifacts.store import Store

WORKER = """
import sys, pathlib, os
from wbm.artifacts.store import Store
from wbm.artifacts.shards import claim_shard
from wbm.artifacts.errors import Conflict
store, ref, folder = Store.open(sys.argv[1]), sys.argv[2], pathlib.Path(sys.argv[3])
for index in range(12):
    try:
        with claim_shard(store, ref, folder, f"{index:03d}") as shard:
            if shard is not None:
                for part in range(3):
                    (shard.path / str(part)).write_text(f"{os.getpid()}")
                shard.commit()
                print(index)
    except Conflict:
        pass
"""


def test_racing_workers_write_each_shard_once(tmp_path):
    store = Store.open(tmp_path)
    draft = store.begin(manifest())
    folder = draft.path / "shards"
    arguments = [sys.executable, "-c", WORKER, tmp_path, draft.manifest.ref, folder]
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)}
    workers = [subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True, env=env) for _ in range(3)]
    done = [int(line) for worker in workers for line in worker.communicate()[0].split()]
    assert sorted(done) == list(range(12))
    for shard in folder.glob("[0-9]*"):
        assert len({part.read_text() for part in shard.iterdir()}) == 1, "one writer"
    sweep_partials(folder)
    draft.publish()
    assert store.verify() == []


def test_a_writer_that_was_replaced_commits_nothing(tmp_path, monkeypatch):
    store = Store.open(tmp_path)
    with claim_shard(store, "rollouts/main/000000000000", tmp_path / "shards", "000") as slow:
        (slow.path / "x").write_text("slow")
        with (
            pytest.raises(Conflict, match="being written by process"),
            claim_shard(store, "rollouts/main/000000000000", tmp_path / "shards", "000"),
        ):
            pass
        monkeypatch.setattr(lease.Holder, "known_dead", lambda self: True)
        with claim_shard(store, "rollouts/main/000000000000", tmp_path / "shards", "000") as fast:
            monkeypatch.undo()
            (fast.path / "x").write_text("fast")
            fast.commit()
        with pytest.raises((Conflict, FileNotFoundError)):
            slow.commit()
    assert (tmp_path / "shards/000/x").read_text() == "fast"
    with claim_shard(store, "rollouts/main/000000000000", tmp_path / "shards", "000") as again:
        assert again is None

"""The store on a local directory and on a real S3 server: the same promises on both."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from artifacts_support import manifest, publish, s3_server

from wbm.artifacts import collector, lease, lineage, transfer
from wbm.artifacts.errors import ArtifactError, Conflict, Missing
from wbm.artifacts.lease import acquire
from wbm.artifacts.store import Store


@pytest.fixture(scope="module")
def bucket(tmp_path_factory):
    with s3_server(tmp_path_factory.mktemp("cache")) as url:
        yield url


@pytest.fixture(params=["local", "s3"])
def store(request, tmp_path):
    if request.param == "local":
        return Store.open(tmp_path / "store")
    return Store.open(f"{request.getfixturevalue('bucket')}/{tmp_path.name}")


def test_publish_then_resolve_by_every_name(store):
    artifact = publish(store, {"a.txt": b"one", "sub/b.txt": b"two"})
    assert (artifact.path / "sub/b.txt").read_bytes() == b"two"
    for text in ("assets", "assets/main", "assets/main/latest", artifact.ref, f"assets/main/{artifact.manifest.key}"):
        assert store.resolve(text).ref == artifact.ref
    assert store.names() == [artifact.ref]
    assert store.verify() == []


def test_nothing_is_visible_before_publication(store):
    draft = store.begin(manifest())
    (draft.path / "half.txt").write_text("half")
    assert store.names() == []
    with pytest.raises(Missing, match="assets/main"):
        store.resolve("assets/main")
    draft.keep()
    again = store.begin(manifest())
    assert (again.path / "half.txt").read_text() == "half", "an interrupted stage finds its files again"
    again.publish()
    assert store.names() == [manifest().ref]


def test_same_key_is_the_same_artifact(store):
    publish(store, {"a": b"1"})
    with pytest.raises(Conflict, match="already published"):
        store.begin(manifest())


def test_forced_run_replaces_and_keeps_the_old_one_for_a_look(tmp_path):
    store = Store.open(tmp_path)
    publish(store, {"a": b"1"})
    new = publish(store, {"a": b"2"}, force=True)
    assert (new.path / "a").read_bytes() == b"2"
    (old,) = (tmp_path / ".quarantine").rglob("a")
    assert old.read_bytes() == b"1"
    assert store.verify() == []


def test_latest_follows_the_newest_and_moves_back_on_removal(store):
    first, second = publish(store, {"a": b"1"}, seed=1), publish(store, {"a": b"2"}, seed=2)
    assert store.resolve("assets/main").ref == second.ref
    store.remove(second.ref)
    assert store.resolve("assets/main").ref == first.ref
    store.remove(first.ref)
    assert store.names() == []
    assert store.latest("assets", "main") is None


def test_an_input_or_a_pinned_artifact_is_not_removed(store):
    assets = publish(store, {"a": b"1"})
    student = publish(store, {"b": b"2"}, kind="student", inputs={"assets": assets})
    with pytest.raises(Conflict, match="student/main"):
        store.remove(assets.ref)
    store.pin(student.ref)
    with pytest.raises(Conflict, match="pinned"):
        store.remove(student.ref)
    store.pin(student.ref, remove=True)
    assert store.remove(student.ref) == student.ref


def test_gc_keeps_what_latest_and_pins_reach(store):
    old = [publish(store, {"a": bytes([i])}, seed=i) for i in range(3)]
    user = publish(store, {"b": b"2"}, kind="student", inputs={"assets": old[0]})
    store.pin(old[1].ref)
    newest = publish(store, {"a": b"9"}, seed=9)
    found = collector.garbage(store, grace_s=0)
    assert found.artifacts == [old[2].ref], "reached: 0 by the student, 1 by its pin, 9 by latest"
    collector.collect(store, found, grace_s=0)
    assert store.names() == sorted([old[0].ref, old[1].ref, newest.ref, user.ref])
    assert store.verify() == []


def test_gc_leaves_live_and_young_attempts_alone(store):
    live = store.begin(manifest(seed=1))
    dead = store.begin(manifest(seed=2))
    dead.keep()
    assert collector.garbage(store, grace_s=3600).folders == []
    doomed = collector.garbage(store, grace_s=0)
    assert {path.name.removesuffix(".scratch") for path in doomed.folders} == {dead.path.name}
    collector.collect(store, doomed, grace_s=0)
    assert live.path.is_dir() and not dead.path.exists()
    live.keep()


def test_lineage_goes_up_and_down(store):
    assets = publish(store, {"a": b"1"})
    student = publish(store, {"b": b"2"}, kind="student", inputs={"assets": assets})
    report = publish(store, {"c": b"3"}, kind="evaluation", inputs={"policy": student})
    manifests = lineage.load_all(store)
    up = lineage.ancestors(report.ref, manifests)
    assert up.branches[0].ref == student.ref and up.branches[0].branches[0].ref == assets.ref
    down = lineage.descendants(assets.ref, manifests)
    assert down.branches[0].ref == student.ref and down.branches[0].branches[0].ref == report.ref


def test_a_live_writer_keeps_others_out(store):
    draft = store.begin(manifest())
    with pytest.raises(Conflict, match=f"process {os.getpid()}"):
        store.begin(manifest())
    draft.keep()
    store.begin(manifest()).keep()


def test_a_dead_writer_is_replaced_at_once(store):
    code = "import sys; from wbm.artifacts.store import Store; from artifacts_support import manifest; import os\n"
    code += "d = Store.open(sys.argv[1]).begin(manifest()); (d.path / 'x').write_text('1'); os.kill(os.getpid(), 9)"
    paths = os.pathsep.join([os.path.dirname(__file__), os.getcwd()])
    done = subprocess.run([sys.executable, "-c", code, store.backend.url], env={**os.environ, "PYTHONPATH": paths})
    assert done.returncode == -9
    draft = store.begin(manifest())
    assert (draft.path / "x").read_text() == "1"
    assert draft.lease.token == 2
    draft.publish()


def test_a_writer_that_was_replaced_cannot_publish(store, monkeypatch):
    slow = store.begin(manifest())
    (slow.path / "a").write_text("slow")
    monkeypatch.setattr(lease.Holder, "known_dead", lambda self: True)  # as after a network split
    fast = store.begin(manifest())
    monkeypatch.undo()
    with pytest.raises(Conflict, match="took this work over"):
        slow.publish()
    assert store.names() == []
    assert fast.lease.token > slow.lease.token
    fast.publish()
    assert store.names() == [manifest().ref]


def test_a_silent_holder_on_another_host_is_replaced_after_a_term(store, monkeypatch):
    monkeypatch.setattr(lease, "TERM_S", 0.3)
    monkeypatch.setattr(lease.Holder, "known_dead", lambda self: False)
    frozen = acquire(store.backend, "leases/x")
    frozen._stop.set()
    with pytest.raises(Conflict):
        acquire(store.backend, "leases/x")
    taken = acquire(store.backend, "leases/x", wait_s=5)
    assert taken.token == frozen.token + 1
    taken.release()


def test_renewal_survives_a_store_that_is_out_of_reach_for_a_while(store, monkeypatch):
    monkeypatch.setattr(lease, "TERM_S", 0.15)
    held = acquire(store.backend, "leases/x")
    real, failures = store.backend.write, []

    def write(*arguments):
        if len(failures) < 3:
            failures.append(1)
            raise ArtifactError("out of reach")
        return real(*arguments)

    monkeypatch.setattr(store.backend, "write", write)
    deadline = time.monotonic() + 20
    while b'"beat": 0' in store.backend.read("leases/x")[0]:
        assert time.monotonic() < deadline, "renewal has stopped"
        time.sleep(0.02)
    held.release()


def test_a_renewing_holder_is_not_replaced(store, monkeypatch):
    monkeypatch.setattr(lease, "TERM_S", 0.3)
    monkeypatch.setattr(lease.Holder, "known_dead", lambda self: False)
    held = acquire(store.backend, "leases/x")
    with pytest.raises(Conflict):
        acquire(store.backend, "leases/x", wait_s=1.0)
    held.check()
    held.release()


def test_64_racing_writers_leave_a_linearizable_history(store):
    """Four processes with 16 threads each: a counter by compare-and-swap, `latest`, and one key to publish.

    A history of a counter is linearizable when no operation that ended before another began saw, or wrote, more.
    """
    racer, paths = Path(__file__).parent / "artifacts_racer.py", [Path(__file__).parent, Path(__file__).parent.parent]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}
    commands = [[sys.executable, racer, store.backend.url, "16", str(16 * i)] for i in range(4)]
    racing = [subprocess.Popen(c, env=env, stdout=subprocess.PIPE, text=True) for c in commands]
    answers = [json.loads(process.communicate(timeout=300)[0]) for process in racing]
    history = [operation for answer in answers for operation in answer["history"]]
    written = sorted(value for kind, value, *_ in history if kind == "write")
    assert written == list(range(1, 65)), "no update is lost, none is made twice"
    assert not_linearizable(history) is None
    generation = json.loads(store.backend.read("refs/race/newest/latest")[0])["generation"]
    assert generation == 64, "every writer of `latest` took a turn of its own"
    (winner,) = [number for answer in answers for number in answer["winners"]]
    assert (store.resolve("assets/one").path / "who").read_text() == str(winner)
    assert store.verify([store.resolve("assets/one").ref]) == []


def not_linearizable(history):
    """Two operations in the wrong order, None when there are no such: each is (kind, value, begin, end)."""
    largest = (0, 0)  # what a finished operation has shown: the value, and whether it was read or written
    ended = sorted(history, key=lambda op: op[3])
    done = 0
    for operation in sorted(history, key=lambda op: op[2]):
        while ended[done][3] < operation[2]:
            largest = max(largest, (ended[done][1], 0))
            done += 1
        kind, value = operation[:2]
        if value < largest[0] or (kind == "write" and value == largest[0]):
            return largest, operation
    for kind, value, _, end in history:  # nothing is read before somebody began to write it
        if kind == "read" and value and end < next(op[2] for op in history if op[:2] == ["write", value]):
            return kind, value
    return None


def test_the_check_of_histories_finds_what_is_wrong():
    good = [["read", 0, 0, 1], ["write", 1, 2, 5], ["read", 0, 3, 4], ["read", 1, 4, 6], ["write", 2, 7, 8]]
    assert not_linearizable(good) is None
    for bad in (["read", 0, 6, 7], ["write", 1, 9, 10], ["read", 2, 5, 6]):
        assert not_linearizable([*good, bad]) is not None


def test_push_and_pull_take_inputs_along_and_continue(store, tmp_path):
    source = Store.open(tmp_path / "source")
    assets = publish(source, {"a": b"1" * 1000, "b": b"2"})
    student = publish(source, {"c": b"3"}, kind="student", inputs={"assets": assets})
    other = publish(source, {"d": b"4"}, name="other")

    class Silent:
        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def update(self, n):
            pass

    def task(*_):
        return Silent()

    copied, present = transfer.copy_all(source, store, ["student/main"], task)
    assert copied == [assets.ref, student.ref] and present == []
    assert other.ref not in store.names()
    assert store.resolve("student").manifest == student.manifest
    assert transfer.copy_all(source, store, ["student/main"], task) == ([], [assets.ref, student.ref])
    back = Store.open(tmp_path / "back")
    transfer.copy_all(store, back, [], task)
    assert back.verify() == [] and back.names() == store.names()


def test_names_that_lead_elsewhere_are_refused(store):
    for text in ("../x/y", "assets/../../etc", "reference/../../x", "a/b/c/d", ""):
        with pytest.raises(ArtifactError):
            store.resolve(text)
    with pytest.raises(ArtifactError, match="names hold letters"):
        store.begin(manifest(name="../up"))

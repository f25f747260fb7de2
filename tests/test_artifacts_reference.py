"""Reference results: publishing them, finding them under every name, and running from them, on the toy pipeline."""

import io
import json
import shutil
import subprocess
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest
from artifacts_support import manifest, publish
from toy.register import install

from stages import plan, registry, view
from stages.cli import main
from wbm.artifacts.errors import ArtifactError, Missing
from wbm.artifacts.manifest import replace
from wbm.artifacts.reference import References, publish_reference
from wbm.artifacts.store import Store


def wbm(*arguments):
    """Run a command in this process: exit code, standard output, standard error."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as stop:
        main(list(arguments))
    return stop.value.code, out.getvalue(), err.getvalue()


@pytest.fixture(autouse=True)
def toy_stages(monkeypatch):
    monkeypatch.setattr(registry, "MODULES", {})
    monkeypatch.setattr(plan, "_code", plan._code)
    monkeypatch.setattr("stages.pipeline.git_state", lambda: {"commit": "c0ffee", "dirty": False, "patch": ""})
    install()


@pytest.fixture
def places(tmp_path):
    """Settings of a store that made everything, and of a new one; both with the same folder of reference results."""
    reference = f"artifacts.reference={tmp_path / 'reference'}"
    return [f"artifacts.root={tmp_path / 'lab'}", reference], [f"artifacts.root={tmp_path / 'new'}", reference]


@pytest.fixture
def new(places):
    """Settings of an empty store beside published reference results."""
    lab, fresh = places
    assert wbm("run", "seed=3", *lab)[0] == 0
    for name in ("assets/main", "student/main", "evaluation/main"):
        assert wbm("artifacts", "publish", name, *lab)[0] == 0
    return fresh


def test_publishing_keeps_provenance_and_drops_the_machine(places, tmp_path):
    lab, fresh = places
    assert wbm("run", *lab)[0] == 0
    original = Store.open(tmp_path / "lab").manifest("student/main")
    code, out, _ = wbm("artifacts", "publish", "student/main", "--as", "best", "--json", *lab)
    assert code == 0
    answer = json.loads(out)
    assert answer["artifact"] == "reference/best" and answer["missing_inputs"] == [original.inputs["assets"].ref]
    copy = Store.open(tmp_path / "new", tmp_path / "reference").manifest("reference/best")
    for name in ("key", "content_digest", "inputs", "code", "git", "versions", "seeds", "metrics", "config", "created"):
        assert getattr(copy, name) == getattr(original, name), name
    assert original.environment["host"] and "host" not in copy.environment
    written = b"".join(p.read_bytes() for p in (tmp_path / "reference").rglob("*") if p.is_file())
    assert str(tmp_path).encode() not in written, "no path of this machine"
    code, out, _ = wbm("artifacts", "verify", *fresh, "--json")
    assert code == 0 and json.loads(out)["checked"] == ["reference/best"]


def test_a_published_name_is_replaced_whole(places, tmp_path):
    lab, fresh = places
    for seed in (1, 2):
        assert wbm("prepare-assets", f"seed={seed}", *lab)[0] == 0
        assert wbm("artifacts", "publish", "assets/main", *lab)[0] == 0
    assert Store.open(tmp_path / "x", tmp_path / "reference").manifest("reference/assets").config["seed"] == 2
    assert [p.name for p in (tmp_path / "reference").iterdir()] == ["assets"]
    assert wbm("artifacts", "verify", "reference", *fresh)[0] == 0


def test_every_changed_byte_of_a_reference_result_is_found(new, tmp_path):
    shard = next((tmp_path / "reference/assets").rglob("c/3/0"))
    shard.write_bytes(shard.read_bytes()[:-1] + b"\0")
    code, out, _ = wbm("artifacts", "verify", *new)
    assert code == 1 and "c/3/0 has changed" in out


def test_logs_and_patterns_are_left_out_and_the_manifest_says_so(tmp_path):
    store = Store.open(tmp_path / "store", tmp_path / "reference")
    artifact = publish(store, {"a": b"1", "mcap/big": b"2" * 1000, "logs/host.txt": b"here"}, kind="evaluation")
    committed = replace(artifact.manifest, git={"commit": "c0ffee"})
    with pytest.raises(ArtifactError, match="names no commit"):
        publish_reference(artifact, store.references)
    artifact = replace(artifact, manifest=committed)
    whole = publish_reference(artifact, store.references, "whole").artifact
    assert whole.manifest.content_digest == committed.content_digest and not whole.manifest.trimmed
    assert sorted(p.name for p in whole.path.rglob("*") if p.is_file()) == ["a", "big", "manifest.json"]
    part = publish_reference(artifact, store.references, "part", ["mcap/*"]).artifact
    assert part.manifest.trimmed == {"content_digest": committed.content_digest, "left_out": ["mcap/*"]}
    assert part.manifest.content_digest != committed.content_digest
    assert store.verify(["reference/whole", "reference/part"]) == []


def test_what_cannot_be_published_is_refused_and_leaves_nothing(tmp_path):
    store = Store.open(tmp_path / "store", tmp_path / "reference")
    artifact = publish(store, {"a": b"1" * 200_000})
    artifact = replace(artifact, manifest=replace(artifact.manifest, git={"commit": "c0ffee"}))
    with pytest.raises(ArtifactError, match=r"0\.1 MB are allowed; leave files out with --without"):
        publish_reference(artifact, store.references, limit_mb=0.1)
    with pytest.raises(ArtifactError, match="names hold letters"):
        publish_reference(artifact, store.references, "../up")
    path = publish(store, {"log.txt": f"see {tmp_path}/store/x".encode()}, name="path")
    path = replace(path, manifest=replace(path.manifest, git={"commit": "c0ffee"}))
    with pytest.raises(ArtifactError, match=r"log\.txt holds the path"):
        publish_reference(path, store.references)
    (artifact.path / "a").write_bytes(b"2" * 200_000)
    with pytest.raises(ArtifactError, match=r"a has changed; a damaged artifact"):
        publish_reference(artifact, store.references)
    assert list((tmp_path / "reference").iterdir()) == []


def test_a_reference_result_is_found_under_every_name(new, tmp_path):
    store = Store.open(tmp_path / "new", tmp_path / "reference")
    student = store.resolve("reference/student")
    assert store.resolve("reference", ("student",)).path == student.path
    assert store.resolve(student.ref).path == student.path, "as an input of another one"
    assert store.resolve(f"student/main/{student.manifest.key}").path == student.path
    assert store.names() == [], "the store itself holds nothing"
    for text, says in (
        ("reference/stdent", "there are reference/assets, reference/evaluation, reference/student"),
        ("reference", "name one of them; there are reference/assets"),
        ("student/main", "nothing published under this name"),
        ("student/main/0123456789ab", "not published"),
        ("reference/../lab/student", "no such reference result"),
    ):
        with pytest.raises(Missing, match=says):
            store.resolve(text)
    with pytest.raises(Missing, match="there are none in"):
        References(tmp_path / "no").get("reference/x")
    _, out, _ = wbm("artifacts", "why", "reference/evaluation", *new, "--json")
    made_from = json.loads(out)["made_from"]
    assert made_from[0]["artifact"] == student.ref and made_from[0]["branches"][0]["slot"] == "assets"
    _, out, _ = wbm("artifacts", "ls", "reference", *new)
    assert out.count("reference/") == 3


def test_a_reference_policy_is_evaluated_at_once(new, tmp_path):
    store = Store.open(tmp_path / "new", tmp_path / "reference")
    for policy in ("reference", "reference/student"):
        code, _, err = wbm("evaluate", f"policy={policy}", "--json", *new)
        assert code == 0, err
        assert "reference/student is used as student/main/" in err
    used = store.manifest("evaluation/main").inputs["policy"]
    assert used.ref == store.manifest("reference/student").ref
    code, _, err = wbm("evaluate", "policy=reference/nobody", *new)
    assert code == 1 and "reference/nobody: no such reference result; there are reference/assets" in err
    code, _, err = wbm("evaluate", "policy=reference/assets", *new)
    assert code == 2 and "is of kind assets, this input takes student or teacher or bundle" in err


def test_a_run_from_the_reference_results_trains_nothing(new):
    code, out, err = wbm("run", "--from", "reference", "--json", *new)
    assert code == 0, err
    assert [s["stage"] for s in json.loads(out)["stages"]] == ["evaluate"]
    assert wbm("plan", "--check", "--from", "reference", *new)[0] == 0
    _, out, _ = wbm("plan", "--json", *new)
    assert len(json.loads(out)["stages"]) == 3, "without --from nothing changes"
    code, out, err = wbm("run", "--from", "reference", "--until", "distill", "--json", *new)
    assert [s["stage"] for s in json.loads(out)["stages"]] == ["distill"], (
        "the last stage is run, from its reference input"
    )
    code, _, err = wbm("run", "--from", "elsewhere", *new)
    assert code == 2 and "only 'reference' is known" in err


def test_what_has_no_reference_result_is_made(new, tmp_path):
    shutil.rmtree(tmp_path / "reference/student")
    code, out, _ = wbm("run", "--from", "reference", "--json", *new)
    assert [s["stage"] for s in json.loads(out)["stages"]] == ["distill", "evaluate"]
    code, _, err = wbm("evaluate", "policy=reference", *new)
    assert code == 1 and "reference: no student among them; there are reference/assets, reference/evaluation" in err


def test_inputs_are_checked_by_slot_and_kind(new):
    code, _, err = wbm("run", "+inputs.asets=reference/assets", *new)
    assert code == 2 and "+inputs.asets: no stage has this input; did you mean 'assets'?" in err
    code, _, err = wbm("run", "+inputs.assets=reference/student", *new)
    assert code == 2 and "reference/student is of kind student, this input takes assets" in err
    assert wbm("distill", "+inputs.assets=reference/assets", *new)[0] == 0


def test_one_teacher_of_a_suite_is_replaced_by_name(tmp_path, monkeypatch):
    from stages.compose import compose

    monkeypatch.undo()
    store = Store.open(tmp_path / "store", tmp_path / "reference")
    side = publish(store, {"a": b"1"}, kind="teacher", name="side")
    publish_reference(replace(side, manifest=replace(side.manifest, git={"commit": "1"})), store.references)

    def rollouts(*overrides, **options):
        stages = registry.load_until("generate-rollouts")
        return plan.build(stages, overrides, lambda lines: compose(lines).config, store, **options)[-1]

    assert rollouts().fixed == {}
    for node in (rollouts("+inputs.teacher_side=reference/teacher_side"), rollouts(reference=True)):
        assert {k: m.ref for k, m in node.fixed.items()} == {"teacher/side": side.ref}
        assert sorted(node.upstream) == ["assets", "teacher/top_down"]


def test_the_viewer_finds_the_reference_episodes(new, tmp_path, monkeypatch):
    shown = []

    def items_of(path, kind, assets):
        shown.append((path, kind))
        raise ValueError("seen")

    monkeypatch.setattr(view, "items_of", items_of)
    assert "seen" in wbm("view", "reference", *new)[2]
    assert shown == [(tmp_path / "reference/evaluation", "evaluation")]


def test_git_keeps_every_file_of_a_reference_result(tmp_path):
    """Names that other patterns ignore (logs, builds) survive a commit and a clone, byte by byte."""
    repository = Path(__file__).resolve().parent.parent
    lab = tmp_path / "lab"
    lab.mkdir()
    for name in (".gitignore", ".gitattributes"):
        shutil.copy(repository / name, lab / name)
    store = Store.open(lab / "artifacts")
    files = {"run.log": b"a\r\n", "build/x": b"b\n", "dist/y.pyc": b"\0\r\n", ".hidden": b"c", "outputs/z": b"d\r"}
    artifact = publish(store, files)
    publish_reference(replace(artifact, manifest=replace(artifact.manifest, git={"commit": "1"})), store.references)
    git = ["git", "-c", "user.name=x", "-c", "user.email=x@x", "-c", "core.autocrlf=true", "-c", "init.defaultBranch=x"]
    for command in (["init", "-q"], ["add", "-A"], ["commit", "-qm", "x"]):
        subprocess.run([*git, *command], cwd=lab, check=True)
    subprocess.run([*git, "clone", "-q", "lab", "clone"], cwd=tmp_path, check=True)
    clone = Store.open(tmp_path / "clone/artifacts")
    assert clone.names() == [] and clone.references.names() == ["reference/assets"]
    assert clone.verify(["reference/assets"]) == []
    assert manifest().ref == clone.manifest("reference/assets").ref

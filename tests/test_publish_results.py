"""docs/results/ holds what the artifacts hold, says how they were made, and never half of it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.publish_results import publish
from tests.test_figure4 import made_up
from wbm.artifacts.errors import ArtifactError
from wbm.artifacts.manifest import InputRef, Manifest
from wbm.artifacts.store import Store
from wbm.report.figure4 import gather, write_figure4
from wbm.report.stats import summarise

HOME = "/somewhere/of/mine"


def add(store: Store, kind: str, name: str, key: str, write, inputs=(), **fields):
    refs = {m.kind: InputRef(m.ref, m.content_digest) for m in inputs}
    command = f"/usr/bin/wbm run profile=laptop artifacts.root={HOME} seed=3 --json"
    git = {"commit": "abc123def4567", "dirty": False}
    draft = store.begin(Manifest(kind, name, key * 16, inputs=refs, command=command, git=git, seeds={"seed": 3}))
    write(draft.path)
    draft.metrics |= fields
    return draft.publish().manifest


@pytest.fixture
def store(tmp_path) -> Store:
    made = Store.open(tmp_path / "store")
    assets = add(made, "assets", "procedural", "a1b2", lambda p: (p / "x").write_text("x"))
    student = add(made, "student", "main", "c3d4", lambda p: (p / "curve.png").write_bytes(b"png"), [assets])
    records = [{"success": i < 6, "reason": "dropped", "object": "can", "scene": "bin"} for i in range(8)]
    numbers = summarise(records)
    add(made, "evaluation", "main", "e5f6", lambda p: (p / "report.html").write_text("page"), [student], **numbers)
    add(made, "evaluation", "figure4", "a7b8", lambda p: write_figure4(p, gather(made_up()), {}, {}), [assets])
    return made


def test_everything_that_was_asked_for_is_there(store, tmp_path):
    target = tmp_path / "results"
    target.mkdir()
    (target / "old.txt").write_text("from last time")
    assert publish(store, ["evaluation/main", "evaluation/figure4"], target, "2 cores") == []
    files = {p.relative_to(target).as_posix() for p in target.rglob("*") if p.is_file()}
    assert files == {
        "README.md", "results.json", "evaluation-main/report.html", "student-main/curve.png",
        *(f"evaluation-figure4/{n}" for n in ("report.html", "figure4.json", "figure4.svg", "figure4.png")),
    }  # fmt: skip
    text = (target / "README.md").read_text()
    assert "**75.0 %**" in text and "| RL stage | Full system | **90.0 %** | 84.2 to 93.8 % | 100 % |" in text
    assert "wbm run profile=laptop seed=3" in text and "2 cores" in text and "abc123def4" in text
    assert "The order is the paper's and the intervals are apart." in text
    record = json.loads((target / "results.json").read_text())
    assert record["commands"] == ["wbm run profile=laptop seed=3"]
    assert [a["artifact"].split("/")[0] for a in record["artifacts"]].count("assets") == 1
    for path in target.rglob("*"):
        if path.suffix in (".md", ".json"):
            assert HOME not in path.read_text(), "paths of the machine stay at home"


def test_a_damaged_artifact_is_not_published_and_nothing_is_lost(store, tmp_path):
    target = tmp_path / "results"
    publish(store, ["evaluation/main"], target, "2 cores")
    before = (target / "README.md").read_text()
    page: Path = store.resolve("evaluation/main").path / "report.html"
    page.chmod(0o644)
    page.write_text("another page")
    with pytest.raises(ArtifactError, match="damaged"):
        publish(store, ["evaluation/main"], target, "2 cores")
    assert (target / "README.md").read_text() == before

"""The whole pipeline as a user runs it: six stages from one command, then nothing to do, then one setting changed."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import SMALL

pytestmark = [pytest.mark.pipeline, pytest.mark.slow]


def wbm(*arguments: str, root: Path) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "stages.cli", *arguments, f"artifacts.root={root}"],
        capture_output=True,
        text=True,
        timeout=400,
        cwd=Path(__file__).parents[1],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )


@pytest.fixture
def root(small_store) -> Path:
    return small_store


def test_every_kind_is_published_and_intact(root):
    for kind in ("assets", "teacher", "rollouts", "student", "evaluation", "bundle"):
        assert list((root / kind).glob("*/*/manifest.json")), kind
    assert wbm("artifacts", "verify", root=root).returncode == 0


def test_the_report_and_the_bundle_hold_what_the_run_made(root):
    folder = next((root / "evaluation").glob("*/*/report.html")).parent
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["episodes"] == 2
    assert len(json.loads((folder / "records.json").read_text())) == 2
    assert "data:video/mp4" in (folder / "report.html").read_text()
    manifest = json.loads(next((root / "bundle").glob("*/*/manifest.json")).read_text().splitlines()[0])
    assert manifest["metrics"]["parity"] <= 1e-5


def test_the_student_says_what_it_was_made_from_its_own_episodes_included(root):
    folder = next((root / "student").glob("*/*/manifest.json")).parent
    manifest = json.loads((folder / "manifest.json").read_text().splitlines()[0])
    assert set(manifest["inputs"]) == {"rollouts", "assets", "teacher/top_down"}
    assert json.loads((folder / "curve.json").read_text())[-1]["step"] == 25  # 20 of cloning and a round of 5
    rollouts = json.loads(next((root / "rollouts").glob("*/*/manifest.json")).read_text().splitlines()[0])
    assert manifest["metrics"]["episodes"] == rollouts["metrics"]["kept"] + 2  # too few for one to be held out


def test_a_second_run_has_nothing_to_do(root):
    assert wbm("plan", "--check", *SMALL, root=root).returncode == 0
    again = wbm("run", *SMALL, root=root)
    assert again.returncode == 0
    assert "running" not in again.stderr


def test_one_setting_reruns_what_reads_it(root):
    plan = wbm("plan", "--json", *SMALL, "distill.lr=2e-3", root=root)
    entries = {entry["stage"]: entry for entry in json.loads(plan.stdout)["stages"]}
    stale = {name for name, entry in entries.items() if entry["reasons"]}
    assert stale == {"distill", "evaluate", "deploy-export"}
    assert "distill.lr" in " ".join(entries["distill"]["reasons"])


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["run", "distil.lr=1"], 2, "distill"),
        (["distill", "distill.lr=fast"], 2, "distill.lr"),
        (["evaluate", "profile=smoke", "policy=student/nobody"], 1, "student/nobody"),
        (["prepare-assets", "objects=meshes", "objects.path=/nowhere"], 1, "/nowhere"),
    ],
)
def test_bad_input_is_one_clear_line(arguments, code, says, tmp_path):
    result = wbm(*arguments, root=tmp_path / "store")
    assert result.returncode == code, result.stderr
    assert says in result.stderr
    assert "Traceback" not in result.stderr

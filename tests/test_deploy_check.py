"""Trying a bundle out before it moves a robot: soak, replay, and comparison with its student."""

from __future__ import annotations

import io
import json
import time
from contextlib import redirect_stderr, redirect_stdout

import numpy as np
import pytest
from deploy_synthetic import SENTENCES, FakeRobot, make_bundle

from stages.bundle_check import compare_records
from stages.cli import main
from wbm.deploy.bundle import Bundle
from wbm.deploy.log import RunLog, read_messages
from wbm.deploy.loop import run_loop, timing_summary
from wbm.deploy.runtime import PolicyRuntime
from wbm.deploy.soak import soak

PERIODS = 25


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return make_bundle(tmp_path_factory.mktemp("check") / "policy.wbm")


def wbm(*arguments: str) -> tuple[int, str, str]:
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as stop:
        main(list(arguments))
    return int(stop.value.code or 0), out.getvalue(), err.getvalue()


def test_a_soak_accounts_for_every_period_and_logs_them(path, tmp_path):
    answer = soak(Bundle.open(path), PERIODS / 1500, tmp_path / "run.mcap")
    assert answer["periods"] == PERIODS == answer["commands"] + sum(answer["refusals"].values())
    assert answer["ok"] == (answer["missed"] == 0 and answer["rss_growth_mb"] <= 2.0)
    assert len(list(read_messages(tmp_path / "run.mcap", "/policy/action"))) == answer["commands"]
    assert 0 < answer["p50_ms"] <= answer["p99_ms"] <= answer["max_ms"]


def test_a_policy_that_is_too_slow_is_found_out(path, monkeypatch):
    step = PolicyRuntime.step
    monkeypatch.setattr(PolicyRuntime, "step", lambda *a: time.sleep(0.05) or step(*a))
    answer = soak(Bundle.open(path), 3 / 1500)
    assert answer["missed"] >= 3 and not answer["ok"]


def test_periods_that_passed_without_a_step_are_missed_deadlines(path):
    class Stutters(FakeRobot):
        def read(self):
            self.time += 2 * self.dt * (len(self.commands) == 5)  # two periods go by, once
            return super().read()

    report = run_loop(Stutters(), PolicyRuntime(Bundle.open(path)), 12)
    assert report.steps == 12 and report.missed == 2


def test_timing_of_known_periods():
    summary = timing_summary(np.array([0.001] * 99 + [0.003]), np.array([0.04, 0.04, 0.05, 0.04]))
    assert summary["p50_s"] == 0.001 and summary["max_s"] == 0.003
    assert summary["jitter_max_s"] == pytest.approx(0.01)
    assert summary["jitter_s"] == pytest.approx(np.std([0.0, 0.0, 0.01, 0.0]))
    assert set(timing_summary(np.zeros(0), np.zeros(0)).values()) == {0.0}


def test_a_log_is_replayed_against_a_new_bundle_from_the_command_line(path, tmp_path):
    with RunLog(tmp_path / "run.mcap") as log:
        run_loop(FakeRobot(), PolicyRuntime(Bundle.open(path), SENTENCES[0]), 10, log)
    make_bundle(tmp_path / "new.wbm", seed=3)
    code, out, _ = wbm("bundle", "replay", str(tmp_path / "run.mcap"), str(path), "--json")
    assert code == 0 and json.loads(out) == {"steps": 10, "max_difference": 0.0, "mean_difference": 0.0}
    code, out, _ = wbm("bundle", "replay", str(tmp_path / "run.mcap"), str(tmp_path / "new.wbm"), "--json")
    assert code == 0 and json.loads(out)["max_difference"] > 0.01
    with RunLog(tmp_path / "blind.mcap", observations=False) as log:
        log.note(0.0, "nothing was seen")
    code, _, err = wbm("bundle", "replay", str(tmp_path / "blind.mcap"), str(path))
    assert code == 1 and "observations=True" in err


def evaluation(folder, successes, rows, refusals=None):
    folder.mkdir()
    records = [
        {"episode": i, "scene_row": r, "success": s} for i, (s, r) in enumerate(zip(successes, rows, strict=True))
    ]
    (folder / "records.json").write_text(json.dumps(records))
    (folder / "summary.json").write_text(json.dumps({"refusals": refusals or {}}))
    return folder


def test_the_same_episodes_are_compared_one_by_one(tmp_path):
    rows = list(range(40))
    student = evaluation(tmp_path / "s", [True] * 30 + [False] * 10, rows)
    close = evaluation(tmp_path / "c", [True] * 28 + [False] * 10 + [True] * 2, rows, {"workspace": 3})
    answer = compare_records(student, close)
    assert answer["intervals_overlap"] and answer["refusals"] == {"workspace": 3}
    assert (answer["only_student"], answer["only_bundle"]) == ([28, 29], [38, 39])
    far = evaluation(tmp_path / "f", [True] * 8 + [False] * 32, rows)
    assert not compare_records(student, far)["intervals_overlap"]
    with pytest.raises(ValueError, match="same episodes"):
        compare_records(student, evaluation(tmp_path / "o", [True] * 40, rows[::-1]))

"""Submissions without a cluster: what is frozen, what a job refuses, how it hears that it must go."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest

from stages import job
from stages.commands import composer, open_store
from stages.pipeline import StageError
from stages.plan import build, plan
from stages.registry import load_all
from stages.submit import ENTRY, freeze
from wbm.launch.config import LauncherConfig
from wbm.launch.jobs import find, job_ids
from wbm.launch.slurm import LaunchError, _parameters
from wbm.launch.stop import Stopped, StopSignal
from wbm.launch.submission import Resources, create, read, read_result


def frozen(root: Path, *overrides: str, **launcher):
    """The tasks of the whole pipeline in an empty store."""
    lines = [f"artifacts.root={root}", *overrides]
    store = open_store(composer(lines))
    return freeze([plan(build(load_all(), lines, composer, store), store)], LauncherConfig(**launcher))


def test_a_pipeline_is_frozen_into_arrays(tmp_path: Path) -> None:
    tasks = frozen(tmp_path, "rollouts.shards=5", shards=2, nodes=2, processes=4, gpus=8)
    groups = {}
    for task in tasks:
        groups.setdefault(task.group, []).append(task)
    assert [len(groups[g]) for g in ("train-teacher", "generate-rollouts-shards", "generate-rollouts")] == [2, 3, 1]
    assert [t.work["parts"] for t in groups["generate-rollouts-shards"]] == [[0, 1], [2, 3], [4]]
    assert groups["generate-rollouts-shards"][0].after == ("prepare-assets", "train-teacher")
    assert groups["generate-rollouts"][0].after == ("generate-rollouts-shards",)
    teachers = {slot: entry for slot, entry in groups["generate-rollouts"][0].work["inputs"].items() if "/" in slot}
    assert teachers == {"teacher/top_down": {"task": "train-teacher.0"}, "teacher/side": {"task": "train-teacher.1"}}
    assert groups["train-teacher"][0].resources == Resources(2, 4, 0)  # no GPU for MuJoCo C
    assert groups["distill"][0].resources == Resources()
    assert tasks[0].work["key"] and not tasks[1].work["key"]  # known when its inputs are
    assert Path(tasks[0].work["config"]["artifacts"]["root"]).is_absolute()


def test_a_job_refuses_other_code_and_says_which(tmp_path: Path) -> None:
    tasks = frozen(tmp_path / "artifacts")
    assets = next(t for t in tasks if t.group == "prepare-assets")
    assets.work["code"]["stages/prepare_assets.py"] = "0" * 64
    submission, place = create(tmp_path / "jobs", "wbm run", ENTRY, tasks)
    with pytest.raises(StageError, match=r"stages/prepare_assets.py changed since this was submitted; submit again"):
        job.main(place, read(place).task(assets.name), StopSignal(None))
    assert read_result(place, assets.name)["state"] == "failed"
    assert submission.task("distill.0").work["stage"] == "distill"
    with pytest.raises(StageError, match=r"task prepare-assets.0 made nothing"):
        job.main(place, read(place).task("train-teacher.0"), StopSignal(None))


def test_signals_stop_at_a_safe_point_or_when_patience_ends() -> None:
    with StopSignal(None) as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.asked() and not stop.requeue  # Slurm decides
        os.kill(os.getpid(), signal.SIGUSR2)
        assert stop.requeue
    with pytest.raises(Stopped, match="no safe point"), StopSignal(0.05):
        os.kill(os.getpid(), signal.SIGUSR2)
        time.sleep(5)
    assert signal.getsignal(signal.SIGUSR2) is signal.SIG_DFL


def test_settings_reach_sbatch_and_bad_ones_are_refused(tmp_path: Path) -> None:
    cfg = LauncherConfig(partition="gpu", mem=1.5, time=30, grace=60, extra={"mail-type": "END"})
    p = _parameters(cfg, "train-teacher", Resources(2, 4, 4), ["7", "8"], tmp_path)
    assert (p["partition"], p["nodes"], p["ntasks_per_node"], p["gpus_per_node"]) == ("gpu", 2, 4, 4)
    assert (p["mem"], p["time"], p["signal_delay_s"], p["dependency"]) == ("1536M", 30, 60, "afterok:7:8")
    assert p["additional_parameters"] == {"requeue": True, "kill-on-invalid-dep": "yes", "mail-type": "END"}
    for bad in ({"nodes": 0}, {"gpus": -1}, {"time": 1, "grace": 60}, {"poll": 0.0}, {"folder": ""}):
        with pytest.raises(ValueError, match=r"^launcher\."):
            LauncherConfig(**bad)


def test_submissions_are_found_by_the_beginning_of_their_id(tmp_path: Path) -> None:
    submission, place = create(tmp_path, "wbm run", ENTRY, [])
    assert job_ids(place) == {}
    with pytest.raises(LaunchError, match="no such submission"):
        find(tmp_path, submission.id)  # it never reached Slurm
    (place / "jobs.json").write_text('{"distill": "1"}')
    assert find(tmp_path, submission.id[:6])[0].id == find(tmp_path, "latest")[0].id == submission.id

"""Stage generate-rollouts: successful whole-body trajectories with what the student would have seen."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from stages.registry import PARTS

KIND = "rollouts"
SECTIONS = ("seed", "robot", "sim", "wbc", "sensors", "env", "rollouts")
INPUTS = ("assets", "teacher/*")
REPORTS = "reports"
SHARDS = "shards"


def name(cfg: Any) -> str:
    """One dataset a configuration."""
    return "main"


def run(cfg: Any, inputs: dict[str, Any], draft: Any, progress: Any) -> None:
    """Make the shards that are missing, in as many processes as `rollouts.workers`, and count what came of them.

    Args:
        cfg: reads the sections named in `SECTIONS`.
        inputs: `assets` and every teacher of the suite.
        draft: shards go to `draft.path/shards`, a report of each to `draft.path/reports`.
        progress: offers `task`.
    """
    from wbm.artifacts.episode_layout import shard_index
    from wbm.learning.rollouts import ShardReport, merge_reports
    from wbm.learning.workers import run_jobs

    folder, reports = draft.path / SHARDS, draft.path / REPORTS
    reports.mkdir(parents=True, exist_ok=True)
    _take_parts(draft.path)
    jobs = [shard_job(cfg, inputs, i, folder) for i in range(cfg.rollouts.shards)]
    # A shard is done when its report is on the disk, which is flushed after the shard; anything less is made again.
    waiting = [job for job in jobs if not _report(reports, job.shard).exists()]
    for job in waiting:
        shard_index(folder, job.shard).unlink(missing_ok=True)  # finished, but its report was lost
    with progress.task("rollouts", total=len(jobs)) as task:
        task.update(len(jobs) - len(waiting))
        for report in run_jobs("wbm.learning.rollouts", waiting, cfg.rollouts.workers):
            _write_report(reports, report)
            task.update(1, kept=report.kept)
            progress.safe_point()
    done = [ShardReport(**json.loads(_report(reports, job.shard).read_text())) for job in jobs]
    totals = merge_reports(done)
    if totals["kept"] == 0:
        raise ValueError("no episode succeeded, so there is nothing to learn from; train the teachers longer")
    draft.metrics |= totals
    _samples(cfg, draft, folder)


def parts(cfg: Any) -> int:
    """A part is a shard."""
    return cfg.rollouts.shards


def make_parts(cfg: Any, inputs: dict[str, Any], places: dict[int, Path], workers: int) -> Iterator[int]:
    """Make shards, each in a folder of its own with its report."""
    from wbm.learning.workers import run_jobs

    jobs = [shard_job(cfg, inputs, number, place / SHARDS) for number, place in places.items()]
    for report in run_jobs("wbm.learning.rollouts", jobs, workers):
        _write_report(places[report.shard] / REPORTS, report)
        yield report.shard


def uses_gpu(cfg: Any) -> bool:
    """The physics engine decides."""
    return cfg.sim.engine == "mujoco_warp"


def shard_job(cfg: Any, inputs: dict[str, Any], shard: int, folder: Path) -> Any:
    """What a process needs to make shard `shard` in `folder`."""
    from wbm.envs.world import WorldConfig
    from wbm.learning.rollouts import ShardJob
    from wbm.sim.simulation import default_device

    world = WorldConfig(cfg.robot, cfg.sim, cfg.wbc, cfg.env)
    teachers = {slot.partition("/")[2]: art.path for slot, art in inputs.items() if slot.startswith("teacher/")}
    device = default_device(cfg.sim)
    return ShardJob(shard, folder, inputs["assets"].path, teachers, world, cfg.sensors, cfg.rollouts, cfg.seed, device)


def _report(reports: Path, shard: int) -> Path:
    return reports / f"{shard:05d}.json"


def _write_report(reports: Path, report: Any) -> None:
    from wbm.artifacts.files import write_atomic

    write_atomic(_report(reports, report.shard), (json.dumps(report.to_dict(), sort_keys=True) + "\n").encode())


def _take_parts(path: Path) -> None:
    """Bring the shards that other jobs made to where this stage makes them; a shard's report comes last."""
    from wbm.artifacts.shards import sweep_partials

    if not (path / PARTS).is_dir():
        return
    sweep_partials(path / PARTS)
    (path / SHARDS).mkdir(exist_ok=True)
    for part in sorted((path / PARTS).iterdir()):
        for below in (SHARDS, REPORTS):
            for item in sorted((part / below).glob("*"), key=lambda p: p.suffix == ".json"):
                item.rename(path / below / item.name)
            (part / below).rmdir()
        part.rmdir()
    (path / PARTS).rmdir()


def _samples(cfg: Any, draft: Any, folder: Any) -> None:
    """Write some episodes as MCAP too."""
    from wbm.artifacts.episode_reader import EpisodeReader, shard_paths
    from wbm.report.tracks import write_episode_mcap
    from wbm.robot.schema import PolicySchema

    schema = PolicySchema().with_points(cfg.sensors.depth_cloud.num_points, cfg.sensors.lidar_cloud.num_points)
    left = cfg.rollouts.samples
    for path in shard_paths(folder):
        reader = EpisodeReader(path, schema)
        for i in range(min(left, len(reader.episodes))):
            target = draft.path / "samples" / f"episode-{cfg.rollouts.samples - left:03d}.mcap"
            target.parent.mkdir(exist_ok=True)
            write_episode_mcap(target, reader.read_episode(i), schema)
            left -= 1
        if left == 0:
            return

"""Stage generate-rollouts: successful whole-body trajectories with what the student would have seen."""

from __future__ import annotations

import json
from typing import Any

KIND = "rollouts"
SECTIONS = ("seed", "robot", "sim", "wbc", "sensors", "env", "rollouts")
INPUTS = ("assets", "teacher/*")
REPORTS = "reports"


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
    from wbm.artifacts.files import write_atomic
    from wbm.envs.world import WorldConfig
    from wbm.learning.rollouts import ShardJob, ShardReport, merge_reports
    from wbm.learning.workers import run_jobs

    world = WorldConfig(cfg.robot, cfg.sim, cfg.wbc, cfg.env)
    teachers = {slot.partition("/")[2]: art.path for slot, art in inputs.items() if slot.startswith("teacher/")}
    folder, reports = draft.path / "shards", draft.path / REPORTS
    reports.mkdir(parents=True, exist_ok=True)
    assets = inputs["assets"].path
    jobs = [
        ShardJob(i, folder, assets, teachers, world, cfg.sensors, cfg.rollouts, cfg.seed)
        for i in range(cfg.rollouts.shards)
    ]
    # A shard is done when its report is on the disk, which is flushed after the shard; anything less is made again.
    waiting = [job for job in jobs if not (reports / f"{job.shard:05d}.json").exists()]
    for job in waiting:
        (folder / f"shard-{job.shard:05d}.json").unlink(missing_ok=True)  # finished, but its report was lost
    with progress.task("rollouts", total=len(jobs)) as task:
        task.update(len(jobs) - len(waiting))
        for report in run_jobs("wbm.learning.rollouts", waiting, cfg.rollouts.workers):
            text = json.dumps(report.to_dict(), sort_keys=True) + "\n"
            write_atomic(reports / f"{report.shard:05d}.json", text.encode())
            task.update(1, kept=report.kept)
    done = [ShardReport(**json.loads((reports / f"{job.shard:05d}.json").read_text())) for job in jobs]
    totals = merge_reports(done)
    if totals["kept"] == 0:
        raise ValueError("no episode succeeded, so there is nothing to learn from; train the teachers longer")
    draft.metrics |= totals
    _samples(cfg, draft, folder)


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

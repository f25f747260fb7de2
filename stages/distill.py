"""distill: train the student on rollouts, and on what controller and teachers say to its own episodes (DAgger)."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

KIND = "student"
SECTIONS = ("seed", "student", "distill", "robot", "sim", "wbc", "sensors", "env", "rollouts")
INPUTS = ("rollouts", "assets", "teacher/*")
SHARD_EPISODES = 96


def name(cfg: Any) -> str:
    """Name of the artifact."""
    return "main"


def uses_gpu(cfg: Any) -> bool:
    """Whether the student learns on a GPU."""
    return cfg.distill.device != "cpu"


def run(cfg: Any, inputs: Any, draft: Any, progress: Any) -> None:
    """Train on the rollouts' shards; publish weights, specification and learning curve."""
    from dataclasses import replace

    from wbm.artifacts.episode_reader import EpisodeReader, shard_paths
    from wbm.learning.distill import distill
    from wbm.learning.student import count_parameters, save_student
    from wbm.robot.schema import PolicySchema

    # Open the input: the schema is the one that the episodes were written with
    paths = shard_paths(inputs["rollouts"].path / "shards")
    schema = PolicySchema.from_dict(EpisodeReader(paths[0]).schema)
    settings = replace(cfg.distill, seed=cfg.distill.seed + cfg.seed)

    # Train
    started = time.process_time()
    with progress.task("distill", total=settings.total_iterations) as task:
        done = 0

        def report(step: int, total: int, figures: dict[str, float]) -> None:
            nonlocal done
            task.update(step - done, **figures)
            done = step

        def collect(policy: Any, number: int) -> list[Path]:
            return _collect(cfg, inputs, draft.scratch / f"round-{number}", policy, number)

        result = distill(paths, schema, cfg.student, settings, draft.scratch, report, collect)

    # Publish
    save_student(draft.path, result.network, {"iterations": settings.total_iterations})
    (draft.path / "curve.json").write_text(json.dumps(result.curve, indent=1) + "\n", encoding="utf-8")
    last = result.curve[-1]
    for view in ("both", "mask", "text"):
        if f"val_{view}_loss" in last:
            draft.metrics[f"val_{view}_loss"] = last[f"val_{view}_loss"]
    draft.metrics |= {
        "train_loss": last["train_loss"],
        "p_obj_error_m": last.get("val_both_p_obj_m", last["train_p_obj_m"]),
        "parameters": count_parameters(result.network),
        "episodes": result.num_episodes,
        "windows": result.num_windows,
        "cpu_seconds": round(time.process_time() - started, 1),
    }
    draft.seeds["distill"] = settings.seed


def _collect(cfg: Any, inputs: Any, folder: Path, policy: Any, number: int) -> list[Path]:
    """Shards of a round of DAgger in `folder`; those that an interrupted run finished are kept."""
    from dataclasses import replace

    from stages.generate_rollouts import SHARDS, shard_job
    from wbm.artifacts.episode_layout import shard_index
    from wbm.artifacts.episode_reader import shard_paths
    from wbm.learning.dagger import RoundJob
    from wbm.learning.student import save_student
    from wbm.learning.workers import run_jobs

    student, shards = folder / "student", folder / SHARDS
    if not (folder / "done").exists():
        save_student(student, policy.network)
        shards.mkdir(parents=True, exist_ok=True)
        count = -(-cfg.distill.dagger_episodes // SHARD_EPISODES)
        each = replace(cfg.rollouts, episodes=-(-cfg.distill.dagger_episodes // count))
        jobs = [RoundJob(shard_job(cfg, inputs, i, shards), student, number) for i in range(count)]
        jobs = [replace(job, shard=replace(job.shard, rollouts=each)) for job in jobs]
        waiting = [job for job in jobs if not (folder / f"{job.shard.shard}.done").exists()]
        for job in waiting:
            shard_index(shards, job.shard.shard).unlink(missing_ok=True)  # finished, but that was not noted
        for done in run_jobs("wbm.learning.dagger", waiting, cfg.rollouts.workers):
            (folder / f"{done}.done").touch()
        (folder / "done").touch()
    return shard_paths(shards)

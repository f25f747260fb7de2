"""On-policy episodes for DAgger: the student of the moment acts, controller and teachers label what it met."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from wbm.artifacts.episodes import EpisodeWriter
from wbm.envs.collect import Recorder
from wbm.envs.relabel import RelabelDriver
from wbm.envs.rollout_config import NoiseConfig
from wbm.learning.rollouts import RolloutWorld, ShardJob
from wbm.learning.student import load_student

SEED_OFFSET = 1_000
"""Between the episodes of rounds, and from those of the rollouts."""


@dataclass(frozen=True)
class RoundJob:
    """One shard of a round; the result depends on nothing else.

    Attributes:
        shard: where and in which world; its `episodes` are made.
        student: folder of the student that acts.
        number: of the round, from 1.
    """

    shard: ShardJob
    student: Path
    number: int


_world: RolloutWorld | None = None


def work(job: RoundJob) -> int:
    """Make a shard; returns its number. All episodes are kept: what follows a mistake is what there is to learn."""
    global _world
    quiet = replace(job.shard.rollouts, pregrasp_share=0.0, noise=NoiseConfig(levels=(0.0,)))
    where = replace(job.shard, rollouts=quiet, seed=job.shard.seed + job.number * SEED_OFFSET)
    if _world is None or replace(_world.job, shard=where.shard) != where:
        _world = RolloutWorld(where)
    world = _world
    writer = EpisodeWriter(job.shard.folder, world.schema, job.shard.shard)
    recorder = Recorder(writer, world.describe, lambda record: True, world.env.period)
    driver = RelabelDriver(load_student(job.student, job.shard.device).act, world.teacher, world.env, world.schema)
    count = job.shard.rollouts.episodes
    world.runner.run(driver, job.shard.shard * count, count, recorder.on_frame, recorder.on_end)
    writer.close()
    return job.shard.shard

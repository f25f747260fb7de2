"""One shard of the dataset: whole-body episodes of controller and teachers, as the student would see them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from wbm.artifacts.episodes import EpisodeWriter
from wbm.envs.collect import Recorder, injected_noise, noise_level
from wbm.envs.episodes import EpisodeRunner, Record
from wbm.envs.perception import Perception
from wbm.envs.relabel import DemonstrationDriver
from wbm.envs.rollout_config import RolloutsConfig
from wbm.envs.world import GRASPS, WorldConfig, make_env, scene_rows, with_start
from wbm.learning.router import RoutedTeacher, load_suite
from wbm.robot.schema import PolicySchema
from wbm.scenes.assets import Assets, load_assets
from wbm.scenes.config import KINDS
from wbm.sensors.config import SensorsConfig
from wbm.sim.config import EVALUATE


@dataclass(frozen=True)
class ShardJob:
    """Everything that a process needs to make shard `shard`; the result depends on nothing else."""

    shard: int
    folder: Path
    assets: Path
    teachers: dict[str, Path]
    world: WorldConfig
    sensors: SensorsConfig
    rollouts: RolloutsConfig
    seed: int
    device: str = "cpu"


@dataclass
class ShardReport:
    """What came of a shard, for the stage's metrics.

    Attributes:
        kept: episodes written.
        reasons: episodes by reason.
        clean: successes and tries among episodes from the start pose without injected noise, by kind of scene.
    """

    shard: int
    kept: int
    reasons: dict[str, int]
    clean: dict[str, list[int]]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return dict(self.__dict__)


class RolloutWorld:
    """What does not change from shard to shard in a process: assets, environment, teachers, sensors."""

    def __init__(self, job: ShardJob) -> None:
        self.job = job
        self.assets: Assets = load_assets(job.assets)
        suite = load_suite(job.teachers, job.device)
        world = with_start(job.world, "whole_body", job.rollouts.pregrasp_share, job.rollouts.scatter_share)
        physics = EVALUATE if job.rollouts.physics == "evaluate" else world.sim
        world = replace(world, sim=replace(physics, engine=world.sim.engine, threads=1))
        rows = scene_rows(self.assets.scenes, "train", KINDS, tuple(g for g in GRASPS if g in suite))
        seed = job.seed + job.rollouts.seed_offset
        self.env = make_env(self.assets, world, rows, job.rollouts.num_envs, seed, job.device, grasps=tuple(suite))
        self.bank = self.env.binding.bank.select(self.env.binding.scenes)
        self.teacher = RoutedTeacher(suite, self.env)
        self.perception = Perception(
            self.env.robot,
            self.assets.objects,
            self.bank,
            job.sensors,
            PolicySchema(),
            job.rollouts.num_envs,
            seed,
            job.device,
        )
        self.schema = self.perception.schema
        self.noise = injected_noise(job.rollouts.noise, seed)
        texts = torch.as_tensor(self.assets.texts.embedding[self.bank.text[:, 0]], dtype=torch.float32)
        self.runner = EpisodeRunner(
            self.env,
            self.schema,
            self.bank.kind,
            self.bank.object[:, 0],
            self.perception,
            texts.to(job.device),
            self.noise,
            job.rollouts.noise.free,
        )

    def level(self, episode: int) -> float:
        """Factor of the noise injected into an episode."""
        seed = self.job.seed + self.job.rollouts.seed_offset
        return noise_level(self.job.rollouts.noise, seed, episode)

    def describe(self, record: Record) -> dict[str, Any]:
        """Fields of an episode besides its steps."""
        scene = record.scene_index
        rows = self.bank.text[scene, :1]
        texts = self.assets.texts
        return {
            "scene": f"{KINDS[record.kind]}/{int(self.env.binding.scenes[scene])}",
            "object": str(self.assets.objects.name[record.object_index]),
            "teacher": self.teacher.names().get(int(self.bank.approach[scene]), "none"),
            "noise": self.level(record.episode),
            "start": record.start,
            "success": record.success,
            "seed": record.episode,
            "instructions": [str(texts.sentence[r]) for r in rows],
            "text": np.asarray(texts.embedding[rows], dtype=np.float32),
        }


def collect_shard(world: RolloutWorld, shard: int) -> ShardReport:
    """Run the episodes of one shard and write those that are kept."""
    cfg = world.job.rollouts
    writer = EpisodeWriter(world.job.folder, world.schema, shard)
    clean: dict[str, list[int]] = {kind: [0, 0] for kind in KINDS}
    recorder = Recorder(writer, world.describe, lambda r: r.success or cfg.keep == "all", world.env.period)

    def on_end(env: int, record: Record) -> None:
        if record.start == "full" and world.level(record.episode) == 0.0:
            clean[KINDS[record.kind]][0] += int(record.success)
            clean[KINDS[record.kind]][1] += 1
        recorder.on_end(env, record)

    world.runner.run(DemonstrationDriver(world.teacher), shard * cfg.episodes, cfg.episodes, recorder.on_frame, on_end)
    writer.close()
    return ShardReport(shard, recorder.kept, dict(sorted(recorder.reasons.items())), clean)


def merge_reports(reports: list[ShardReport]) -> dict[str, Any]:
    """Totals over shards: tried, kept, by reason, and the unperturbed success rate overall and by kind."""
    reasons: Counter[str] = Counter()
    clean = np.zeros((len(KINDS), 2), dtype=int)
    for report in reports:
        reasons.update(report.reasons)
        clean += np.array([report.clean[kind] for kind in KINDS])
    total = clean.sum(0)
    return {
        "kept": sum(r.kept for r in reports),
        "tried": sum(reasons.values()),
        "clean_success": float(total[0] / total[1]) if total[1] else None,
        "reasons": dict(reasons.most_common()),
        "clean_by_scene": {k: [int(a), int(b)] for k, (a, b) in zip(KINDS, clean, strict=True)},
    }


_world: RolloutWorld | None = None


def work(job: ShardJob) -> ShardReport:
    """Make one shard; the process keeps its world for the next one."""
    global _world
    if _world is None or replace(_world.job, shard=job.shard) != job:
        _world = RolloutWorld(job)
    return collect_shard(_world, job.shard)

"""Blocks of evaluation episodes: a policy in closed loop on held-out scenes, with what it takes to film them later."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from wbm.artifacts.episodes import EpisodeWriter
from wbm.deploy.bundle import Bundle
from wbm.envs.collect import Recorder
from wbm.envs.episodes import Driver, EpisodeRunner, Frame, Record, StudentDriver, TeacherDriver
from wbm.envs.perception import Perception
from wbm.envs.relabel import DemonstrationDriver
from wbm.envs.world import GRASPS, WorldConfig, make_env, scene_rows, with_start
from wbm.learning.router import RoutedTeacher, load_suite
from wbm.learning.runtime_driver import RuntimeDriver
from wbm.learning.student import load_student
from wbm.robot.schema import PolicySchema
from wbm.scenes.assets import load_assets
from wbm.scenes.config import KINDS
from wbm.sensors.config import SensorsConfig
from wbm.sim.config import EVALUATE

POLICY_KINDS = ("student", "teacher", "bundle")
WITHHELD = {"both": (), "mask": ("text",), "text": ("depth_target",)}
"""Fields of the observation that a condition withholds."""


@dataclass(frozen=True)
class BlockJob:
    """Everything that episodes `first` to `first + count - 1` depend on.

    Attributes:
        kind: what `policy` holds, one of `POLICY_KINDS`. A bundle acts through its runtime, safety filter included.
        start: `whole_body`, or `local` at the pre-grasp.
        condition: what a student is given of its target: `both`, `mask` or `text`.
        record: episodes of lower number are also written as a dataset under `folder/episodes`.
    """

    first: int
    count: int
    folder: Path
    assets: Path
    policy: Path
    kind: str
    world: WorldConfig
    sensors: SensorsConfig
    split: str
    start: str
    condition: str
    num_envs: int
    record: int
    seed: int
    device: str = "cpu"


@dataclass
class BlockResult:
    """Records of a block; the trajectories lie in `folder/block-XXXXX.npz`, one array a quantity and episode."""

    first: int
    records: list[dict[str, Any]]


class EvaluationWorld:
    """Environment, sensors and policy of a process."""

    def __init__(self, job: BlockJob, watch: bool = False) -> None:
        """`watch` gives the sensors to a teacher too, which does without them."""
        self.job = job
        self.assets = load_assets(job.assets)
        suite = load_suite({job.policy.name: job.policy}, job.device) if job.kind == "teacher" else None
        grasps = tuple(suite) if suite else GRASPS
        # Scenes are played in the fine physics, whatever the policy was trained in.
        physics = replace(EVALUATE, engine=job.world.sim.engine, threads=1)
        world = with_start(replace(job.world, sim=physics), job.start)
        rows = scene_rows(self.assets.scenes, job.split, KINDS, grasps)
        self.env = make_env(self.assets, world, rows, job.num_envs, job.seed, job.device, grasps=tuple(suite or ()))
        self.bank = self.env.binding.bank.select(self.env.binding.scenes)
        phrasing = self.bank.text_held_out if job.split == "test" else self.bank.text
        self.sentence = phrasing[:, 0]
        perception, schema, texts = None, PolicySchema(), None
        if watch or job.kind != "teacher":
            perception = Perception(
                self.env.robot, self.assets.objects, self.bank, job.sensors, schema, job.num_envs, job.seed, job.device
            )
            schema = perception.schema
            texts = torch.as_tensor(self.assets.texts.embedding[self.sentence], dtype=torch.float32, device=job.device)
        self.schema = schema
        self.driver = self._driver(suite)
        self.runner = EpisodeRunner(self.env, schema, self.bank.kind, self.bank.object[:, 0], perception, texts)

    def _driver(self, suite: Any) -> Driver:
        job = self.job
        if job.kind == "teacher":
            teacher = RoutedTeacher(suite, self.env)
            return DemonstrationDriver(teacher) if job.start == "whole_body" else TeacherDriver(teacher)
        if job.kind == "bundle":
            bundle = Bundle.open(job.policy / "policy.wbm")
            self._check_schema(bundle.contract.schema)
            return RuntimeDriver(bundle, job.num_envs, WITHHELD[job.condition])
        student = load_student(job.policy, job.device)
        self._check_schema(student.schema)
        return StudentDriver(_conditioned(student.act, job.condition), self.env, self.schema)

    def _check_schema(self, schema: PolicySchema) -> None:
        if schema != self.schema:
            raise ValueError(
                f"the {self.job.kind} was trained on other observations than sensors.* gives now: set "
                f"sensors.depth_cloud.num_points={schema.num_depth_points} and "
                f"sensors.lidar_cloud.num_points={schema.num_lidar_points}"
            )

    def describe(self, record: Record) -> dict[str, Any]:
        """Fields of a recorded episode besides its steps."""
        row = self.sentence[record.scene_index : record.scene_index + 1]
        return {
            "scene": str(int(self.env.binding.scenes[record.scene_index])),
            "object": str(self.assets.objects.name[record.object_index]),
            "teacher": "none",
            "noise": 0.0,
            "start": record.start,
            "success": record.success,
            "seed": record.episode,
            "instructions": [str(self.assets.texts.sentence[r]) for r in row],
            "text": np.asarray(self.assets.texts.embedding[row], dtype=np.float32),
        }

    def row(self, record: Record) -> dict[str, Any]:
        """A record as the report reads it."""
        objects, scene = self.assets.objects, record.scene_index
        name, family = str(objects.name[record.object_index]), str(objects.family[record.object_index])
        return {
            **record.to_dict(),
            "seed": record.episode,
            # A folder of meshes without subfolders is no kind of object: there each is its own.
            "object": name if family == "mesh" else family,
            "object_name": name,
            "scene": KINDS[record.kind],
            "scene_row": int(self.env.binding.scenes[scene]),
            "instruction": str(self.assets.texts.sentence[self.sentence[scene]]),
            "reason": "" if record.success else record.reason,
            **self._refusals(record.episode),
        }

    def _refusals(self, episode: int) -> dict[str, Any]:
        """What a bundle's runtime refused in an episode, by name; nothing for other policies."""
        return {"refusals": dict(self.driver.refusals[episode])} if isinstance(self.driver, RuntimeDriver) else {}


def _conditioned(act: Any, condition: str) -> Any:
    """The policy with the target mask or the instruction withheld."""
    withheld = WITHHELD[condition]
    return lambda obs: act({name: value * 0 if name in withheld else value for name, value in obs.items()})


class _Tracks:
    """Joint positions and object poses of running episodes."""

    def __init__(self) -> None:
        self.rows: dict[int, list[tuple[np.ndarray, ...]]] = {}
        self.done: dict[str, np.ndarray] = {}

    def on_frame(self, frame: Frame) -> None:
        q, pose = frame.q.cpu().numpy(), frame.object_pose.cpu().numpy()
        phase, held = frame.phase.cpu().numpy(), frame.held.cpu().numpy()
        for e, number in enumerate(frame.episode.tolist()):
            self.rows.setdefault(number, []).append((q[e].copy(), pose[e].copy(), phase[e], held[e]))

    def finish(self, number: int) -> None:
        for name, values in zip(("q", "pose", "phase", "held"), zip(*self.rows.pop(number), strict=True), strict=True):
            self.done[f"{name}_{number}"] = np.stack(values)


def run_block(world: EvaluationWorld, job: BlockJob) -> BlockResult:
    """Play the episodes of one block; write their trajectories, and the recorded ones as a shard."""
    tracks = _Tracks()
    recorder = None
    if job.first < job.record and world.runner.perception:
        writer = EpisodeWriter(job.folder / "episodes", world.schema, 0)
        recorder = Recorder(writer, world.describe, lambda r: r.episode < job.record, world.env.period)

    def on_frame(frame: Frame) -> None:
        tracks.on_frame(frame)
        if recorder:
            recorder.on_frame(frame)

    def on_end(env: int, record: Record) -> None:
        tracks.finish(record.episode)
        if recorder:
            recorder.on_end(env, record)

    records = world.runner.run(world.driver, job.first, job.count, on_frame, on_end)
    if recorder:
        recorder.writer.close()
    np.savez_compressed(job.folder / f"block-{job.first:05d}.npz", **tracks.done)  # pyright: ignore[reportArgumentType]
    return BlockResult(job.first, [world.row(r) for r in records])


_world: EvaluationWorld | None = None


def work(job: BlockJob) -> BlockResult:
    """Play one block; the process keeps its world for the next one."""
    global _world
    if _world is None or replace(_world.job, first=job.first, count=job.count, record=job.record) != job:
        _world = EvaluationWorld(job)
    return run_block(_world, job)

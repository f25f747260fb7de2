"""The stage deploy-export on a small untrained student: the bundle opens, verifies, and is the same twice."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from stages import deploy_export
from stages.deploy_golden import EPISODES, golden_observations, recorded_episode
from wbm.artifacts.episodes import EpisodeWriter
from wbm.deploy.bundle import Bundle
from wbm.deploy.config import DeployConfig
from wbm.deploy.loop import run_loop
from wbm.deploy.probe import Probe
from wbm.deploy.runtime import PolicyRuntime
from wbm.robot.model import load_robot
from wbm.robot.schema import PolicySchema

SCHEMA = PolicySchema(num_depth_points=64, num_lidar_points=32)
STEPS = 30


@dataclass
class Draft:
    """What a stage writes into."""

    path: Path
    metrics: dict[str, Any] = field(default_factory=dict)


class Progress:
    """Counts what a stage reports."""

    def __init__(self) -> None:
        self.done = 0

    def task(self, name: str, total: int) -> Progress:
        return self

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def update(self, step: int) -> None:
        self.done += step


def record(folder: Path) -> dict[str, np.ndarray]:
    """One episode of noise, as an evaluation records it."""
    from wbm.learning.export import random_observation

    rng = np.random.default_rng(3)
    episode: dict[str, Any] = random_observation(SCHEMA, STEPS, seed=4)
    for name in ("depth_xyz", "lidar_xyz"):
        episode[name] = episode[name].astype(np.float16).astype(np.float32)  # as stored
    del episode["text"]
    text = rng.normal(size=(2, SCHEMA.text_dim)).astype(np.float32)
    flat = {"action": 32, "executed": 32, "p_obj_b": 3, "p_obj_w": 3, "base_pose": 3}
    episode |= {k: rng.normal(size=(STEPS, n)).astype(np.float32) for k, n in flat.items()}
    episode |= {"ee_distance": np.ones(STEPS, np.float32), "stamp": np.arange(STEPS, dtype=np.float32) / 25}
    episode |= {"phase": np.zeros(STEPS, np.uint8), "instructions": ["pick up the mug", "take the mug"], "text": text}
    facts = {
        "scene": "0",
        "object": "mug",
        "teacher": "top_down",
        "noise": 0.0,
        "start": "full",
        "success": True,
        "seed": 1,
    }
    writer = EpisodeWriter(folder, SCHEMA, 0)
    writer.add({**episode, **facts})
    writer.close()
    return {**episode, "text": np.tile(text[0], (STEPS, 1))}


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    torch = pytest.importorskip("torch")
    from wbm.learning.student import Student, save_student
    from wbm.learning.student_config import StudentConfig

    folder = tmp_path_factory.mktemp("export")
    torch.manual_seed(0)
    save_student(folder / "student", Student(SCHEMA, StudentConfig(width=32, layers=1, heads=2)))
    texts = SimpleNamespace(
        sentence=np.array(["pick up the mug", "lift the can"]),
        embedding=np.random.default_rng(0).normal(size=(2, SCHEMA.text_dim)).astype(np.float32),
    )
    episode = record(folder / "evaluation" / EPISODES)
    (folder / "empty").mkdir()
    return folder, texts, episode


def export(world, path: Path, monkeypatch, evaluation: str = "evaluation") -> Draft:
    folder, texts, _ = world
    from wbm.learning import export as exporter

    model = (
        exporter.export_onnx
        if not (folder / "policy.onnx").exists()
        else (lambda _: (folder / "policy.onnx").read_bytes())
    )
    monkeypatch.setattr("wbm.learning.export.export_onnx", model)  # eight seconds, once; its own tests repeat it
    monkeypatch.setattr("wbm.scenes.assets.load_assets", lambda path: SimpleNamespace(texts=texts, robot=load_robot()))
    manifests = {
        s: SimpleNamespace(name="main", ref=f"{s}/main/0", content_digest="d", metrics={}) for s in deploy_export.INPUTS
    }
    places = {"student": "student", "assets": "student", "evaluation": evaluation}
    inputs = {slot: SimpleNamespace(path=folder / place, manifest=manifests[slot]) for slot, place in places.items()}
    path.mkdir()
    draft, progress = Draft(path), Progress()
    deploy_export.run(SimpleNamespace(deploy=DeployConfig()), inputs, draft, progress)
    assert progress.done == 3
    return draft


@pytest.mark.slow
def test_export_opens_verifies_and_repeats(world, tmp_path, monkeypatch):
    folder, texts, episode = world
    draft = export(world, tmp_path / "a", monkeypatch)
    bundle = Bundle.open(draft.path / "policy.wbm")
    (folder / "policy.onnx").write_bytes(bundle.member("policy.onnx"))
    assert bundle.verify()["parity"] <= 1e-5 and draft.metrics["parity_rollout"] <= 1e-5
    assert set(bundle.instructions.sentences) == set(texts.sentence)
    assert set(bundle.provenance) == {"student", "assets", "evaluation"}
    golden = bundle.golden[0]
    np.testing.assert_array_equal(golden["proprio"][0], episode["proprio"][0])
    np.testing.assert_array_equal(golden["text"][0], episode["text"][0])
    assert not golden["depth_valid"][-1].any()  # an edge case: empty clouds
    report = run_loop(Probe(bundle.contract), PolicyRuntime(bundle, "lift the can"), 20)
    assert report.steps + sum(report.refusals.values()) == 20
    again = export(world, tmp_path / "b", monkeypatch)
    assert (again.path / "policy.wbm").read_bytes() == (draft.path / "policy.wbm").read_bytes()


def test_evaluations_without_episodes_will_do(world, tmp_path):
    folder, _, _episode = world
    assert recorded_episode(SCHEMA, folder / "empty") is None
    golden = golden_observations(SCHEMA, folder / "empty", 5)
    SCHEMA.check(golden)
    assert not golden["depth_valid"][-1].any() and golden["depth_valid"][:-1].any()

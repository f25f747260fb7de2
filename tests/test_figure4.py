"""The ablation: equal budgets, exact resume, honest pooling, a plan that can be shared, and pictures of it."""

from __future__ import annotations

import hashlib
import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from browser import chromium, page_of

from stages import commands_figure4 as commands
from stages import plan as planning
from stages.commands import composer
from stages.convert import ConfigError
from stages.pipeline import StageError
from tests.env_world import scenes
from wbm.artifacts.store import Store
from wbm.control.config import WbcConfig
from wbm.envs.config import ActionConfig, EnvConfig
from wbm.envs.world import WorldConfig
from wbm.learning.config import PpoConfig
from wbm.learning.figure4 import run_settings, run_world, train_run
from wbm.learning.figure4_config import ARMS, Figure4Config
from wbm.report.figure4 import Run, gather, write_figure4
from wbm.report.stats import wilson
from wbm.robot.config import MjcfOptions
from wbm.robot.model import load_robot
from wbm.sim.config import SimConfig

TINY = Figure4Config(
    env_steps=40,
    num_envs=4,
    supports=("table",),
    evaluations=1,
    eval_episodes=2,
    episodes=3,
    eval_envs=2,
    reach_far=0.5,
)
PPO = PpoConfig(steps=5, epochs=1, minibatches=2, hidden=(16, 8))
CASES = {
    "full": ActionConfig(),
    "no_active_vision": ActionConfig(neck="fixed"),
    "joint_space": ActionConfig(term="joint"),
}


class Killed(Exception):
    pass


def tiny_run(arm: str, folder: Path, stop_after: int = 99):
    _, bank = scenes()
    split = np.where(np.arange(len(bank)) % 2 == 0, "train", "test")
    split_bank = replace(bank, split=split)
    assets = SimpleNamespace(objects=scenes()[0].objects, scenes=split_bank, robot=load_robot())
    env = EnvConfig(action=CASES[arm], episode_s=1.2, approach_s=0.6, starts_per_scene=1)
    world = run_world(WorldConfig(MjcfOptions(), SimConfig(), WbcConfig(), env), TINY)

    def report(progress) -> None:
        if progress.iteration == stop_after:
            raise Killed

    return train_run(assets, world, TINY, PPO, folder / "out", folder / "scratch", 3, report)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("arm", ARMS)
def test_a_run_that_is_killed_ends_as_if_it_had_not_been(arm, tmp_path) -> None:
    torch.set_num_threads(1)
    records, trained = tiny_run(arm, tmp_path / "whole")
    assert trained["env_steps"] == TINY.env_steps and len(records) == TINY.episodes
    assert [r["episode"] for r in records] == [0, 1, 2]
    assert all(r["target_visible"] is None or 0 <= r["target_visible"] <= 1 for r in records)
    if arm == "full":
        with pytest.raises(Killed):
            tiny_run(arm, tmp_path / "cut", stop_after=1)
        torch.rand(10)
        again, _ = tiny_run(arm, tmp_path / "cut")
        assert again == records
        for name in ("policy.safetensors", "curve.json", "records.json"):
            one, two = ((tmp_path / d / "out" / name).read_bytes() for d in ("whole", "cut"))
            assert hashlib.sha256(one).digest() == hashlib.sha256(two).digest(), name


def test_every_arm_has_the_same_budget() -> None:
    ppo = PpoConfig()
    budgets = {run_settings(replace(Figure4Config(), arm=arm), ppo).iterations for arm in ARMS}
    assert budgets == {-(-1_000_000 // (128 * ppo.steps))}
    settings = run_settings(Figure4Config(), ppo)
    assert settings.patience == 0 and settings.target > 1, "no arm may stop early"


@pytest.fixture
def store(tmp_path) -> Store:
    return Store.open(tmp_path / "store")


def lines(store: Store, *more: str) -> list[str]:
    return [f"artifacts.root={store.backend.work}", *more]


def test_the_plan_names_every_run_once(store) -> None:
    sweep = commands.build(lines(store), store)
    assert list(sweep.runs) == [f"rl/{arm}/{seed}" for seed in range(3) for arm in ARMS]
    envs = {name: node.config.env.action for name, node in sweep.runs.items()}
    assert envs["rl/full/0"].term == envs["rl/no_active_vision/0"].term == "wbc"
    assert (envs["rl/no_active_vision/2"].neck, envs["rl/joint_space/1"].term) == ("fixed", "joint")
    # A run's identity does not depend on how many runs there are.
    more = commands.build(lines(store, "figure4.seeds=5", "figure4.arms=[full]"), store)
    assert more.runs["rl/full/2"].sections == sweep.runs["rl/full/2"].sections
    assert more.runs["rl/full/1"].sections != more.runs["rl/full/2"].sections
    for node in sweep.runs.values():
        assert node.sections["figure4"]["env_steps"] == 1_000_000


def test_both_readings_share_what_they_can(store) -> None:
    sweep = commands.build(lines(store, "figure4.reading=both", "figure4.seeds=1"), store)
    refs = [node.ref for node in sweep.nodes]
    assert len(refs) == len(set(refs))
    assert sweep.runs["student/full"].ref == "evaluation/main"
    made = {node.ref: sorted(node.upstream) for node in sweep.nodes}
    assert made["rollouts/no_active_vision"] == ["assets", "teacher/side", "teacher/top_down"]
    assert made["rollouts/joint_space"] == ["assets", "teacher/figure4_joint_space_0"]
    assert sweep.runs["student/joint_space"].upstream["policy"].upstream["rollouts"].config.rollouts.keep == "all"
    order = {ref: i for i, ref in enumerate(refs)}
    for node in sweep.nodes:
        assert all(order[up.ref] < order[node.ref] for up in node.upstream.values())


@pytest.mark.parametrize("line", ["env=full", "figure4.seed=1", "policy=student/main"])
def test_what_the_sweep_sets_cannot_be_set(line, store) -> None:
    with pytest.raises(ConfigError, match="leave it out"):
        commands.build(lines(store, line), store)


def test_the_command_runs_what_is_missing_and_leaves_the_rest(store, monkeypatch, capsys) -> None:
    """With stand-ins for the stages: a run in other hands is skipped, a failed one does not stop the others."""
    ran: list[str] = []

    def stand_in(node, store, progress, force=False):
        if node.ref == "teacher/figure4_full_0" and "full" in trouble:
            raise StageError("no luck")
        draft = store.begin(node.manifest())
        ran.append(node.ref)
        draft.metrics["success_rate"] = 0.5
        (draft.path / "figure4.json").write_text(json.dumps({"readings": []}))
        (draft.scratch / "progress.json").write_text(json.dumps({"iteration": 1, "iterations": 2, "success": 0.1}))
        if node.ref in trouble:
            draft.keep()
            raise StageError("stopped")
        node.done = draft.publish().manifest

    monkeypatch.setattr(commands, "run_node", stand_in)
    settings = lines(store, "figure4.seeds=1")
    trouble = {"full", "teacher/figure4_joint_space_0"}
    sweep = commands.build(settings, store)
    planning.plan(sweep.nodes, store)
    with pytest.raises(StageError, match="2 failed"):
        commands.figure4_command(settings)
    assert ran == ["assets/procedural", "teacher/figure4_no_active_vision_0", "teacher/figure4_joint_space_0"]
    commands.figure4_plan(settings, as_json=True)
    entries = {e["artifact"].split("/")[1]: e for e in json.loads(capsys.readouterr().out)["runs"]}
    assert entries["figure4_no_active_vision_0"]["state"] == "done"
    assert entries["figure4_joint_space_0"] | {"stage": 0} == entries["figure4_joint_space_0"] | {
        "stage": 0, "state": "started", "iteration": 1, "iterations": 2,
    }  # fmt: skip
    assert entries["figure4_full_0"]["state"] == "to do"

    sweep = commands.build(settings, store)
    planning.plan(sweep.nodes, store)
    held = store.begin(sweep.runs["rl/full/0"].manifest())  # another process has it
    trouble.clear()
    ran.clear()
    with pytest.raises(StageError, match="being made by another process"):
        commands.figure4_command(settings)
    assert ran == ["teacher/figure4_joint_space_0"] or ran[-1] == "teacher/figure4_joint_space_0"
    held.keep()
    capsys.readouterr()
    commands.figure4_command(settings, as_json=True)
    assert json.loads(capsys.readouterr().out)["artifact"].startswith("evaluation/figure4/")
    with pytest.raises(Exception) as stop:
        commands.figure4_plan([*settings, "figure4.seeds=2"], check=True)
    assert getattr(stop.value, "exit_code", None) == 3


def made_up(seed: int = 0) -> list[Run]:
    rng = np.random.default_rng(seed)
    runs = []
    for arm, wins, top in (("full", 45, 0.03), ("no_active_vision", 35, 0.02), ("joint_space", 4, 0.006)):
        for k in range(3):
            reward = top * (1 - np.exp(-np.arange(240) / 60)) + rng.normal(0, 0.001, 240)
            curve = {"env_steps": [4096 * (i + 1) for i in range(240)], "reward": reward.tolist()}
            curve["success"] = [None if i < 5 else float(wins / 50) for i in range(240)]
            records = [
                {
                    "success": i < wins, "reason": "" if i < wins else "timeout", "object": "can", "scene": "table",
                    "collision": False, "target_visible": 0.9 if arm == "full" else 0.6,
                    "time_to_grasp_s": 4.0 if i < wins else None,
                }
                for i in range(50)
            ]  # fmt: skip
            runs.append(Run("rl", arm, k, records, curve))
    return runs


def test_numbers_are_pooled_over_seeds() -> None:
    figure = gather(made_up())
    (reading,) = figure["readings"]
    assert [a["key"] for a in reading["arms"]] == list(ARMS)
    full, fixed, joint = reading["arms"]
    assert full["episodes"] == 150 and full["success_ci95"] == list(wilson(135, 150))
    assert [a["paper"] for a in reading["arms"]] == [1.0, 0.8, 0.2]
    assert len(full["runs"]) == 3 and full["runs"][2]["seed"] == 2 and full["runs"][0]["env_steps"] == 4096 * 240
    assert len(full["curve"]["values"]) == 3 and len(full["curve"]["steps"]) <= 80
    assert full["curve"]["steps"][-1] == 4096 * 240
    runs = made_up()
    first = np.mean(runs[0].curve["reward"][:3])
    assert full["curve"]["values"][0][0] == pytest.approx(first, abs=1e-6)
    assert joint["failures"] == {"timeout": 138} and fixed["target_visible"] == pytest.approx(0.6)
    said = " ".join(reading["verdict"])
    assert "the intervals are apart" in said and "keeps it in view" in said


def test_another_order_is_reported_as_it_is() -> None:
    runs = made_up()
    worse = [replace(r, records=[{**x, "success": False, "reason": "timeout"} for x in r.records]) if r.arm == "full"
             else r for r in runs]  # fmt: skip
    assert "not the order that the paper reports" in " ".join(gather(worse)["readings"][0]["verdict"])
    alike = [replace(r, records=[{**x, "success": False, "reason": "timeout"} for x in r.records]) for r in runs]
    assert "not the order that the paper reports" in " ".join(gather(alike)["readings"][0]["verdict"]), "a tie is none"


def test_pictures_and_page(tmp_path) -> None:
    students = [replace(r, reading="student", seed=0, curve=None) for r in made_up() if r.seed == 0]
    figure = gather([*made_up(), *students])
    write_figure4(tmp_path, figure, {"seed": 0}, {"rl/full/0": "teacher/figure4_full_0/abc"})
    for name in ("figure4.svg", "figure4-student.svg"):
        svg = (tmp_path / name).read_text()
        root = ET.fromstring(svg)
        assert "var(" not in svg and "background:#fff" in root.attrib["style"], name
    assert "reward a step" in (tmp_path / "figure4.svg").read_text()
    assert (tmp_path / "figure4.png").read_bytes()[:4] == b"\x89PNG"
    numbers = json.loads((tmp_path / "figure4.json").read_text())
    assert [r["key"] for r in numbers["readings"]] == ["rl", "student"]
    again = tmp_path / "again"
    again.mkdir()
    write_figure4(again, figure, {"seed": 0}, {"rl/full/0": "teacher/figure4_full_0/abc"})
    for path in again.iterdir():
        assert path.read_bytes() == (tmp_path / path.name).read_bytes(), path.name


@pytest.mark.browser
def test_the_page_in_a_browser(tmp_path) -> None:
    write_figure4(tmp_path, gather(made_up()), {"seed": 0}, {"rl/full/0": "teacher/figure4_full_0/abc"})
    with chromium() as browser:
        for width, scheme in ((1200, "light"), (390, "dark")):
            with page_of(browser, width, scheme=scheme) as (page, troubles):
                page.goto((tmp_path / "report.html").as_uri())
                page.wait_for_load_state("load")
                facts = page.evaluate(
                    """() => ({ overflow: document.documentElement.scrollWidth - window.innerWidth,
                    plots: [...document.querySelectorAll('svg')].map(s => s.getBoundingClientRect().width),
                    ids: [...document.querySelectorAll('[id]')].map(e => e.id),
                    links: [...document.querySelectorAll('nav a')].map(
                        a => !!document.querySelector(a.getAttribute('href'))) })"""
                )
                assert facts["overflow"] <= 0 and not troubles
                assert len(facts["plots"]) == 3 and all(w > 200 for w in facts["plots"])
                assert all(facts["links"]) and len(facts["ids"]) == len(set(facts["ids"]))


def test_settings_are_checked() -> None:
    for bad in ({"reading": "both_of_them"}, {"arms": ("full", "full")}, {"arms": ()}, {"seeds": 0}, {"reach_far": -1}):
        with pytest.raises(ValueError, match=r"figure4\."):
            Figure4Config(**bad)
    assert composer(["profile=smoke"]).figure4.arms == ARMS

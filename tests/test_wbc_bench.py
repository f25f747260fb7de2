"""The controller's benchmark: its keys, that both peers see the same problem, and clear words where one is missing."""

import importlib.util

import numpy as np
import pytest

from stages.bench import _arguments, _known
from stages.bench import bench as run_bench
from stages.convert import ConfigError
from wbm.control import bench
from wbm.control.bench_mink import _Problem
from wbm.control.course import NUM_OBSTACLES, PLANE, make_course
from wbm.control.wbc import WholeBodyController
from wbm.robot.joints import WBC
from wbm.robot.model import load_robot

POSITION = 2e-5  # m, float32 over a chain of 20 links


def test_a_small_run_reports_every_key(monkeypatch):
    monkeypatch.setattr(bench, "OBSTACLES", (0, 16))
    monkeypatch.setattr(bench, "EPISODE", 20)
    out = bench.bench_wbc(steps=160, sizes=(1, 8), envs=8, samples=8, peers=False)
    assert set(out["us_per_env"]) == {"1", "8"} and set(out["us_per_env_by_joints"]) == {"3", "9", "10", "16"}
    assert out["steps_qp"] == 160 and out["limit_violations"] == 0 and out["nan"] == 0
    assert out["spheres"] >= 35 and out["obstacles"] == 16 and out["self_pairs"] >= 100
    for key in ("collisions_paper", "collisions_qp", "gaze_deg_p99", "static_exact_share", "deepest_penetration_mm_qp"):
        assert np.isfinite(out[key])


def test_programs_agree_with_daqp_on_the_course():
    pytest.importorskip("qpsolvers")
    pytest.importorskip("mink")
    out = bench.exactness(50, True, num_envs=8)
    assert out["programs_compared"] >= 50 and out["programs_with_active_dampers"] > 0
    assert out["qdot_error_p99"] < 1e-3
    assert out["mink_without_solution"] == 0


def test_mink_is_given_the_same_robot_and_pairs():
    pytest.importorskip("mink")
    c = WholeBodyController(load_robot(), 2, NUM_OBSTACLES)
    course = make_course(2, 3)
    problem = _Problem(c, course, 1)
    q = np.tile(c.robot.q_home, (2, 1)) + 0.05
    problem.configuration.update(q[1, WBC])
    c.q.assign(q.astype(np.float32))
    c.forward_kinematics()
    for name in ("ee", "camera"):
        where = c.frame_pos.numpy()[1, c.frame_names.index(name)]
        assert np.abs(problem.configuration.data.site(name).xpos - where).max() < POSITION
    rolling = 16 * len(c.spheres) - problem.pairs[0]
    floors = int((course.type[1] == PLANE).sum())
    assert problem.pairs[1] == len(c.pairs)
    assert floors == 1 and 0 < rolling < len(c.spheres)  # what only the base moves is not kept off the floor


def test_a_missing_peer_is_named(monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "mink" else found(name))
    with pytest.raises(RuntimeError, match="mink is not installed"):
        bench.bench_wbc(steps=1)


def test_settings_become_arguments():
    known = _known(bench.bench_wbc)
    assert _arguments("wbc", known, ["steps=1000000", "peers=false"]) == {"steps": 1_000_000, "peers": False}
    for setting, words in (("steps=many", "whole number"), ("peers=1", "true")):
        with pytest.raises(ConfigError, match=words):
            _arguments("wbc", known, [setting])
    with pytest.raises(ConfigError, match="unknown key 'stpes'"):
        run_bench("wbc", ["stpes=1"], as_json=True)

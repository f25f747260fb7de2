"""The runtime: exact limits, right frames, and 10,000 injected faults of which none reaches the driver."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import textwrap
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from deploy_synthetic import SCHEMA, SENTENCES, FakeRobot, forward, make_bundle, weights
from hypothesis import given, settings
from hypothesis import strategies as st

from wbm.deploy.bundle import Bundle
from wbm.deploy.config import DeployConfig
from wbm.deploy.driver import DriverInfo
from wbm.deploy.faults import BundleError, Fault, Refused
from wbm.deploy.kinematics import Kinematics
from wbm.deploy.loop import measure_latency, run_loop
from wbm.deploy.runtime import PolicyRuntime
from wbm.deploy.safety import SafetyFilter, brake_velocity
from wbm.robot.model import frame_poses, load_robot
from wbm.robot.schema import PROPRIO_LABELS, to_increment

FAULTS = int(os.environ.get("WBM_FAULTS", "720"))  # 10000 for the full campaign


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return Bundle.open(make_bundle(tmp_path_factory.mktemp("bundle") / "policy.wbm"))


def test_frames_agree_with_the_robot_model(bundle):
    robot, kinematics = load_robot(), Kinematics(bundle.contract)
    rng = np.random.default_rng(0)
    for _ in range(20):
        q = rng.uniform(robot.q_min, robot.q_max)
        ours, reference = kinematics.frames(q), frame_poses(robot, q)
        for name, (rot, pos) in ours.items():
            np.testing.assert_allclose(rot, reference[name][0], atol=1e-12)
            np.testing.assert_allclose(pos, reference[name][1], atol=1e-12)


def test_observation_is_in_the_base_frame(bundle):
    """A fixed point in the world must keep its place relative to the base, wherever camera, base and clock are."""
    robot, runtime, driver = load_robot(), PolicyRuntime(bundle), FakeRobot()
    driver.q[:3] = (0.4, -0.3, 0.7)
    reading = driver.read()
    point_w = np.array([1.1, 0.2, 0.6])
    now_q = reading.q.copy()
    then_q = now_q.copy()
    then_q[[0, 2, 26, 30]] += (0.004, 0.01, 0.02, -0.02)
    history = replace(reading, q=then_q, stamps={k: 10.0 for k in reading.stamps})
    runtime.step(replace(history, qd=(now_q - then_q) / 0.04), 10.0)
    rot_c, pos_c = frame_poses(robot, then_q)["camera"]
    point_c = (point_w - pos_c) @ rot_c
    cloud = np.tile(point_c, (SCHEMA.num_depth_points, 1)).astype(np.float32)
    stamps = {"joints": 10.04, "depth": 10.0, "lidar": 10.04}
    runtime.step(replace(reading, depth_xyz=cloud, stamps=stamps, qd=(now_q - then_q) / 0.04), 10.045)
    rot_b, pos_b = frame_poses(robot, now_q)["base"]
    expected = (point_w - pos_b) @ rot_b
    np.testing.assert_allclose(runtime.observation["depth_xyz"][0], expected, atol=1e-5)
    proprio = dict(zip(PROPRIO_LABELS, runtime.observation["proprio"], strict=True))
    assert proprio["q/arm_joint2"] == pytest.approx(now_q[4])
    c, s = np.cos(0.7), np.sin(0.7)
    velocity = (now_q - then_q)[:2] / 0.04
    assert proprio["qd/base_vx"] == pytest.approx(c * velocity[0] + s * velocity[1], abs=1e-6)


def test_action_holds_the_action_before(bundle):
    runtime, driver = PolicyRuntime(bundle, SENTENCES[0]), FakeRobot()
    previous = np.zeros(32, dtype=np.float32)
    for _ in range(5):
        command = runtime.step(driver.read(), driver.now())
        np.testing.assert_array_equal(runtime.observation["prev_action"], previous)
        expected = forward({k: v[None] for k, v in runtime.observation.items()}, weights())[0]
        np.testing.assert_allclose(command.action, expected, atol=1e-5)
        previous = to_increment(np, driver.q, command.q_target, SCHEMA.action).astype(np.float32)
        driver.command(command)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), wild=st.sampled_from([0.1, 3.0, 1e6]))
def test_limits_hold_exactly_and_together(bundle, seed, wild):
    c, rng = bundle.contract, np.random.default_rng(seed)
    safety, driver = SafetyFilter(c), FakeRobot()
    driver.q = rng.uniform(c.q_min, c.q_max)
    safety.check(driver.read(), driver.now())
    q, v = driver.q, np.zeros(32)
    for k in range(60):
        wish = rng.normal(size=32) * wild if k % 20 else np.where(rng.random(32) < 0.5, c.q_min, c.q_max)
        target, velocity = safety.limit(wish)
        # 1e-9: rounding of q + v dt
        assert (target >= c.q_min).all() and (target <= c.q_max).all()
        assert (np.abs(target - q) <= c.qd_max * c.dt + 1e-9).all()
        assert (np.abs((target - q) / c.dt - v) <= c.qdd_max * c.dt + 1e-9).all()
        q, v = target, velocity


def test_reachable_targets_are_not_touched(bundle):
    c, safety, driver = bundle.contract, SafetyFilter(bundle.contract), FakeRobot()
    safety.check(driver.read(), driver.now())
    wish = driver.q + 0.5 * np.minimum(c.qdd_max * c.dt**2, 1e-3) * np.sign((c.q_min + c.q_max) / 2 - driver.q)
    np.testing.assert_allclose(safety.limit(wish)[0], wish, atol=1e-12)


@given(st.floats(0, 10), st.floats(0.1, 200), st.floats(0.005, 0.1))
def test_brake_velocity_stops_just_before_the_limit(distance, acceleration, dt):
    v = float(brake_velocity(np.array(distance), np.array(acceleration), dt))
    travelled, speed = 0.0, v
    while speed > 0:
        travelled += speed * dt
        speed -= acceleration * dt
    assert travelled <= distance + 1e-9 * (1 + distance)
    assert travelled >= distance - 1e-6 * (1 + distance)


def _fresh(reading, **changes):
    return replace(reading, **{k: v for k, v in changes.items()})


def _poke(array, rng, value):
    result = array.astype(np.float64) if array.dtype.kind != "f" else array.copy()
    result[tuple(rng.integers(n) for n in array.shape)] = value
    return result


ARRAYS = ("q", "qd", "depth_xyz", "depth_rgb", "depth_valid", "depth_target", "lidar_xyz", "lidar_valid")
CONTINUOUS = ("q", "qd", "depth_xyz", "lidar_xyz")


def inject(kind, reading, contract, rng):
    """A reading with one fault, and the names under which it may be refused."""
    if kind == "nan":
        name = CONTINUOUS[rng.integers(4)]
        value = (np.nan, np.inf, -np.inf)[rng.integers(3)]
        return _fresh(reading, **{name: _poke(getattr(reading, name), rng, value)}), {Fault.NOT_FINITE}
    if kind == "stale":
        sensor = ("joints", "depth", "lidar")[rng.integers(3)]
        stamps = reading.stamps | {sensor: reading.stamps[sensor] - rng.uniform(0.3, 100)}
        return _fresh(reading, stamps=stamps), {Fault.STALE}
    if kind == "future":
        sensor = ("joints", "depth", "lidar")[rng.integers(3)]
        return _fresh(reading, stamps=reading.stamps | {sensor: reading.stamps[sensor] + rng.uniform(0.2, 100)}), {
            Fault.FUTURE_STAMP
        }
    if kind == "repeated":
        return _fresh(reading, stamps=reading.stamps | {"joints": reading.stamps["joints"] - 0.04}), {
            Fault.NOT_ADVANCING
        }
    if kind == "dropped":
        name = (*ARRAYS, "stamps", "joint_names")[rng.integers(10)]
        return _fresh(reading, **{name: None}), {Fault.DROPPED}
    if kind == "order":
        order = rng.permutation(32)
        while (order == np.arange(32)).all():
            order = rng.permutation(32)
        names = tuple(reading.joint_names[i] for i in order)
        return _fresh(reading, joint_names=names, q=reading.q[order], qd=reading.qd[order]), {Fault.WRONG_ORDER}
    if kind == "silent order":  # values permuted while the driver says nothing of it
        arm = np.arange(32)
        arm[3:10] = np.roll(arm[3:10], 1 + rng.integers(6))
        return _fresh(reading, q=reading.q[arm], qd=reading.qd[arm]), {Fault.OUT_OF_LIMITS, Fault.INCONSISTENT}
    if kind == "degrees":
        return _fresh(reading, q=np.degrees(reading.q)), {Fault.UNITS, Fault.OUT_OF_LIMITS, Fault.INCONSISTENT}
    if kind == "radians of radians":
        return _fresh(reading, q=np.radians(reading.q)), {Fault.OUT_OF_LIMITS, Fault.INCONSISTENT}
    if kind == "millimetres":
        name = ("depth_xyz", "lidar_xyz")[rng.integers(2)]
        return _fresh(reading, **{name: getattr(reading, name) * 1000}), {Fault.UNITS}
    if kind == "kilometres":
        name = ("depth_xyz", "lidar_xyz")[rng.integers(2)]
        return _fresh(reading, **{name: getattr(reading, name) / 1000}), {Fault.UNITS}
    if kind == "degrees a second":
        qd = np.degrees(np.where(np.abs(reading.qd) < 0.1, 0.1, reading.qd))
        return _fresh(reading, qd=qd), {Fault.VELOCITY, Fault.INCONSISTENT}
    if kind == "limit":
        i, sign = rng.integers(32), rng.choice([-1, 1])
        bound = contract.q_max if sign > 0 else contract.q_min
        q = reading.q.copy()
        q[i] = bound[i] + sign * rng.uniform(0.06, 3)
        return _fresh(reading, q=q), {Fault.OUT_OF_LIMITS, Fault.UNITS}
    if kind == "shape":
        name = ARRAYS[rng.integers(8)]
        array = getattr(reading, name)
        wrong = (array[:-1], array[None], array.ravel()[:3], np.concatenate([array, array]))[rng.integers(4)]
        return _fresh(reading, **{name: wrong}), {Fault.WRONG_SHAPE}
    if kind == "type":
        name = ARRAYS[rng.integers(8)]
        array = getattr(reading, name)
        wrong = (array.astype(object), array.astype(str), array.tolist(), "text")[rng.integers(4)]
        return _fresh(reading, **{name: wrong}), {Fault.WRONG_TYPE}
    if kind == "flags":
        name = ("depth_valid", "depth_target", "lidar_valid")[rng.integers(3)]
        return _fresh(reading, **{name: _poke(getattr(reading, name), rng, rng.integers(2, 255))}), {Fault.WRONG_TYPE}
    if kind == "jump":
        q = reading.q.copy()
        i = rng.integers(3, 10)
        middle = (contract.q_min[i] + contract.q_max[i]) / 2
        q[i] = q[i] + np.sign(middle - q[i]) * rng.uniform(0.4, 0.6)
        return _fresh(reading, q=q), {Fault.INCONSISTENT}
    q = reading.q.copy()
    q[rng.integers(2)] += rng.choice([-1, 1]) * rng.uniform(5.5, 9)
    return _fresh(reading, q=q), {Fault.WORKSPACE, Fault.INCONSISTENT, Fault.OUT_OF_LIMITS}


KINDS = (
    "nan", "stale", "future", "repeated", "dropped", "order", "silent order", "degrees", "radians of radians",
    "millimetres", "kilometres", "degrees a second", "limit", "shape", "type", "flags", "jump", "workspace",
)  # fmt: skip


def test_injected_faults_are_refused_by_name(bundle):
    rng, runtime, driver = np.random.default_rng(11), PolicyRuntime(bundle), FakeRobot()
    counts: Counter[str] = Counter()
    driver.command(runtime.step(driver.read(), driver.now()))
    for i in range(FAULTS):
        kind = KINDS[i % len(KINDS)]
        if i % 6 == 0:  # good readings between the bad ones: a refusal must not spoil what follows
            driver.command(runtime.step(driver.read(), driver.now()))
        good = driver.read()
        bad, names = inject(kind, good, bundle.contract, rng)
        before = runtime.safety._q_cmd.copy()
        with pytest.raises(Refused) as caught:
            driver.command(runtime.step(bad, driver.now()))
        assert caught.value.fault in names, (kind, str(caught.value))
        np.testing.assert_array_equal(runtime.safety._q_cmd, before)
        driver.command(runtime.step(good, driver.now()))
        counts[kind] += 1
    assert sum(counts.values()) == FAULTS and len(counts) == len(KINDS)
    assert len(driver.commands) == 1 + FAULTS + -(-FAULTS // 6)


def test_damaged_bundles_are_refused_by_name(bundle, tmp_path):
    raw, rng, path = bundle.path.read_bytes(), np.random.default_rng(5), tmp_path / "x.wbm"
    damaged = {Fault.CHECKSUM, Fault.TRUNCATED, Fault.BUNDLE_VERSION, Fault.NOT_A_BUNDLE}
    counts: Counter[Fault] = Counter()
    for i in range(FAULTS // 10):
        data, names = bytearray(raw), damaged
        if i % 3 == 0:
            data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        elif i % 3 == 1:
            del data[rng.integers(len(data)) :]
            names = {Fault.TRUNCATED, Fault.NOT_A_BUNDLE}
        else:
            version = b"wbm-bundle/%d" % rng.choice([0, *range(2, 10)])
            data = data.replace(b"wbm-bundle/1", version)
            names = {Fault.BUNDLE_VERSION}
        path.write_bytes(data)
        with pytest.raises(BundleError) as caught:
            Bundle.open(path)
        assert caught.value.fault in names
        counts[caught.value.fault] += 1
    assert counts.total() == FAULTS // 10 and counts[Fault.BUNDLE_VERSION] >= FAULTS // 30


def test_network_without_an_answer_is_refused(tmp_path, bundle, monkeypatch):
    runtime, driver = PolicyRuntime(bundle), FakeRobot()
    monkeypatch.setattr(runtime, "_policy", lambda observation: np.full((1, 32), np.nan))
    with pytest.raises(Refused) as caught:
        runtime.step(driver.read(), driver.now())
    assert caught.value.fault is Fault.POLICY_OUTPUT


def test_targets_stay_in_the_workspace(tmp_path):
    path = make_bundle(tmp_path / "p.wbm", contract=_contract(DeployConfig(reach_m=0.3)))
    runtime, driver = PolicyRuntime(Bundle.open(path)), FakeRobot()
    with pytest.raises(Refused) as caught:
        runtime.step(driver.read(), driver.now())
    assert caught.value.fault is Fault.WORKSPACE


def _contract(cfg):
    from wbm.deploy.contract import make_contract

    return make_contract(load_robot(), SCHEMA, cfg)


class _Faulty(FakeRobot):
    """Every third reading is bad."""

    def read(self):
        reading = super().read()
        self.count = getattr(self, "count", 0) + 1
        return replace(reading, q=np.full(32, np.nan)) if self.count % 3 == 0 else reading


def test_the_loop_holds_on_every_refusal(bundle):
    driver = _Faulty()
    report = run_loop(driver, PolicyRuntime(bundle), 30)
    assert report.refusals == {"not-finite": 10}
    assert report.steps == len(driver.commands) == 20
    assert driver.holds == ["not-finite"] * 10 + ["end of run"]
    assert all(np.isfinite(c.q_target).all() for c in driver.commands)


def test_the_loop_stops_after_many_refusals(bundle):
    driver = FakeRobot()
    driver.q[6] = 1.0  # the elbow beyond its limit
    report = run_loop(driver, PolicyRuntime(bundle), 100, max_refusals=5)
    assert report.stopped_by == "out-of-limits" and not driver.commands and len(driver.holds) == 6


@pytest.mark.parametrize(
    "change",
    [{"joint_names": ("x",) * 32}, {"units": {"angle": "deg"}}, {"camera_frame": "base"}, {"rate_hz": 100.0}],
    ids=str,
)
def test_drivers_must_agree_with_the_contract(bundle, change):
    driver = FakeRobot()
    info = replace(driver.info, **change)
    assert isinstance(info, DriverInfo)
    driver_class = type("Other", (FakeRobot,), {"info": property(lambda self: info)})
    driver = driver_class()
    with pytest.raises(Refused) as caught:
        run_loop(driver, PolicyRuntime(bundle), 3)
    assert caught.value.fault is Fault.DRIVER_MISMATCH and not driver.commands


def test_latency_is_measured(bundle):
    figures = measure_latency(PolicyRuntime(bundle), FakeRobot(), steps=40, warmup=5)
    assert 0 < figures["cpu_p50_s"] <= figures["cpu_p99_s"]
    assert 0 < figures["wall_p50_s"] <= figures["wall_p99_s"]


def test_imports_nothing_but_numpy_and_onnxruntime(bundle):
    """The runtime on a machine where only NumPy and onnxruntime can be imported beside the standard library."""
    script = textwrap.dedent(
        f"""
        import sys
        class Guard:
            banned = {{"torch", "mujoco", "warp", "yaml", "zarr", "scipy", "hydra", "trimesh", "mcap", "foxglove",
                       "matplotlib", "cryptography", "onnx", "typer"}}
            def find_spec(self, name, path=None, target=None):
                if name.split(".")[0] in self.banned:
                    raise ImportError(name + " is not on the robot")
        sys.meta_path.insert(0, Guard())
        import numpy as np
        from wbm.deploy.bundle import Bundle
        from wbm.deploy.driver import Reading
        from wbm.deploy.loop import run_loop
        from wbm.deploy.runtime import PolicyRuntime
        bundle = Bundle.open({str(bundle.path)!r})
        bundle.verify()
        c, s = bundle.contract, bundle.contract.schema
        p, m = s.num_depth_points, s.num_lidar_points
        ones = lambda n: np.ones(n, np.uint8)
        reading = Reading(dict(joints=1.0, depth=1.0, lidar=1.0), c.joint_names, c.q_home, np.zeros(32),
                          np.ones((p, 3), np.float32), np.zeros((p, 3), np.uint8), ones(p), ones(p),
                          np.ones((m, 3), np.float32), ones(m))
        print(PolicyRuntime(bundle, {SENTENCES[0]!r}).step(reading, 1.01).q_target.sum())
        from wbm.deploy.__main__ import main
        sys.argv = ["wbm.deploy", "soak", {str(bundle.path)!r}, "--minutes", "0.004"]
        assert main() in (0, 1)  # 1: a busy machine misses deadlines
        extra = {{n.split(".")[0] for n in sys.modules}} & Guard.banned
        assert not extra, extra
        """
    )
    root = Path(__file__).resolve().parent.parent
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(root)},
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    target, _, answer = done.stdout.partition("\n")
    assert np.isfinite(float(target)) and json.loads(answer)["periods"] == 6

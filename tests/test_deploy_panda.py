"""The Panda's stream: limits always, and a real libfranka client against a server that enforces them."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from deploy_synthetic import SCHEMA, FakeRobot, make_bundle
from hypothesis import given, settings
from hypothesis import strategies as st

from wbm.deploy.bundle import Bundle
from wbm.deploy.config import DeployConfig
from wbm.deploy.contract import make_contract
from wbm.deploy.faults import Fault, Refused
from wbm.deploy.loop import run_loop
from wbm.deploy.panda import PandaArm, PandaDriver
from wbm.deploy.panda_stream import CYCLE, SMOOTHING_S, Follower
from wbm.deploy.runtime import PolicyRuntime
from wbm.robot import joints
from wbm.robot.model import RobotModel, load_robot
from wbm.robot.schema import PROPRIO_LABELS

ROOT = Path(__file__).resolve().parent.parent
START = np.array([0.0, 0.0, 0.0, -1.57, 0.0, 1.57, 0.785])  # where the server's arm stands
ATTEMPTS = 5
LEAD_IN, REST = 75, 25  # steps from START to the first pose of the episode, and at its last
PYTHON = Path(os.environ.get("WBM_FRANKA_PYTHON", ROOT / ".venv-franka" / "bin" / "python"))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.02, 0.3, 5.0]))
def test_stream_keeps_every_limit_whatever_comes(seed, wild):
    rng = np.random.default_rng(seed)
    envelope = (0.2, 2.585) if seed % 2 else None
    joint = Follower(0.1, -1.0, 1.2, 2.175, 9.5, 0.04, envelope)
    out, next_command = [joint.out] * 3, 0
    for k in range(1200):
        if k == next_command:  # early, late and missing commands
            joint.aim(float(rng.normal() * wild))
            next_command = k + int(rng.integers(5, 120))
        out.append(joint.step())
    q = np.array(out)
    v, a = np.diff(q) / CYCLE, np.diff(q, 2) / CYCLE**2
    jerk = np.diff(q, 3) / CYCLE**3
    assert q.min() >= -1.0 and q.max() <= 1.2
    # rounding of differences: 1e-16 / 1e-3^n
    assert np.abs(v).max() <= 2.175 + 1e-9
    if envelope is not None:
        offset, deceleration = envelope
        assert (v <= np.maximum(0.0, np.sqrt(2 * deceleration * (1.2 - q[1:])) - offset) + 1e-9).all()
        assert (-v <= np.maximum(0.0, np.sqrt(2 * deceleration * (q[1:] + 1.0)) - offset) + 1e-9).all()
    assert np.abs(a).max() <= 9.5 + 1e-6
    assert np.abs(jerk).max() <= 2 * 9.5 / SMOOTHING_S + 1e-3 < 5000


def test_stream_follows_a_smooth_path_and_rests():
    joint = Follower(0.0, -3.0, 3.0, 2.175, 9.5, 0.04)
    path = lambda t: 0.4 * np.sin(2 * np.pi * 0.4 * t)
    gaps = []
    for k in range(5000):
        if k % 40 == 0:
            joint.aim(float(path((k + 40) * CYCLE)))
        value = joint.step()
        if k > 600:  # it starts from rest while the path already moves
            gaps.append(value - path(k * CYCLE))
    assert np.abs(gaps).max() < 0.015  # 10 ms of filter at 1 rad/s, and the cut corners of the reference
    for _ in range(1500):
        joint.step()
    assert joint.resting


def test_no_arm_is_refused_by_name(tmp_path):
    fake = tmp_path / "python"
    fake.write_text('#!/bin/sh\necho \'{"error": "Connection\\\\nrefused", "kind": "disconnected"}\'\n')
    fake.chmod(0o755)
    with pytest.raises(Refused, match="Connection refused") as caught:
        PandaArm("127.0.0.1", make_contract(load_robot(), SCHEMA, DeployConfig()), fake)
    assert caught.value.fault is Fault.DISCONNECTED


def test_a_reflex_is_refused_by_name(tmp_path):
    state = '{"t": 1e9, "q": [0,0,0,0,0,0,0], "qd": [0,0,0,0,0,0,0], "rate": 1}'
    fake = tmp_path / "python"
    fake.write_text(f'#!/bin/sh\necho \'{state}\'\nread line\necho \'{{"error": "reflex!", "kind": "reflex"}}\'\n')
    fake.chmod(0o755)
    arm = PandaArm("127.0.0.1", make_contract(load_robot(), SCHEMA, DeployConfig()), fake)
    arm.command(np.zeros(7))
    with pytest.raises(Refused) as caught:
        for _ in range(200):
            arm.state()
            time.sleep(0.02)
    assert caught.value.fault is Fault.REFLEX
    arm.close()


def arm_mjcf(robot: RobotModel) -> str:
    """The arm of our model for the server, under the names that it expects."""

    def text(values) -> str:
        return " ".join(f"{v:.17g}" for v in np.ravel(values))

    def body(i: int) -> str:
        name, inertial = robot.link_names[i].removeprefix("arm_"), robot.inertials[i]
        parts = [f'<body name="fr3_{name}" pos="{text(robot.link_pos[i])}" quat="{text(robot.link_quat[i])}">']
        if inertial is not None:
            m = inertial.inertia
            full = text([m[0, 0], m[1, 1], m[2, 2], m[0, 1], m[0, 2], m[1, 2]])
            parts.append(f'<inertial mass="{inertial.mass}" pos="{text(inertial.com)}" fullinertia="{full}"/>')
        if (j := robot.joint_index[i]) >= 0:
            span, name = text([robot.q_min[j], robot.q_max[j]]), robot.joint_names[j].removeprefix("arm_")
            parts.append(
                f'<joint name="fr3_{name}" axis="{text(robot.joint_axis[i])}" range="{span}" '
                f'armature="{robot.armature[j]}" damping="{robot.damping[j]}"/>'
            )
        children = [k for k in np.flatnonzero(robot.parent == i) if robot.link_names[k].startswith("arm_link")]
        return "".join([*parts, *(body(k) for k in children), "</body>"])

    return f'<mujoco><compiler angle="radian"/><worldbody>{body(robot.link("arm_link0"))}</worldbody></mujoco>'


def _hurry() -> None:
    """The server must keep 1 kHz beside whatever else runs here; on a single core its physics would starve at FIFO."""
    with suppress(PermissionError):
        if len(os.sched_getaffinity(0)) > 1:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
        else:
            os.nice(-15)


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    if not PYTHON.exists():
        pytest.skip(f"needs franka-sim and pylibfranka in {PYTHON.parent.parent}; see docs/deploy.md")
    folder = tmp_path_factory.mktemp("franka")
    (folder / "arm.xml").write_text(arm_mjcf(load_robot()))
    environment = {**os.environ, "FR3_MJCF": str(folder / "arm.xml"), "HOME": str(folder), "PYTHONPATH": ""}
    with open(folder / "server.log", "w") as log:
        process = subprocess.Popen(
            [PYTHON, "-m", "franka_sim.run_server", "--no-gripper", "--enforce-motion-limits"],
            env=environment, stdout=log, stderr=subprocess.STDOUT, start_new_session=True, preexec_fn=_hurry,
        )  # fmt: skip
    try:
        probe = [PYTHON, "-c", "import pylibfranka as f; f.Robot('127.0.0.1', f.RealtimeConfig.kIgnore).read_once()"]
        for _ in range(30):
            if process.poll() is not None:
                pytest.fail((folder / "server.log").read_text()[-1500:])
            if subprocess.run(probe, capture_output=True, timeout=60).returncode == 0:
                break
            time.sleep(1)
        yield folder / "server.log"
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            process.kill()


class RestOfRobot(FakeRobot):
    """Everything but the arm, on the real clock at 25 Hz."""

    def __init__(self) -> None:
        super().__init__()
        self._due = time.monotonic()

    def now(self) -> float:
        return time.monotonic()

    def read(self):
        self._due += self.dt
        time.sleep(max(0.0, self._due - time.monotonic()))
        reading = super().read()
        now = time.monotonic()
        return replace(reading, stamps=dict.fromkeys(reading.stamps, now))


class Recorded:
    """In a network's place: the arm's joints of a recorded rollout, after a smooth way there from `START`.

    `arm_episode.npy` holds the seven arm columns of `proprio` of one smoke-profile rollout, 25 steps a second.
    """

    def __init__(self) -> None:
        episode = np.load(ROOT / "tests" / "data" / "arm_episode.npy").astype(np.float64)
        share = (1 - np.cos(np.linspace(0, np.pi, LEAD_IN)))[:, None] / 2
        lead_in, rest = START + share * (episode[0] - START), np.repeat(episode[-1:], REST, axis=0)
        self.path = np.concatenate([lead_in, episode, rest])
        self.step = 0
        self._columns = [PROPRIO_LABELS.index(f"q/{joints.JOINT_NAMES[i]}") for i in range(32)[joints.ARM]]

    def __call__(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        action = np.zeros((1, 32), np.float32)
        wish = self.path[min(self.step, len(self.path) - 1)] - observation["proprio"][0, self._columns]
        action[0, joints.ARM] = wish / np.array(SCHEMA.action.scale)[joints.ARM]
        self.step += 1
        return action


@pytest.mark.slow
def test_arm_follows_a_recorded_episode_without_a_reflex(server, tmp_path):
    """A rollout's arm through the safety filter to a server that aborts on any broken motion limit."""
    robot = load_robot()
    robot = replace(robot, q_home=np.r_[robot.q_home[:3], START, robot.q_home[10:]])
    # On a busy machine the server falls behind real time: its arm then moves less than its velocity says.
    contract = make_contract(robot, SCHEMA, DeployConfig(max_age_joints_s=0.3, consistency=0.3))
    bundle = Bundle.open(make_bundle(tmp_path / "p.wbm", contract=contract))
    for _ in range(ATTEMPTS):
        if _follow(contract, bundle):
            break
        server.write_text("")
    else:
        pytest.skip("this machine is too busy for a 1 kHz cycle: commands came late in every attempt")
    assert "violation" not in server.read_text() and "discontinuity" not in server.read_text()


def _follow(contract, bundle) -> bool:
    """Play the episode on the arm; False when the arm stopped because commands came late, which says nothing of us."""
    rest, recorded, runtime = RestOfRobot(), Recorded(), PolicyRuntime(bundle)
    runtime._policy = recorded
    arm = PandaArm("127.0.0.1", contract, PYTHON, model="fr3")
    try:
        start = arm.state().q
        recorded.path[:LEAD_IN] += (start - START) * np.linspace(1, 0, LEAD_IN)[
            :, None
        ]  # where it stands after a retry
        report = run_loop(PandaDriver(arm, rest), runtime, len(recorded.path))
        if report.refusals and arm.worst_success_rate < 1.0:
            return False
        assert not report.refusals and report.steps == len(recorded.path), report.refusals
        aimed = rest.commands[-1].q_target[joints.ARM]
        for _ in range(100):
            time.sleep(0.1)
            if np.abs(arm.state().q - aimed).max() < 0.05:
                break
        else:
            if arm.worst_success_rate < 1.0:  # the server's physics is far behind its clock
                return False
        np.testing.assert_allclose(arm.state().q, aimed, atol=0.05)  # the server's servo has a finite stiffness
        np.testing.assert_allclose(aimed, recorded.path[-1], atol=0.05)
        return True
    except Refused as refused:
        if arm.worst_success_rate < 1.0:
            return False
        raise AssertionError("the arm refused though every command came in time") from refused
    finally:
        arm.close()

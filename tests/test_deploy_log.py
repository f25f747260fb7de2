"""Logs: bounded loss on kill, replay against another bundle."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from deploy_synthetic import SENTENCES, FakeRobot, make_bundle
from mcap.reader import make_reader

from wbm.deploy.bundle import Bundle
from wbm.deploy.faults import Fault, Refused
from wbm.deploy.log import RunLog, decode_arrays, encode_arrays, read_messages, recover, replay
from wbm.deploy.loop import run_loop
from wbm.deploy.runtime import PolicyRuntime

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("log")
    bundle = Bundle.open(make_bundle(folder / "policy.wbm"))
    driver, runtime = FakeRobot(), PolicyRuntime(bundle, SENTENCES[1])
    with RunLog(folder / "run.mcap") as log:
        run_loop(driver, runtime, 40, log)
        log.refusal(driver.now(), Refused(Fault.STALE, "joints are old"))
        log.note(driver.now(), "done")
    return folder, driver


def test_log_holds_what_was_commanded(run):
    folder, driver = run
    assert not (folder / "run.mcap.partial").exists()
    actions = list(read_messages(folder / "run.mcap", "/policy/action"))
    assert len(actions) == 40
    for (stamp, data), command in zip(actions, driver.commands, strict=True):
        assert stamp == pytest.approx(command.stamp, abs=1e-6)
        np.testing.assert_array_equal(data["q_target"], command.q_target)
    lines = [d for _, d in read_messages(folder / "run.mcap", "/log")]
    assert [line["name"] for line in lines] == ["stale", "runtime"]
    with open(folder / "run.mcap", "rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary.statistics.message_count == 40 * 3 + 2
    assert {s.name for s in summary.schemas.values()} >= {"foxglove.JointStates", "foxglove.Log"}


def test_replay_against_bundles(run):
    folder, _ = run
    assert replay(folder / "run.mcap", Bundle.open(folder / "policy.wbm"))["max_difference"] == 0.0
    other = Bundle.open(make_bundle(folder / "other.wbm", seed=3))
    answer = replay(folder / "run.mcap", other)
    assert answer["steps"] == 40 and answer["max_difference"] > 0.01


def test_arrays_survive_bit_for_bit():
    rng = np.random.default_rng(0)
    arrays = {
        "a": rng.normal(size=(3, 4)).astype(np.float32),
        "b": rng.integers(0, 255, 7, dtype=np.uint8),
        "c": np.float64([np.nan, -0.0]),
    }
    back = decode_arrays(encode_arrays(arrays))
    assert list(back) == list(arrays)
    for key, value in arrays.items():
        assert back[key].dtype == value.dtype and back[key].tobytes() == value.tobytes()
    with pytest.raises(ValueError):
        decode_arrays(encode_arrays(arrays)[:-1])


def test_a_killed_process_loses_little(tmp_path):
    """Messages are counted on standard output as they are logged; at most a flush interval of them may be missing."""
    script = f"""
import sys, time
sys.path[:0] = [{str(ROOT)!r}, {str(ROOT / "tests")!r}]
from wbm.deploy.log import RunLog
log = RunLog({str(tmp_path / "run.mcap")!r}, flush_s=0.05)
for i in range(100000):
    log.note(i * 0.001, "message " + "x" * 200)
    print(i, flush=True)
    time.sleep(0.001)
"""
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    for line in process.stdout:
        if int(line) >= 600:
            os.kill(process.pid, signal.SIGKILL)
            break
    written = 601 + len(process.stdout.readlines())
    process.wait(timeout=20)
    partial = tmp_path / "run.mcap.partial"
    with open(partial, "ab") as stream:
        stream.write(b"\x05\xff\x00")  # a record that the kill cut in two
    saved = recover(partial, tmp_path / "run.mcap")
    # 50 messages of 1 ms fit into one interval; a busy machine only slows the writer
    assert written - 120 <= saved <= written + 1
    assert sum(1 for _ in read_messages(tmp_path / "run.mcap", "/log")) == saved
    assert not partial.exists()

"""Worker processes: results do not depend on their number, and none outlives the process that started it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from wbm.learning.workers import run_jobs

PARENT = """
import sys
from wbm.learning.workers import run_jobs
if __name__ == "__main__":
    for answer in run_jobs("worker_jobs", {jobs}, 2):
        print(answer, flush=True)
"""
JOBS = """
import multiprocessing, os, time
def work(job):
    global kept
    what, seconds = job
    time.sleep(seconds)
    if what == "lock":
        kept = multiprocessing.get_context("spawn").Lock()
    return os.getpid() if what == "pid" else None
"""


def start(folder, jobs="[('pid', 0), ('sleep', 600)]", **env):
    (folder / "worker_jobs.py").write_text(JOBS)
    (folder / "parent.py").write_text(PARENT.format(jobs=jobs))
    paths = os.pathsep.join([str(folder), str(Path(__file__).parent.parent)])
    return subprocess.Popen(
        [sys.executable, folder / "parent.py"],
        env={**os.environ, "PYTHONPATH": paths, **env},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's help is Linux's")
def test_workers_die_with_a_parent_that_was_killed(tmp_path):
    # Whoever is killed cannot give back the pool's semaphores; that the tracker says so is no news here.
    parent = start(tmp_path, PYTHONWARNINGS="ignore:resource_tracker")
    worker = int(parent.stdout.readline())
    children = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()
    assert str(worker) in children
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    end = time.monotonic() + 30
    while any(running(pid) for pid in children):
        assert time.monotonic() < end, "a worker outlived its parent"
        time.sleep(0.05)


def test_workers_give_back_what_they_held(tmp_path):
    """A library may keep a semaphore for the life of its process: the resource tracker must find none left."""
    _, complaint = start(tmp_path, "[('lock', 0), ('lock', 0)]").communicate()
    assert complaint == b""


def test_no_jobs_start_no_process():
    assert list(run_jobs("no_such_module", [], 4)) == []

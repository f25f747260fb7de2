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
    for answer in run_jobs("worker_jobs", [("pid", 0), ("sleep", 600)], 2):
        print(answer, flush=True)
"""
JOBS = """
import os, time
def work(job):
    what, seconds = job
    time.sleep(seconds)
    return os.getpid() if what == "pid" else None
"""


def running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's help is Linux's")
def test_workers_die_with_a_parent_that_was_killed(tmp_path):
    (tmp_path / "worker_jobs.py").write_text(JOBS)
    (tmp_path / "parent.py").write_text(PARENT)
    paths = os.pathsep.join([str(tmp_path), str(Path(__file__).parent.parent)])
    parent = subprocess.Popen(
        [sys.executable, tmp_path / "parent.py"], env={**os.environ, "PYTHONPATH": paths}, stdout=subprocess.PIPE
    )
    worker = int(parent.stdout.readline())
    children = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()
    assert str(worker) in children
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    end = time.monotonic() + 30
    while any(running(pid) for pid in children):
        assert time.monotonic() < end, "a worker outlived its parent"
        time.sleep(0.05)


def test_no_jobs_start_no_process():
    assert list(run_jobs("no_such_module", [], 4)) == []

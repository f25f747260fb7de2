"""Kills and power cuts over the six real stages: the short version of `python tests/chaos_real.py --kills 1000`."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_blows_to_the_real_stages_lose_nothing():
    kills = "1000" if os.environ.get("WBM_FULL") else "6"
    command = [sys.executable, Path(__file__).with_name("chaos_real.py"), "--kills", kills, "--seeds", "1"]
    done = subprocess.run(command, env={**os.environ, "OMP_NUM_THREADS": "1"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    assert f"{kills} kills" in done.stdout and "\n0 problems" in done.stdout

"""Every `wbm` command that the README prints works; `make setup` and `make run` are continuous integration's."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import mujoco
import pytest

ROOT = Path(__file__).parents[1]
BLOCKS = re.findall(r"```bash\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
LINES = [line for block in BLOCKS for line in block.splitlines() if line.startswith(".venv/bin/wbm")]


def wbm(arguments: list[str], folder: Path) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "stages.cli", *arguments],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


def test_the_readme_prints_commands():
    assert len(LINES) >= 5


@pytest.mark.parametrize("line", LINES)
def test_a_command_of_the_readme_works(line, tmp_path):
    result = wbm(shlex.split(line)[1:], tmp_path)
    assert result.returncode == 0, result.stderr


def test_the_exported_robot_is_the_robot(tmp_path):
    assert wbm(["robot", "export", "robot.xml"], tmp_path).returncode == 0
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    assert (model.nu, model.nv) == (32, 32)
    shown = wbm(["robot", "show"], tmp_path)
    assert shown.returncode == 0 and "arm_joint7" in shown.stdout


def test_a_bundle_that_is_none_is_refused_in_one_line(tmp_path):
    (tmp_path / "x.wbm").write_bytes(b"nothing")
    result = wbm(["bundle", "verify", "x.wbm"], tmp_path)
    assert result.returncode == 1
    assert len(result.stderr.strip().splitlines()) <= 2 and "Traceback" not in result.stderr

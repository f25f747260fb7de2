"""Every command that README and docs print works as printed, page by page, from top to bottom.

A page's ```bash blocks are run in a copy of a small store, smoke sized; `make setup` and `make run` are continuous
integration's. A command that needs more than this machine stands in an indented block instead.
"""

import os
import re
import shutil
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import mujoco
import pytest
from conftest import SMALL

from wbm.envs.config import RandomizationConfig, Range, RewardConfig
from wbm.envs.outcome import REASONS, TIMEOUT
from wbm.envs.rewards import TERMS

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^```bash\n(.*?)^```", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\(([^)#:]+)(?:#[^)]*)?\)")
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMAND = re.compile(r"^(\.venv/bin/)?wbm ")


def commands(page: Path) -> list[str]:
    """Lines of the page's bash blocks, continued lines joined, without comments and make."""
    lines = "\n".join(BLOCK.findall(page.read_text())).replace("\\\n", " ").splitlines()
    return [line.strip() for line in lines if line.strip() and not line.lstrip().startswith(("#", "make "))]


# tests/test_extending.py runs extending.md, whose commands need a folder of meshes.
WITH_COMMANDS = [page for page in PAGES if commands(page) and page.name != "extending.md"]


@pytest.fixture
def sandbox(small_store, tmp_path) -> Path:
    """A checkout to play in: the repository's files by link, a store of its own, and `wbm` on the path."""
    for item in ROOT.iterdir():
        if item.name not in ("artifacts", "build", "dist") and not item.name.startswith("."):
            (tmp_path / item.name).symlink_to(item)
    shutil.copytree(small_store, tmp_path / "artifacts", symlinks=True)
    binaries = tmp_path / ".venv" / "bin"
    binaries.mkdir(parents=True)
    (binaries / "wbm").write_text(f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} -m stages.cli "$@"\n')
    (binaries / "wbm").chmod(0o755)
    return tmp_path


def run(line: str, folder: Path) -> subprocess.CompletedProcess:
    paths = os.pathsep.join([str(folder / ".venv" / "bin"), str(Path(sys.executable).parent), os.environ["PATH"]])
    # The page's settings first: the small ones only make the same run shorter.
    text = f"{line} {' '.join(SMALL[1:])}" if COMMAND.match(line) and "profile=smoke" in line else line
    return subprocess.run(
        ["bash", "-c", text],
        capture_output=True,
        text=True,
        timeout=300,
        cwd=folder,
        env={**os.environ, "PATH": paths, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
    )


def test_the_pages_print_commands():
    assert {"README.md", "deploy.md"} <= {page.name for page in WITH_COMMANDS}
    assert sum(len(commands(page)) for page in WITH_COMMANDS) >= 10


@pytest.mark.slow
@pytest.mark.pipeline
@pytest.mark.parametrize("page", WITH_COMMANDS, ids=lambda page: page.name)
def test_the_commands_of_a_page_work(page, sandbox):
    for line in commands(page):
        result = run(line, sandbox)
        assert result.returncode == 0, f"{page.name}: {line}\n{result.stdout[-1000:]}\n{result.stderr[-2000:]}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    missing = [target for target in LINK.findall(page.read_text()) if not (page.parent / target).exists()]
    assert missing == []


def test_a_page_is_read_in_five_minutes():
    """1,400 words at 280 a minute. Tables are looked up, and the log is not read from top to bottom."""
    text = lambda page: [line for line in page.read_text().splitlines() if not line.startswith("|")]
    words = {page.name: sum(len(line.split()) for line in text(page)) for page in PAGES if page.name != "log.md"}
    assert {name: count for name, count in words.items() if count > 1400} == {}


def test_the_exported_robot_is_the_robot(tmp_path):
    cli = [sys.executable, "-m", "stages.cli", "robot"]
    there = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run([*cli, "export", "robot.xml"], cwd=tmp_path, env=there, check=True, capture_output=True)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    assert (model.nu, model.nv) == (32, 32)
    shown = subprocess.run([*cli, "show"], cwd=tmp_path, env=there, check=True, capture_output=True, text=True)
    assert "arm_joint7" in shown.stdout


def rows(page: str, header: str) -> dict[str, list[str]]:
    """Cells of the table below a header row, by the code word in the first column."""
    table = (ROOT / "docs" / page).read_text().split(header)[1].split("\n\n")[0]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]
    return {first.strip("`"): rest for first, *rest in cells}


def test_the_teachers_page_tells_the_values_that_are_used():
    reward, draws = RewardConfig(), RandomizationConfig()
    weights = {name: float(cells[0]) for name, cells in rows("teachers.md", "| term | weight | pays for |").items()}
    assert tuple(weights) == TERMS
    assert {name: abs(value) for name, value in weights.items()} == {name: getattr(reward, name) for name in TERMS}
    ranges = rows("teachers.md", "| setting | low | high | unit |")
    found = {name: (float(low), float(high)) for name, (low, high, _) in ranges.items()}
    known = [(f.name, getattr(draws, f.name)) for f in fields(draws)]
    assert found == {name: (value.low, value.high) for name, value in known if isinstance(value, Range)}
    assert set(rows("teachers.md", "| reason | when |")) == set(REASONS[TIMEOUT:])

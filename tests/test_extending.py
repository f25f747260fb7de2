"""Every command and every piece of code in docs/extending.md works."""

import re
import shlex
from pathlib import Path

import pytest
import trimesh

from stages.cli import main
from wbm.scenes.families import FAMILIES

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "extending.md").read_text()
COMMANDS = [line for block in re.findall(r"```bash\n(.*?)```", TEXT, re.DOTALL) for line in block.splitlines()]
CODE = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)


def test_every_part_shows_something():
    for part in TEXT.split("\n## ")[1:]:
        assert "```" in part, part.splitlines()[0]
    assert len(COMMANDS) == 5 and len(CODE) == 4


@pytest.mark.parametrize("line", COMMANDS)
def test_commands(line, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WBM_CACHE", str(tmp_path / "cache"))
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    (tmp_path / "meshes" / "toys").mkdir(parents=True)
    for i in range(12):
        box = trimesh.creation.box((5.0 + 0.1 * i, 6.0, 9.0))
        box.export(tmp_path / "meshes" / "toys" / f"red_car_{i}.obj")
    program, *arguments = shlex.split(line)
    assert program == "wbm"
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 0, capsys.readouterr().err


@pytest.mark.parametrize("number", range(len(CODE)))
def test_code(number, monkeypatch):
    known = dict(FAMILIES)
    try:
        exec(compile(CODE[number], f"extending.md, block {number}", "exec"), {"__name__": "extending"})
    finally:
        FAMILIES.clear()
        FAMILIES.update(known)

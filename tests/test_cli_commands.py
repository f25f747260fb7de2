"""Every command: settings are checked, `--json` is one document, the store's commands do what they say."""

import io
import json
from contextlib import redirect_stderr, redirect_stdout

import pytest
from toy.register import install
from typer.main import get_command

from stages import plan, registry
from stages.cli import app, main

ARGUMENTS = {"bench": ["sensors"], "completion": ["bash"], "view": ["robot"], "artifacts push": ["elsewhere"],
             "artifacts pull": ["elsewhere"], "bundle replay": ["log", "x.wbm"], "robot export": ["x.xml"],
             "jobs logs": ["1"], "jobs cancel": ["1"], "bundle show": ["x.wbm"], "bundle verify": ["x.wbm"],
             "bundle soak": ["x.wbm"]}  # fmt: skip


def commands(command=None, path=()):
    command = command or get_command(app)
    if not hasattr(command, "commands"):
        return {" ".join(path): command}
    found = {}
    for name, below in command.commands.items():
        found |= commands(below, (*path, name))
    return found


def wbm(*arguments):
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as stop:
        main(list(arguments))
    return stop.value.code, out.getvalue(), err.getvalue()


@pytest.fixture
def root(tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "MODULES", {})
    monkeypatch.setattr(plan, "_code", plan._code)
    monkeypatch.setattr("stages.pipeline.git_state", lambda: {"commit": "c0ffee", "dirty": False, "patch": ""})
    install()
    return [f"artifacts.root={tmp_path / 'store'}", f"artifacts.reference={tmp_path / 'reference'}"]


@pytest.mark.parametrize("name", sorted(set(commands()) - {"completion"}))
def test_every_command_takes_settings_and_names_a_wrong_one(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = wbm(*name.split(), *ARGUMENTS.get(name, []), f"artifacts.root={tmp_path}", "sed=1")
    assert (code, out) == (2, ""), err
    assert "unknown key 'sed'; did you mean 'seed'?" in err


@pytest.mark.parametrize("name", sorted(commands()))
def test_every_command_explains_itself(name):
    code, out, _ = wbm(*name.split(), "--help")
    assert code == 0 and f"wbm {name}" in out


def test_json_is_one_document_for_each_command_of_the_store(root, tmp_path):
    elsewhere = str(tmp_path / "elsewhere")
    lines = [
        ("run",), ("plan",), ("run", "-m", "seed=1,2"), ("distill",), ("run", "--cfg"),
        ("artifacts", "ls"), ("artifacts", "ls", "student"), ("artifacts", "show", "student/main"),
        ("artifacts", "why", "assets/main"), ("artifacts", "diff", "assets/main", "student/main"),
        ("repro-diff", "assets/main", "assets/main"), ("artifacts", "verify"), ("artifacts", "pin", "assets/main"),
        ("artifacts", "gc"), ("artifacts", "push", elsewhere), ("artifacts", "pull", elsewhere),
        ("artifacts", "publish", "student/main"), ("artifacts", "ls", "reference"),
        ("artifacts", "show", "reference/student"), ("artifacts", "rm", "evaluation/main"), ("jobs", "ls"),
    ]  # fmt: skip
    for line in lines:
        code, out, err = wbm(*line, "--json", *root)
        assert code == 0, (line, err)
        json.loads(out)


def test_gc_lists_first_and_deletes_when_told(root):
    for seed in (1, 2):
        assert wbm("prepare-assets", f"seed={seed}", *root)[0] == 0
    names = lambda: [row["artifact"] for row in json.loads(wbm("artifacts", "ls", "--json", *root)[1])]
    (old,) = json.loads(wbm("artifacts", "gc", "--json", "--grace", "0", *root)[1])["artifacts"]
    code, out, _ = wbm("artifacts", "gc", "--grace", "0", *root)
    assert code == 0 and f"would delete {old}" in out and "add --delete" in out
    assert len(names()) == 2, "nothing is gone yet"
    assert f"deleted {old}" in wbm("artifacts", "gc", "--delete", "--grace", "0", *root)[1]
    assert len(names()) == 1 and old not in names()
    assert wbm("artifacts", "verify", *root)[0] == 0

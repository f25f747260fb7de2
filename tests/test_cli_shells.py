"""Completion as a user has it: keys typed into bash, zsh and fish on a terminal, the script loaded as documented."""

import os
import pty
import re
import select
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from stages import completion

REPOSITORY = Path(__file__).resolve().parent.parent
SHELLS = {
    "bash": (["bash", "--norc", "--noprofile", "-i"], "bind 'set enable-bracketed-paste off'"),
    "zsh": (["zsh", "-f", "-i"], "bindkey -e; autoload -U compinit; compinit -u -D"),
    "fish": (["fish", "--no-config", "-i"], "true"),
}
LINES = [
    ("wbm dist", "wbm distill"),
    ("wbm artifacts ver", "wbm artifacts verify"),
    ("wbm run prof", "wbm run profile="),
    ("wbm run profile=la", "wbm run profile=laptop"),
    ("wbm run -m teacher=side,t", "wbm run -m teacher=side,top_down"),
    ("wbm run --fo", "wbm run --force"),
]


@pytest.fixture
def environment(tmp_path):
    program = tmp_path / "bin/wbm"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m stages.cli "$@"\n')
    program.chmod(0o755)
    return {
        "PATH": f"{program.parent}:{os.environ['PATH']}",
        "PYTHONPATH": str(REPOSITORY),
        "HOME": str(tmp_path),
        "TERM": "dumb",
        "LC_ALL": "C.UTF-8",
    }


class Terminal:
    """A shell on a pseudo-terminal."""

    def __init__(self, command, environment, folder):
        self.main, other = pty.openpty()
        self.process = subprocess.Popen(
            command, stdin=other, stdout=other, stderr=other, env=environment, cwd=folder, start_new_session=True
        )
        os.close(other)
        self.text = ""

    def type(self, keys):
        os.write(self.main, keys.encode())

    def wait_for(self, pattern, seconds=100):
        end = time.monotonic() + seconds
        while not (found := re.search(pattern, self.text)):
            assert time.monotonic() < end, self.text[-2000:]
            if select.select([self.main], [], [], 0.1)[0]:
                self.text += os.read(self.main, 4096).decode(errors="replace")
        self.text = self.text[found.end() :]
        return found

    def close(self):
        self.process.kill()
        self.process.wait()
        os.close(self.main)


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_tab_completes_what_was_typed(shell, environment, tmp_path):
    command, setup = SHELLS[shell]
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    terminal = Terminal(command, environment, tmp_path)
    try:
        terminal.type(f"PS1='> '; {setup}; source <(wbm completion {shell}); echo READ''Y\n")
        terminal.wait_for("READY")
        for typed, completed in LINES:
            terminal.type(f"{typed}\t\x01echo '<\x05>'\n")  # to the start, to the end: echo what the line has become
            assert terminal.wait_for(r"\n<([^\r\n]*)>").group(1).rstrip() == completed
    finally:
        terminal.close()


def test_fish_completes_what_was_typed(environment, tmp_path):
    if shutil.which("fish") is None:
        pytest.skip("fish is not installed")
    asked = "".join(f"echo '<{typed}'; complete -C '{typed}'\n" for typed, _ in LINES)
    (tmp_path / "ask.fish").write_text(f"wbm completion fish | source\n{asked}")
    done = subprocess.run(
        ["fish", "--no-config", tmp_path / "ask.fish"], env=environment, cwd=tmp_path, capture_output=True, text=True
    )
    answers = {block.split("\n")[0]: block.split("\n")[1:-1] for block in done.stdout.split("<")[1:]}
    for typed, completed in LINES:
        assert answers[typed] == [completed.split(" ")[-1]], done.stderr


@pytest.mark.parametrize("shell", completion.SCRIPTS)
def test_the_shell_accepts_the_script(shell, tmp_path):
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    path = tmp_path / "script"
    path.write_text(completion.SCRIPTS[shell])
    assert subprocess.run([shell, "-n", path]).returncode == 0

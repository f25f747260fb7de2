"""What a user reads after the likely mistakes: what, where, what to do, in a line or two, word for word.

The snapshot is `tests/data/error_messages.txt`. After a change that is meant, write it anew and read the difference:

    WBM_SNAPSHOT=1 pytest tests/test_error_messages.py && git diff tests/data
"""

import io
import os
import shlex
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from stages.cli import main

SNAPSHOT = Path(__file__).parent / "data" / "error_messages.txt"
MISTAKES = """
rnu
run sed=1
run seed=many
run seed = 1
run seed=1,2
run profile=lap
run teacher=side
run --launcher slurm --detach seed=x
run --detach
run artifacts.root=text.txt
run artifacts.root=/proc/nowhere
run hydra.run.dir=out
run student.heads=5
run env.action.term=both
run inputs.assets=assets/mine
run --frce
prepare-assets objects=meshes
prepare-assets objects=meshes objects.path=nowhere
prepare-assets objects.count=1
train-teacher teacher=topdown
train-teacher teacher.num_envs=0
train-teacher
distill distill.lr=fast
distill distill.batch_size=0
distill
evaluate --episodes 3
evaluate policy=student/none
evaluate evaluation.split=val
evaluate evaluation.episodes=0
deploy-export deploy.num_golden=0
plan --until train
artifacts show
artifacts show student/main
artifacts diff student/main
artifacts verify student/main
artifacts rm student/main
artifacts push artifacts.root=other
bundle verify nothing.wbm
bundle verify text.txt
bundle verify bundle/main
bundle soak text.txt --minutes 0
bundle replay nothing.mcap text.txt
bundle compare
bench speed
bench
view
view student/main
robot export
completion csh
repro-diff student/main
""".strip().splitlines()


def answer(line: str, here: Path) -> str:
    """The command as typed, its exit code, and what it wrote on standard error."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as stop:
        main(shlex.split(line))
    lines = [text.strip() for text in (out.getvalue() + err.getvalue()).replace(str(here), "HERE").splitlines()]
    said = [t for t in lines if t and ": running because" not in t and not t.startswith("verify (")]  # no progress
    assert stop.value.code in (1, 2), (line, said)
    assert 1 <= len(said) <= 2 and not any("Traceback" in text for text in said), said
    return "\n".join([f"$ wbm {line}", *(f"  [{stop.value.code}] {_stable(text)}" for text in said)]) + "\n"


def _stable(text: str) -> str:
    """Without the key, time and process that end a quarantine's name."""
    return "/".join([*text.split("/")[:-1], "ATTEMPT"]) if ".quarantine" in text else text


def test_messages_are_those_of_the_snapshot(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.txt").write_text("hello")
    found = "".join(answer(line, tmp_path) for line in MISTAKES)
    if os.environ.get("WBM_SNAPSHOT"):
        SNAPSHOT.write_text(found)
    assert found == SNAPSHOT.read_text()

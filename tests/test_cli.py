"""The command line over small stages: exit codes, one-line errors, skip, resume, reasons, JSON."""

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest import mock

import pytest
from artifacts_support import s3_server
from chaos import storm
from toy.register import install

from stages import plan, registry
from stages.cli import main

REPOSITORY = Path(__file__).resolve().parent.parent
ENV = {**os.environ, "PYTHONPATH": os.pathsep.join([str(REPOSITORY), str(REPOSITORY / "tests")])}
KILLS = 100 if os.environ.get("WBM_FULL") else 2


def start(*arguments, **env):
    """Start a command as a process of its own."""
    command = [sys.executable, "-m", "toy", *arguments]
    return subprocess.Popen(command, env={**ENV, **env}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wbm(*arguments, **env):
    """Run a command in this process: exit code, standard output, standard error."""
    out, err = io.StringIO(), io.StringIO()
    redirected = redirect_stdout(out), redirect_stderr(err)
    with mock.patch.dict(os.environ, env), redirected[0], redirected[1], pytest.raises(SystemExit) as stop:
        main(list(arguments))
    return stop.value.code, out.getvalue(), err.getvalue()


@pytest.fixture(autouse=True)
def toy_stages(monkeypatch):
    monkeypatch.setattr(registry, "MODULES", {})
    monkeypatch.setattr(plan, "_code", plan._code)
    install()


@pytest.fixture
def root(tmp_path):
    return f"artifacts.root={tmp_path / 'store'}"


def states(root, *arguments, **env):
    code, out, err = wbm("run", root, "--json", *arguments, **env)
    assert code == 0, err
    return {s["stage"]: s["state"] for s in json.loads(out)["stages"]}


def test_run_skips_what_is_up_to_date_and_plan_says_why(root):
    assert set(states(root).values()) == {"ran"}
    assert set(states(root).values()) == {"up to date"}
    assert wbm("plan", "--check", root)[0] == 0
    code, out, _ = wbm("plan", "--check", "--json", root, "seed=1")
    assert code == 3
    plan = {s["stage"]: s for s in json.loads(out)["stages"]}
    assert plan["prepare-assets"]["reasons"] == ["seed 0 -> 1"]
    assert plan["distill"]["reasons"] == ["input assets changed"]
    assert "because seed 0 -> 1" in wbm("plan", root, "seed=1")[1]


def test_a_setting_reruns_only_the_stages_that_read_it(root):
    states(root)
    assert states(root, "teachers=[side]") == {
        "prepare-assets": "up to date",
        "distill": "ran",
        "evaluate": "up to date",
    }
    assert set(states(root, "note=again").values()) == {"up to date"}


def test_a_stage_that_reran_to_the_same_bytes_stops_the_chain(root):
    """distill gives the same bytes under another seed: evaluate runs for its own seed, not because of distill."""
    states(root)
    assert states(root, "seed=1", "--until", "distill") == {"prepare-assets": "ran", "distill": "ran"}
    _, out, _ = wbm("plan", "--json", root, "seed=1")
    assert [s["reasons"] for s in json.loads(out)["stages"]] == [[], [], ["seed 0 -> 1"]]


def test_one_stage_uses_the_newest_inputs_and_says_when_they_are_old(root):
    code, _, err = wbm("distill", root)
    assert code == 1 and "assets/main does not exist" in err
    states(root)
    code, _, err = wbm("distill", root, "seed=5")
    assert code == 0 and "assets/main is not up to date (because seed 0 -> 5)" in err
    _, out, _ = wbm("artifacts", "ls", root, "--json")
    first = next(row["artifact"] for row in json.loads(out) if row["artifact"].startswith("student"))
    assert wbm("evaluate", root, f"policy={first}")[0] == 0
    code, _, err = wbm("evaluate", root, "policy=student/none")
    assert code == 1 and "student/none: nothing published under this name" in err and "student/main" in err


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (("run", "sed=1"), 2, "unknown key 'sed'; did you mean 'seed'?"),
        (("run", "artifacts.rot=x"), 2, "did you mean 'artifacts.root'?"),
        (("run", "seed=many"), 2, "seed=many: must be an integer, not str"),
        (("run", "profile=lap"), 2, "profile=lap: no such preset; did you mean 'laptop'?"),
        (("run", "seed=1,2"), 2, "add -m to run them all"),
        (("run", "+extra=1"), 2, "unknown key 'extra'"),
        (("run", "seed"), 2, "write key=value"),
        (("run", "--launcher", "moon"), 2, "choose local or slurm"),
        (("run", "--detach"), 2, "needs --launcher slurm"),
        (("run", "--until", "nothing"), 2, "no such stage"),
        (("distil",), 2, "Did you mean 'distill'?"),
        (("run", "--frce"), 2, "--force"),
        (("artifacts", "show", "student/none"), 1, "nothing published"),
        (("artifacts", "show", "assets/none/0123"), 1, "not published"),
        (("artifacts", "diff", "one"), 2, "name 2 artifacts"),
        (("artifacts", "ls", "artifacts.root=ftp://x/y"), 1, "directory"),
        (("completion", "csh"), 2, "bash, zsh, fish"),
    ],
)
def test_errors_are_one_line_that_says_what_to_do(tmp_path, arguments, code, text):
    has_root = any("artifacts.root" in a or a in ("--until", "distil", "completion") for a in arguments)
    extra = () if has_root else (f"artifacts.root={tmp_path}",)
    got, out, err = wbm(*arguments, *extra)
    assert got == code, err
    assert text in err
    assert len(err.strip().splitlines()) == 1 and "Traceback" not in err and out == ""


def test_cfg_and_info_print_without_work(root, tmp_path):
    _, out, _ = wbm("run", "--cfg", "--json", root, "seed=4")
    assert json.loads(out)["seed"] == 4
    _, out, _ = wbm("prepare-assets", "--cfg", root)
    assert out.splitlines()[-1] == "seed: 0"
    assert "profile/laptop" in wbm("run", "--info", root, "profile=laptop")[1]
    assert not (tmp_path / "store").exists()


def test_a_sweep_ends_with_one_table(root):
    code, out, _ = wbm("run", "-m", root, "seed=1,2", "teachers=[side],[top_down]")
    assert code == 0
    rows = [line for line in out.splitlines() if line.startswith("seed=")]
    assert [" ".join(row.split()[:2]) for row in rows] == [
        f"seed={s} teachers=[{t}]" for s in (1, 2) for t in ("side", "top_down")
    ]
    code, out, _ = wbm("prepare-assets", "-m", "--json", root, "seed=range(1,4)")
    assert [run["overrides"] for run in json.loads(out)] == [["seed=1"], ["seed=2"], ["seed=3"]]


def test_a_failed_point_does_not_stop_a_sweep(root):
    code, out, err = wbm("run", "-m", root, "seed=1,2", TOY_FAIL="boom")
    assert code == 1 and "2 of 2 runs failed" in err
    assert out.count(" failed ") == 2 and out.count("boom") == 2


def test_failed_output_is_quarantined(root, tmp_path):
    code, _, err = wbm("run", root, TOY_FAIL="boom")
    assert code == 1 and "distill: RuntimeError: boom; its output is in" in err
    assert Path(err.strip().split(" is in ")[-1], "half.txt").read_text() == "half"
    process = start("run", root, "--debug", TOY_FAIL="boom")
    assert "Traceback" in process.communicate()[1] and process.returncode == 1
    assert states(root) == {"prepare-assets": "up to date", "distill": "ran", "evaluate": "ran"}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_continues_where_it_was(root, tmp_path, number):
    log = tmp_path / "log"
    process = start("run", root, TOY_SLEEP="0.1", TOY_LOG=str(log))
    wait_for(lambda: log.exists() and len(log.read_text().splitlines()) >= 2)
    process.send_signal(number)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 1
    assert err.strip().splitlines()[-1] == "wbm: prepare-assets: interrupted; run the same command again to continue"
    assert json.loads(wbm("artifacts", "ls", root, "--json")[1]) == []
    states(root, TOY_LOG=str(log))
    assert sorted(log.read_text().splitlines()) == sorted(f"shard {i}" for i in range(8)), "each shard once"


def test_killed_runs_lose_at_most_a_shard_and_end_with_the_same_bytes(tmp_path):
    damage = storm(tmp_path, KILLS)
    assert damage.problems == []
    assert damage.kills >= KILLS
    assert damage.shards_written - damage.shards_needed <= damage.kills


def wait_for(condition, timeout=30.0):
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.02)


def test_a_full_disk_is_one_line_and_nothing_is_lost(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    if os.geteuid() or subprocess.run(["mount", "-t", "tmpfs", "-o", "size=24k", "tmpfs", disk]).returncode:
        pytest.skip("needs the right to mount a small file system")
    try:
        code, _, err = wbm("run", f"artifacts.root={disk}")
        assert code == 1
        assert "no disk space left" in err.splitlines()[-1] or "No space left" in err.splitlines()[-1]
        assert json.loads(wbm("artifacts", "ls", f"artifacts.root={disk}", "--json")[1]) == []
        subprocess.run(["mount", "-o", "remount,size=8m", disk], check=True)
        assert set(states(f"artifacts.root={disk}").values()) == {"ran"}
    finally:
        subprocess.run(["umount", disk], check=True)


def test_the_pipeline_runs_on_s3(tmp_path):
    with s3_server(tmp_path / "cache") as url:
        root = f"artifacts.root={url}"
        assert set(states(root).values()) == {"ran"}
        shutil.rmtree(tmp_path / "cache")
        assert set(states(root).values()) == {"up to date"}
        assert states(root, "teachers=[side]", "--until", "distill")["distill"] == "ran", "inputs are fetched again"
        assert wbm("artifacts", "verify", root)[0] == 0
        code, out, _ = wbm("run", root)
        assert code == 0 and "report  " in out and Path(out.split("report  ")[1].strip()).is_file()


def test_forced_runs_start_over(root):
    states(root)
    assert set(states(root, "--force").values()) == {"ran"}
    assert wbm("artifacts", "verify", root)[0] == 0


def test_artifact_commands_agree_on_damage(root, tmp_path):
    states(root)
    assert wbm("artifacts", "verify", root)[0] == 0
    shard = next((tmp_path / "store" / "assets").rglob("c/3/0"))
    shard.unlink()
    code, out, _ = wbm("artifacts", "verify", "--json", root)
    assert code == 1 and "data.zarr/x/c/3/0 is missing" in json.loads(out)["problems"][0]
    code, _, err = wbm("distill", root, "--force")
    assert code == 1 and "c/3/0: missing or truncated" in err


def test_why_diff_and_repro_diff(root):
    states(root)
    states(root, "seed=1")
    _, out, _ = wbm("artifacts", "ls", root, "--json", "assets")
    one, two = (row["artifact"] for row in json.loads(out))
    _, out, _ = wbm("artifacts", "diff", one, two, root, "--json")
    assert json.loads(out)["config"][0]["name"] == "seed"
    code, out, _ = wbm("repro-diff", one, two, root, "--json")
    assert code == 1
    assert json.loads(out)["first"]["tensor"] == "x" and json.loads(out)["first"]["step"] == 0
    assert wbm("repro-diff", one, one, root)[0] == 0
    _, out, _ = wbm("artifacts", "why", "assets/main", root, "--json")
    used = json.loads(out)["used_by"]
    assert used[0]["artifact"].startswith("student/main") and used[0]["branches"][0]["slot"] == "policy"


MAKEFILE = """
WBM := {python} -m toy
WBM_ARGS = {settings}
WBM_ROOT := store
include {repository}/wbm.mk
paper.txt: $(call wbm_latest,student/main)
\tdate +%N > $@
"""


def test_another_makefile_builds_only_what_changed(tmp_path):
    def make(settings="seed=0"):
        text = MAKEFILE.format(python=sys.executable, repository=REPOSITORY, settings=settings)
        (tmp_path / "Makefile").write_text(text)
        done = subprocess.run(["make", "-s", "paper.txt"], cwd=tmp_path, env=ENV, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return (tmp_path / "paper.txt").read_text()

    first = make()
    assert make() == first, "nothing changed"
    assert make("seed=0 teachers=[side]") != first, "the student is another one"


def test_help_imports_nothing_heavy():
    code = "import sys; from stages.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass\n"
    code += "heavy = ('torch', 'warp', 'mujoco', 'hydra', 'zarr', 'numpy', 'rich')\n"
    code += "print([m for m in heavy if m in sys.modules], file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], env=ENV, capture_output=True, text=True)
    assert done.stderr.strip() == "[]"
    for name in ("run", "prepare-assets", "train-teacher", "plan", "artifacts", "doctor"):
        assert name in done.stdout


def test_planning_imports_nothing_heavy(root):
    code = "import sys; from stages.cli import main\ntry: main(sys.argv[1:])\nexcept SystemExit: pass\n"
    code += "print([m for m in ('torch','warp','mujoco') if m in sys.modules], file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code, "plan", root], env=ENV, capture_output=True, text=True)
    assert done.stderr.strip().splitlines()[-1] == "[]"


def test_kernels_load_without_a_word():
    done = subprocess.run([sys.executable, "-c", "import wbm.kernels.se3"], env=ENV, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")

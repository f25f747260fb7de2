"""Where a result came from: git state, machine, command line."""

from __future__ import annotations

import os
import platform
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

_MAX_PATCH = 256 << 10


@cache
def git_state() -> dict[str, Any]:
    """Commit, whether the tree is dirty, and its patch (at most 256 KiB); empty outside a checkout."""
    base = Path(__file__).resolve().parent.parent

    def git(*args: str) -> str:
        done = subprocess.run(
            ["git", "-C", str(base), *args], capture_output=True, text=True, timeout=20, errors="replace"
        )
        return done.stdout if done.returncode == 0 else ""

    try:
        if Path(git("rev-parse", "--show-toplevel").strip() or "/") != base:
            return {}
        patch = git("diff", "HEAD", "--", "wbm", "stages", "conf")
        return {"commit": git("rev-parse", "HEAD").strip(), "dirty": bool(patch), "patch": patch[:_MAX_PATCH]}
    except (OSError, subprocess.TimeoutExpired):
        return {}


def environment() -> dict[str, Any]:
    """The determinism class (threads, CPU capability) and the machine."""
    torch = sys.modules.get("torch")
    return {
        "threads": torch.get_num_threads() if torch else int(os.environ.get("OMP_NUM_THREADS", os.cpu_count() or 1)),
        "cpu_capability": os.environ.get("ATEN_CPU_CAPABILITY") or _cpu_capability(),
        "mkl_cbwr": os.environ.get("MKL_CBWR", ""),
        "machine": platform.machine(),
        "system": platform.system(),
        "host": platform.node(),
    }


@cache
def _cpu_capability() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as stream:
            flags = next((line for line in stream if line.startswith("flags")), "").split()
    except OSError:
        return ""
    if {"avx512f", "avx512vl", "avx512bw", "avx512dq"} <= set(flags):
        return "avx512"
    return "avx2" if {"avx2", "fma"} <= set(flags) else "default"


def command_line() -> str:
    """The command as it was typed."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])

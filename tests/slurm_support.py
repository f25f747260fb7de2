"""What the tests on a real Slurm share: a world that is small enough, and `wbm` on a cluster."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from slurm_cluster import SlurmCluster

ROOT = Path(__file__).resolve().parent.parent
SMALL = (
    "objects.count=24", "objects.held_out=[]", "scenes.kinds=[table,shelf]", "scenes.count=6", "scenes.test_count=2",
    "env.starts_per_scene=2", "env.episode_s=2", "teacher.supports=[table,shelf]", "teacher.num_envs=4",
    "teacher.eval_episodes=2", "teacher.eval_envs=2", "ppo.steps=8", "rollouts.episodes=2", "rollouts.num_envs=2",
    "rollouts.keep=all", "rollouts.physics=train", "rollouts.samples=1", "launcher.cpus=1", "launcher.poll=0.5",
    "launcher.grace=8", "launcher.parallel=2",
)  # fmt: skip


class Lab:
    """A working directory from which `wbm` is used, on a cluster or on this machine alone."""

    def __init__(self, folder: Path, cluster: SlurmCluster | None = None, settings: tuple[str, ...] = SMALL) -> None:
        self.folder, self.settings = folder, settings
        folder.mkdir(parents=True, exist_ok=True)
        base = cluster.env if cluster else os.environ
        self.env = {**base, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}

    def wbm(self, *arguments: str, settings: bool = True, code: int = 0) -> str:
        """Standard output of a command that ends with `code`; with the lab's settings, where the command takes some."""
        command = [sys.executable, "-m", "stages.cli", *arguments, *(self.settings if settings else ())]
        done = subprocess.run(command, cwd=self.folder, env=self.env, capture_output=True, text=True, timeout=3600)
        assert done.returncode == code, f"{' '.join(command)}: {done.stderr[-2000:]}"
        return done.stdout if code == 0 else done.stderr

    def run(self, *arguments: str) -> dict[str, str]:
        """Content digests of what a command made or found, by artifact."""
        stages = json.loads(self.wbm(*arguments, "--json"))["stages"]
        return {s["artifact"]: s["content_digest"] for s in stages}

    def submit(self, *arguments: str) -> str:
        """Submit and return the submission's id."""
        return json.loads(self.wbm(*arguments, "--launcher", "slurm", "--detach", "--json"))["submission"]

    def tasks(self, submission: str) -> dict[str, dict[str, str]]:
        """Where the tasks of a submission are, by name."""
        found = json.loads(self.wbm("jobs", "ls", "--json"))
        return {t["task"]: t for s in found if s["submission"] == submission for t in s["tasks"]}

    def iteration(self, name: str) -> int:
        """Iterations in the checkpoint of the teacher that is being trained, 0 without one."""
        import torch

        for path in self.folder.glob(f"artifacts/.staging/teacher/{name}/*.scratch/checkpoint.pt"):
            return int(torch.load(path, weights_only=True)["iteration"])
        return 0

    def parts(self) -> int:
        """Rollout shards that jobs have finished and nobody has joined yet."""
        return len(list(self.folder.glob("artifacts/.staging/rollouts/main/*/parts/[0-9]*")))

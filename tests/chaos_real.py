"""Kills and power cuts over the six real stages, very small ones, a thousand times in less than an hour.

`python tests/chaos_real.py --kills 1000` forks each run from a process that has everything imported and all kernels
loaded. A run is ended by SIGKILL at a random moment: the whole process group, or the main process alone. Every fourth
time, where a file system can be mounted (root on Linux), the power goes too: the store lies on an ext4 image whose page
cache is then thrown away, so that what was not flushed is lost. After each blow `verify` must find nothing; after each
pipeline the content digests must be those of an undisturbed run.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import inspect
import io
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(REPOSITORY))
SMALL = [
    "profile=smoke", "sim.threads=1", "distill.threads=1", "sensors=exact", "teachers=[top_down]", "objects.count=6",
    "objects.workers=1", "scenes.count=4", "scenes.test_count=1", "scenes.kinds=[table]", "scenes.settle_time=0.2",
    "scenes.settle_tolerance=1.0", "env.episode_s=0.4", "env.approach_s=0.2", "env.success_hold_s=0.1",
    "teacher.iterations=4", "teacher.eval_every=2", "teacher.num_envs=4", "teacher.eval_envs=2",
    "teacher.eval_episodes=2", "ppo.steps=4", "ppo.epochs=1", "ppo.minibatches=1", "rollouts.shards=3",
    "rollouts.episodes=2", "rollouts.num_envs=2", "rollouts.samples=1", "rollouts.workers=1",
    "sensors.depth.width=16", "sensors.depth.height=12", "sensors.lidar.num_rays=64",
    "sensors.depth_cloud.num_points=32", "sensors.lidar_cloud.num_points=32", "distill.iterations=8",
    "distill.batch_size=4", "distill.warmup=1", "distill.val_every=4", "distill.checkpoint_every=2",
    "evaluation.episodes=34", "evaluation.num_envs=17", "evaluation.workers=1", "evaluation.videos=1",
    "evaluation.filmstrips=0", "evaluation.record_episodes=1", "evaluation.video_width=64",
    "evaluation.video_height=48",
]  # fmt: skip


SPANS_S = (0.2, 0.6, 0.6, 1.2, 1.2, 8.0)  # a run is killed between 0 and one of these: starts, short units, long ones


@dataclass
class Damage:
    """What a storm did. `redone` is the largest number of finished units that one blow cost."""

    kills: int = 0
    cuts: int = 0
    pipelines: int = 0
    units: int = 0
    redone: list[int] = field(default_factory=list)
    where: dict[str, int] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)


class Disk:
    """A directory that can lose what was not flushed: an ext4 image; a plain one where mounting is not allowed."""

    def __init__(self, folder: Path, size_mb: int = 96) -> None:
        self.root, self.image, self.number = folder / "disk", folder / "image-0", 0
        self.root.mkdir()
        self.options = "loop,noauto_da_alloc,commit=600,data=writeback"
        with open(self.image, "wb") as stream:
            stream.truncate(size_mb << 20)
        formatted = shutil.which("mkfs.ext4") and not os.geteuid()
        formatted = formatted and not subprocess.run(["mkfs.ext4", "-q", "-F", self.image]).returncode
        self.mounted = bool(formatted) and self._mount() == 0

    def _mount(self) -> int:
        return subprocess.run(
            ["mount", "-o", self.options, self.image, self.root], stderr=subprocess.DEVNULL
        ).returncode

    def power_cut(self) -> None:
        """Go on with what the disk itself held at this moment."""
        old = self.image
        self.number += 1
        self.image = old.with_name(f"image-{self.number}")
        subprocess.run(["cp", "--sparse=always", old, self.image], check=True)
        subprocess.run(["umount", self.root], check=True)
        old.unlink()
        if self._mount():
            raise RuntimeError(f"{self.image}: the file system itself did not survive")

    def close(self) -> None:
        if self.mounted:
            subprocess.run(["umount", self.root], check=False)


def preload(folder: Path, seeds: list[int]) -> dict[int, dict[str, str]]:
    """Run the pipelines undisturbed in this process, which loads all modules and kernels; their content digests."""
    import importlib

    from wbm.learning import evaluation, rollouts, workers

    real, digests = workers.run_jobs, {}
    workers.run_jobs = lambda module, jobs, _: (importlib.import_module(module).work(job) for job in jobs)
    for seed in seeds:
        out = io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
            code = wbm("run", "--json", *SMALL, f"seed={seed}", f"artifacts.root={folder / 'calm'}")
        assert code == 0, out.getvalue()
        digests[seed] = {s["artifact"]: s["content_digest"] for s in json.loads(out.getvalue())["stages"]}
    shutil.rmtree(folder / "calm")
    workers.run_jobs, rollouts._world, evaluation._world = real, None, None
    gc.collect()
    gc.freeze()  # a child that collects garbage would copy all of this
    return digests


def wbm(*arguments: str) -> int:
    from stages.cli import main

    try:
        main(list(arguments))
    except SystemExit as stop:
        return int(stop.code or 0)
    raise AssertionError("main() returns by SystemExit")


def fork(log: Path, errors: Path, *arguments: str) -> int:
    """Start `wbm` in a forked process group of its own; finished units of work are appended to `log`."""
    sys.stdout.flush()
    pid = os.fork()
    if pid:
        return pid
    try:
        os.setsid()
        handle = os.open(errors, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        watch_units(log)
        os._exit(wbm(*arguments))
    except BaseException as error:
        os.write(2, repr(error).encode())
        os._exit(70)


def watch_units(log: Path) -> None:
    """Log every unit of work when it is finished: teacher iterations, shards, checkpoints, blocks, whole artifacts."""
    import multiprocessing

    from wbm.artifacts.store import Draft
    from wbm.learning import distill, evaluation, rollouts, teacher, workers

    start_worker = workers._quiet

    def quiet() -> None:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # as in a fresh interpreter
        start_worker()

    workers._quiet = quiet
    fork_context = multiprocessing.get_context("fork")
    multiprocessing.get_context = lambda _=None: fork_context  # workers start from here, not from an empty interpreter
    handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)

    def note(text: str) -> None:
        os.write(handle, f"{text}\n".encode())

    def wrap(owner: Any, name: str, text: Callable[..., str], before: bool) -> None:
        real = getattr(owner, name)

        def wrapper(*arguments: Any, **options: Any) -> Any:
            if before:
                note(text(*arguments, **options))
            result = real(*arguments, **options)
            if not before:
                note(text(*arguments, **options))
            return result

        setattr(owner, name, wrapper)

    wrap(rollouts, "work", lambda job: f"rollouts shard {job.shard}", before=False)
    wrap(evaluation, "work", lambda job: f"evaluation block {job.first}", before=False)
    saving = inspect.signature(teacher.save_checkpoint)
    iteration = lambda *a, **k: f"teacher iteration {saving.bind(*a, **k).arguments['iteration']}"
    wrap(teacher, "save_checkpoint", iteration, before=True)
    wrap(distill._Run, "save", lambda run: f"distill step {run.step}", before=True)
    wrap(Draft, "publish", lambda draft: f"publish {draft.manifest.kind}", before=True)


def cpu_time(pid: int) -> float:
    """Processor seconds of a process and its children: how far it is, however busy the machine is."""
    total = 0
    with contextlib.suppress(OSError, IndexError):
        workers = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        for number in (pid, *workers):
            fields = Path(f"/proc/{number}/stat").read_text().rsplit(")", 1)[1].split()
            total += int(fields[11]) + int(fields[12])
    return total / os.sysconf("SC_CLK_TCK")


def strike(pid: int, after_s: float, whole_group: bool) -> int | None:
    """Wait for the end of a process, or kill it after `after_s` of processor time; the exit code, None if killed."""
    while True:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if cpu_time(pid) >= after_s:
            (os.killpg if whole_group else os.kill)(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            _wait_for_orphans(pid)
            return None
        time.sleep(0.004)


def _wait_for_orphans(group: int) -> None:
    """Workers must die with their parent; if they do not, the next run would meet them."""
    end = time.monotonic() + 20
    while time.monotonic() < end:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.01)
    raise AssertionError("workers outlived their parent")


def storm(folder: Path, kills: int, seeds: int = 1, seed: int = 0, minutes: float = 1e9) -> Damage:
    """Run small pipelines and end them at random moments until `kills` or `minutes` are spent; let the last one end."""
    from wbm.artifacts.store import Store

    rng, damage = random.Random(seed), Damage()
    os.environ["OMP_NUM_THREADS"] = "1"
    calm = preload(folder, list(range(seeds)))
    disk, end = Disk(folder), time.monotonic() + 60 * minutes
    log, errors = folder / "units", folder / "errors"
    try:
        while (damage.kills < kills and time.monotonic() < end) or damage.pipelines == 0:
            number = damage.pipelines % seeds
            root = disk.root / f"store-{damage.pipelines}"
            arguments = ("run", "--json", *SMALL, f"seed={number}", f"artifacts.root={root}")
            finished: set[str] = set()
            code = None
            while code is None:
                calm_down = damage.kills >= kills or time.monotonic() > end
                log.write_text("")
                pid = fork(log, errors, *arguments)
                code = strike(pid, 1e9 if calm_down else rng.uniform(0.0, rng.choice(SPANS_S)), rng.random() < 0.5)
                units = log.read_text().splitlines()
                again = [unit for unit in units if unit in finished]
                finished |= set(units)
                damage.units += len(units)
                damage.redone.append(len(again))
                if code is None:
                    damage.kills += 1
                    if damage.kills % 10 == 0:
                        print(f"  {damage.kills} kills, now in pipeline {damage.pipelines}: {units[-1:]}", flush=True)
                    where = (units[-1] if units else "start").split()[0]
                    damage.where[where] = damage.where.get(where, 0) + 1
                    if disk.mounted and rng.random() < 0.25:
                        disk.power_cut()
                        damage.cuts += 1
                problems = Store.open(root).verify()
                damage.problems += [f"pipeline {damage.pipelines}, kill {damage.kills}: {p}" for p in problems]
                if len(again) > 1:
                    damage.problems.append(f"kill {damage.kills}: {len(again)} finished units done again: {again}")
            if code:
                damage.problems.append(errors.read_text()[-500:])
                shutil.copy(errors, folder / f"errors-{damage.pipelines}")
            else:
                stages = json.loads(errors.read_text()[errors.read_text().index("{\n") :])["stages"]
                if {s["artifact"]: s["content_digest"] for s in stages} != calm[number]:
                    damage.problems.append(f"pipeline {damage.pipelines}: other bytes than an undisturbed run")
            damage.pipelines += 1
            print(f"{damage.kills} kills, {damage.cuts} power cuts, {damage.pipelines} pipelines, "
                  f"{len(damage.problems)} problems", flush=True)  # fmt: skip
            shutil.rmtree(root, ignore_errors=True)
    finally:
        disk.close()
    return damage


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=2, help="different pipelines, each run undisturbed first")
    parser.add_argument("--minutes", type=float, default=1e9, help="stop after so long")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    began = time.monotonic()
    base = "/dev/shm" if Path("/dev/shm").is_dir() else None
    with tempfile.TemporaryDirectory(dir=base) as folder:
        damage = storm(Path(folder), options.kills, options.seeds, options.seed, options.minutes)
    redone = {count: damage.redone.count(count) for count in sorted(set(damage.redone))}
    print(f"{damage.kills} kills, {damage.cuts} of them with the power cut, {time.monotonic() - began:.0f} s")
    print(f"{damage.pipelines} pipelines, {damage.units} units of work finished, last finished unit: {damage.where}")
    print(f"finished units done again after a blow -> how often: {redone}")
    print(f"{len(damage.problems)} problems")
    for problem in damage.problems:
        print(problem)
    sys.exit(bool(damage.problems))


if __name__ == "__main__":
    main()

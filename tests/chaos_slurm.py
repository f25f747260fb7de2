"""One teacher and one array of rollout shards on a real Slurm: jobs are preempted, nodes and the controller die.

`python tests/chaos_slurm.py --preemptions 30 --node-kills 5 --controller-kills 3` starts a cluster and prints what came
of it. Right means: the digests of undisturbed runs, every shard made once, training never behind a checkpoint.
"""

from __future__ import annotations

import argparse
import random
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from slurm_cluster import NODES, SlurmCluster, unavailable
from slurm_support import SMALL, Lab

LIMIT_S = 3600.0
ONE = (*SMALL, "teachers=[top_down]", "scenes.kinds=[table]", "teacher.supports=[table]")


@dataclass
class Figures:
    """What a storm did."""

    preemptions: int = 0
    jobs_preempted: int = 0
    node_kills: int = 0
    jobs_on_killed_nodes: int = 0
    controller_kills: int = 0
    starts: int = 0
    iterations: int = 0
    iterations_lost: int = 0
    shards_needed: int = 0
    shards_committed: int = 0
    problems: list[str] = field(default_factory=list)


class Storm:
    """Disturbs one submission of a teacher and one of rollouts until the blows are spent and both are done."""

    def __init__(self, cluster: SlurmCluster, lab: Lab, blows: Sequence[str], seed: int = 0) -> None:
        self.cluster, self.lab, self.blows = cluster, lab, list(blows)
        self.rng = random.Random(seed)
        self.rng.shuffle(self.blows)
        self.figures = Figures()

    def running(self) -> list[tuple[str, str]]:
        """Jobs of the submissions that run now, with their nodes."""
        lines = self.cluster.run("squeue", "-h", "-r", "-t", "R", "-p", "low", "-o", "%i %N").splitlines()
        return [(line.split()[0], line.split()[1]) for line in lines]

    def over(self) -> bool:
        """Whether no job is left."""
        return not self.cluster.run("squeue", "-h", "-p", "low", "-o", "%i").split()

    def pass_by(self, teacher: str) -> None:
        """Strike whenever something has gone on since the last blow."""
        end, newest = time.monotonic() + LIMIT_S, 0
        before = (self.lab.iteration(teacher), self.lab.parts())
        while not self.over():
            if time.monotonic() > end:
                self.figures.problems.append(f"not done within {LIMIT_S:.0f} s")
                return
            now = (self.lab.iteration(teacher), self.lab.parts())
            newest = max(newest, now[0])
            self.figures.iterations_lost = max(self.figures.iterations_lost, newest - now[0] if now[0] else 0)
            if now != before and self.blows and self.running():
                time.sleep(self.rng.uniform(0.0, 2.0))
                getattr(self, self.blows.pop())()
                before = (self.lab.iteration(teacher), self.lab.parts())
                print(f"{len(self.blows)} blows left, iteration {before[0]}, {before[1]} shards", flush=True)
            time.sleep(0.5)

    def preempt(self) -> None:
        """A job that is worth more takes all nodes for a moment."""
        before = self.running()
        self.cluster.run("sbatch", "-p", "high", "-N3", "-c4", "-o", "/dev/null", "--wait", "--wrap", "sleep 0.5")
        self.figures.preemptions += 1
        self.figures.jobs_preempted += len(before)

    def kill_node(self) -> None:
        """A node loses power and comes back."""
        jobs = self.running()
        node = self.rng.choice([node for _, node in jobs]) if jobs else self.rng.choice(NODES)
        self.cluster.kill_node(node)
        self.cluster.wait_for(lambda: node in self.cluster.run("sinfo", "-h", "-N", "-t", "down", "-o", "%N"), "down")
        self.cluster.start_node(node)
        self.figures.node_kills += 1
        self.figures.jobs_on_killed_nodes += sum(n == node for _, n in jobs)

    def kill_controller(self) -> None:
        """The controller dies and comes back."""
        self.cluster.kill_controller()
        time.sleep(self.rng.uniform(0.5, 3.0))
        self.cluster.start_controller()
        self.cluster.wait_for(lambda: bool(self.cluster.run("sinfo", "-h")), "controller")
        self.figures.controller_kills += 1


def run(folder: Path, blows: Sequence[str], iterations: int, shards: int, seed: int = 0) -> Figures:
    """Undisturbed runs on this machine, then the same on a cluster in a storm.

    Args:
        folder: of everything.
        blows: names of methods of `Storm`.
        iterations: of the teacher.
        shards: of the rollouts.
        seed: of the order of the blows.
    """
    calm = Lab(folder / "calm", settings=ONE)
    trained = ("teacher=top_down", f"teacher.iterations={iterations}", f"teacher.eval_every={iterations}")
    made = ("teacher.iterations=1", f"rollouts.shards={shards}")
    calm.wbm("prepare-assets")
    calm.wbm("train-teacher", "teacher.iterations=1")
    shutil.copytree(calm.folder / "artifacts", folder / "storm" / "artifacts", symlinks=True)
    expected = [calm.run("generate-rollouts", *made), calm.run("train-teacher", *trained)]
    with SlurmCluster() as cluster:
        lab = Lab(folder / "storm", cluster, ONE)
        storm = Storm(cluster, lab, blows, seed)
        submissions = [lab.submit("generate-rollouts", *made), lab.submit("train-teacher", *trained)]
        storm.pass_by("top_down")
        figures = storm.figures
        if storm.blows:
            figures.problems.append(f"done before {len(storm.blows)} blows were struck: raise iterations or shards")
        for submission in submissions:
            bad = {n: t for n, t in lab.tasks(submission).items() if t["state"] != "done"}
            figures.problems += [f"{name}: {t['state']} {t['message']}" for name, t in bad.items()]
        if not figures.problems:
            found = [lab.run("generate-rollouts", *made), lab.run("train-teacher", *trained)]
            figures.problems += [f"{w} is not {g}" for w, g in zip(expected, found, strict=True) if w != g]
            figures.problems += lab.wbm("artifacts", "verify", settings=False).splitlines()[:-1]
        text = "".join(p.read_text(errors="replace") for p in lab.folder.glob("jobs/*/log/*_log.out"))
    figures.starts = text.count("Starting with JobEnvironment")
    figures.iterations, figures.shards_needed = iterations, shards
    figures.shards_committed = len(re.findall(r": part \d+ done", text))
    if figures.shards_committed != shards:
        figures.problems.append(f"{figures.shards_committed} shards were committed, not {shards}")
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preemptions", type=int, default=30)
    parser.add_argument("--node-kills", type=int, default=5)
    parser.add_argument("--controller-kills", type=int, default=3)
    parser.add_argument("--iterations", type=int, default=1500)
    parser.add_argument("--shards", type=int, default=24)
    options = parser.parse_args()
    reason = unavailable()
    if reason:
        sys.exit(reason)
    blows = ["preempt"] * options.preemptions + ["kill_node"] * options.node_kills
    blows += ["kill_controller"] * options.controller_kills
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        figures = run(Path(folder), blows, options.iterations, options.shards)
    print(f"{time.monotonic() - began:.0f} s, settings {' '.join(ONE)}")
    for name, value in vars(figures).items():
        print(f"{name}: {value}")
    sys.exit(bool(figures.problems))


if __name__ == "__main__":
    main()

"""Kills runs of the toy pipeline at random moments and looks at what is left: `python tests/chaos.py --kills 1000`.

The command line with all its start-up is what is killed; `chaos_real.py` does it to the real stages.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
ENV = {**os.environ, "PYTHONPATH": os.pathsep.join([str(REPOSITORY), str(REPOSITORY / "tests")])}


@dataclass
class Damage:
    """What a storm did."""

    kills: int = 0
    pipelines: int = 0
    shards_written: int = 0
    shards_needed: int = 0
    problems: list[str] = field(default_factory=list)


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "toy", *arguments]


SLOW = {**ENV, "TOY_SLEEP": "0.05"}


def digests(*arguments: str) -> dict[str, str]:
    """Content digests after an undisturbed run."""
    done = subprocess.run(command("run", "--json", *arguments), env=SLOW, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return {s["artifact"]: s["content_digest"] for s in json.loads(done.stdout)["stages"]}


def storm(folder: Path, kills: int, shards: int = 8, seed: int = 0) -> Damage:
    """Run pipelines under one seed after another, killing with SIGKILL at random moments, until `kills` are spent."""
    rng, damage, number = random.Random(seed), Damage(), 0
    while damage.kills < kills:
        number += 1
        began = time.monotonic()
        calm = digests(f"seed={number}", f"artifacts.root={folder / 'calm'}")
        undisturbed = time.monotonic() - began
        log = folder / f"log-{number}"
        arguments = [f"seed={number}", f"artifacts.root={folder / 'storm'}"]
        finished = False
        while not finished and damage.kills < kills:
            process = subprocess.Popen(
                command("run", *arguments),
                env={**SLOW, "TOY_LOG": str(log)},
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                start_new_session=True,
            )
            try:
                _, err = process.communicate(timeout=rng.uniform(0.3, 0.8) * undisturbed)
                finished = True
                if process.returncode:
                    damage.problems.append(err.decode()[-500:])
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.communicate()
                damage.kills += 1
            found = subprocess.run(
                command("artifacts", "verify", arguments[1]), env=ENV, capture_output=True, text=True
            )
            if found.returncode:
                damage.problems.append(found.stdout + found.stderr)
        if digests(*arguments) != calm:
            damage.problems.append(f"seed {number}: other bytes than an undisturbed run")
        damage.pipelines += 1
        print(f"{damage.kills} kills, {damage.pipelines} pipelines, {len(damage.problems)} problems", flush=True)
        if log.exists():
            damage.shards_written += len(log.read_text().splitlines())
            damage.shards_needed += shards
    return damage


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=1000)
    options = parser.parse_args()
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        damage = storm(Path(folder), options.kills)
    redone = damage.shards_written - damage.shards_needed
    print(f"{damage.kills} kills, {damage.pipelines} pipelines, {time.monotonic() - began:.0f} s")
    print(f"{redone} shards written twice, {len(damage.problems)} problems")
    for problem in damage.problems:
        print(problem)
    sys.exit(bool(damage.problems))


if __name__ == "__main__":
    main()

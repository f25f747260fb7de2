"""How quiet generated scenes are: every kind is simulated for a second, in the physics of training and of evaluation.

    python benchmarks/scenes_at_rest.py --scenes 100

Prints one JSON document: for each physics and kind the number of scenes, the farthest that an object moved (mm), how
many moved by more than 5 mm or fell, and how many start poses touched anything.
"""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

import mjbatch
import numpy as np

from wbm.scenes.bank import SceneBank
from wbm.scenes.config import KINDS, ObjectsConfig, ScenesConfig
from wbm.scenes.generate import generate_scenes
from wbm.scenes.model import SceneModel
from wbm.scenes.sources import collect_objects
from wbm.sim.config import EVALUATE, TRAIN, SimConfig
from wbm.sim.simulation import apply_options

LIMIT = 0.005


def at_rest(
    scenes: SceneModel, bank: SceneBank, cfg: SimConfig, seconds: float, threads: int = 0
) -> list[dict[str, Any]]:
    """One row a kind: what moved, fell or was touched in `seconds` with the robot held at its start; 0 threads: all."""
    apply_options(scenes.model, cfg)
    count = len(bank)
    batch = mjbatch.Batch(scenes.model, count, threads)
    fields = {name: batch.expand(name) for name in scenes.fields}
    qpos = batch.bind("qpos")
    scenes.load_scene(fields.__getitem__, qpos, np.arange(count), bank, np.arange(count))
    batch.bind("ctrl")[:] = bank.q_start
    sensors = [batch.sensor(name) for name in scenes.sensors if name.startswith(("robot_", "hand_"))]
    before = qpos[:, scenes.object_qpos].reshape(count, -1, 7).copy()
    touched = np.zeros(count, dtype=bool)
    for _ in range(10):
        batch.step(nstep=round(seconds / 10 / cfg.dt))
        touched |= np.any([values[:, 0] > 0 for values in sensors], axis=0)
    after = qpos[:, scenes.object_qpos].reshape(count, -1, 7)
    used = bank.object >= 0
    moved = np.where(used, np.linalg.norm(after[..., :3] - before[..., :3], axis=2), 0.0).max(axis=1)
    fell = (used & (after[..., 2] < bank.surface_z[:, None])).any(axis=1)
    rows = []
    for number, kind in enumerate(KINDS):
        mine = bank.kind == number
        rows.append(
            {
                "kind": kind,
                "scenes": int(mine.sum()),
                "largest_move_mm": round(1e3 * float(moved[mine].max()), 3),
                "moved_or_fell": int((mine & ((moved > LIMIT) | fell)).sum()),
                "starts_in_contact": int((mine & touched).sum()),
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=100, help="scenes of every kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=1.0)
    options = parser.parse_args()
    objects, _ = collect_objects(ObjectsConfig(), options.seed)
    scenes = SceneModel(objects)
    bank = generate_scenes(scenes, ScenesConfig(count=options.scenes, test_count=0), options.seed)
    bank = bank.select(bank.where("train"))
    physics = {"train": TRAIN, "evaluate": EVALUATE}
    results = {name: at_rest(scenes, bank, cfg, options.seconds) for name, cfg in physics.items()}
    sys.stdout.write(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()

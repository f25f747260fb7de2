"""A made-up evaluation with films and stills for the tests of the report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from wbm.report.stats import rate, summarise
from wbm.report.video import KEY_PHASES, jpeg_bytes, write_mp4

OBJECTS = ("tall red bottle", "small blue box", "green mug", "yellow bowl", "orange can", "white cylinder")
SCENES = ("table", "shelf", "bin")
REASONS = ("dropped", "collision", "timeout", "wrong_object", "lost_target")


def picture(width: int, height: int, phase: float) -> np.ndarray:
    """A moving disc on a gradient, uint8 [height, width, 3]."""
    y, x = np.mgrid[0:height, 0:width]
    image = np.stack([40 + 120 * y / height, 60 + 90 * x / width, 120 + 0 * x], axis=-1)
    disc = (x - width * (0.2 + 0.6 * phase)) ** 2 + (y - height / 2) ** 2 < (height / 6) ** 2
    image[disc] = (235, 120, 60)
    return image.astype(np.uint8)


def make_result(folder: Path, episodes: int = 60, films: int = 4, seed: int = 0) -> dict[str, Any]:
    """An evaluation result whose files lie in `folder`."""
    rng = np.random.default_rng(seed)
    records = []
    for i in range(episodes):
        success = bool(rng.random() < 0.8)
        obj = OBJECTS[i % len(OBJECTS)]
        records.append(
            {
                "seed": i,
                "object": obj,
                "scene": SCENES[i % len(SCENES)],
                "instruction": f"pick up the {obj}",
                "success": success,
                "reason": "" if success else REASONS[int(rng.integers(len(REASONS)))],
                "time_to_grasp_s": float(rng.uniform(5, 11)) if success else None,
                "collision": not success and bool(rng.random() < 0.3),
                "wrong_object": False,
                "target_visible": float(rng.uniform(0.7, 1.0)),
                "video": None,
            }
        )
    for wanted in (True, False):
        for i in [i for i, r in enumerate(records) if r["success"] is wanted][:films]:
            name = f"episode_{i:03d}.mp4"
            write_mp4(folder / name, (picture(160, 120, t / 12) for t in range(12)), 12.5)
            records[i]["video"] = name
    first = next(r for r in records if r["success"])
    first["filmstrip"] = []
    for k, phase in enumerate(KEY_PHASES):
        for kind, size in (("outer", (240, 180)), ("camera", (160, 120))):
            (folder / f"{phase}_{kind}.jpg").write_bytes(jpeg_bytes(picture(*size, k / 4)))
        first["filmstrip"].append(
            {"phase": phase, "outer": f"{phase}_outer.jpg", "camera": f"{phase}_camera.jpg", "time_s": 2.0 * k}
        )
    steps = np.linspace(0, 1e6, 40)
    arms = []
    for key, top, wins in (("full", 9.5, 97), ("no_active_vision", 7.0, 79), ("joint_space", 2.0, 18)):
        values = [(top * (1 - np.exp(-steps / 2.5e5)) + rng.normal(0, 0.25, len(steps))).tolist() for _ in range(3)]
        counts = rate([True] * wins + [False] * (100 - wins))
        arms.append({"key": key, **counts, "target_visible": 0.9, "curve": {"steps": steps.tolist(), "values": values}})
    return {
        **summarise(records),
        "records": records,
        "figure4": [
            {
                "name": "RL stage",
                "note": "Reward: mean over 3 seeds, band from the smallest to the largest.",
                "arms": arms,
            }
        ],
        "curves": {
            "teacher reward": {"top_down": arms[0]["curve"], "side": arms[1]["curve"]},
            "student loss": {
                "student": {"steps": steps.tolist(), "values": [(0.3 * np.exp(-steps / 2e5) + 0.02).tolist()]}
            },
        },
        "config": {"evaluation": {"episodes": episodes, "split": "test", "seed": seed}},
        "provenance": {
            "policy": "student/laptop/0123456789ab",
            "commit": "abcdef0",
            "machine": "2 cores",
            "seed": seed,
        },
    }

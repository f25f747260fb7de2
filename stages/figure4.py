"""Stage figure4: the paper's Figure 4 from finished runs, as a picture, as numbers and as a page."""

from __future__ import annotations

import json
from typing import Any

KIND = "evaluation"
SECTIONS = ("seed", "figure4")
INPUTS = ("teacher/*", "evaluation/*")


def name(cfg: Any) -> str:
    """There is one."""
    return "figure4"


def run(cfg: Any, inputs: dict[str, Any], draft: Any, progress: Any) -> None:
    """Write `figure4.json`, `figure4.svg`, `figure4.png` (one of each reading) and `report.html`.

    Args:
        cfg: reads the sections in `SECTIONS`.
        inputs: runs of the RL reading by `rl/ARM/SEED`, evaluations of the student reading by `student/ARM`.
        draft: the artifact being written.
        progress: offers `message`.
    """
    from wbm.artifacts.digest import plain
    from wbm.report.figure4 import Run, gather, write_figure4

    runs = [_read(slot, artifact) for slot, artifact in sorted(inputs.items())]
    figure = gather([Run(**run) for run in runs])
    provenance = {slot: artifact.manifest.ref for slot, artifact in sorted(inputs.items())}
    config = {"seed": cfg.seed, "figure4": plain(cfg.figure4, key_only=True)}
    write_figure4(draft.path, figure, config, provenance)
    for reading in figure["readings"]:
        for arm in reading["arms"]:
            draft.metrics[f"{reading['key']}_{arm['key']}"] = arm["success_rate"]
    draft.metrics["runs"] = len(runs)


def _read(slot: str, artifact: Any) -> dict[str, Any]:
    """An input as `wbm.report.figure4.Run` takes it."""
    reading, arm, *seed = slot.split("/")
    curve = artifact.path / "curve.json"
    return {
        "reading": reading,
        "arm": arm,
        "seed": int(seed[0]) if seed else 0,
        "records": json.loads((artifact.path / "records.json").read_text()),
        "curve": json.loads(curve.read_text()) if reading == "rl" and curve.is_file() else None,
    }

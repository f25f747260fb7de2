"""The learning curve as numbers and as a picture."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

from wbm.envs.outcome import REASONS
from wbm.envs.rewards import TERMS


def save_curve(directory: Path, curve: dict[str, list[float]], steps: int, title: str) -> None:
    """Write `curve.json` (a list a quantity, an entry an iteration, null where there is none) and `curve.png`.

    Args:
        steps: environment steps of one iteration.
    """
    columns = {name: [None if math.isnan(v) else round(v, 6) for v in values] for name, values in curve.items()}
    columns = {"env_steps": [steps * (k + 1) for k in range(len(curve["reward"]))], **columns}
    (directory / "curve.json").write_text(json.dumps(columns) + "\n", encoding="utf-8")
    arrays = {name: np.array(values, np.float32) for name, values in curve.items()}
    _draw(directory / "curve.png", arrays, steps, title)


def _draw(path: Path, arrays: dict[str, np.ndarray], steps: int, title: str) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, middle, right = figure.subplots(1, 3)
    x = steps * np.arange(1, len(arrays["reward"]) + 1) / 1e6
    left.plot(x, arrays["success"], lw=0.8, label="training, stochastic")
    left.plot(x, arrays["evaluation"], lw=1.6, label="evaluation, deterministic")
    left.set(title=f"{title}: success", ylim=(0, 1), xlabel="million environment steps")
    left.legend(frameon=False, fontsize=8)
    for name in TERMS:
        middle.plot(x, arrays[f"term/{name}"], lw=0.9, label=name)
    middle.plot(x, arrays["reward"], lw=1.4, color="black", label="total")
    middle.set(title="reward terms, weighted, a step", xlabel="million environment steps")
    middle.legend(frameon=False, fontsize=7, ncols=2)
    counts = np.stack([arrays[f"outcome/{name}"] for name in REASONS[1:]])
    right.stackplot(x, counts / np.maximum(counts.sum(0), 1), labels=REASONS[1:])
    right.set(title="how training episodes end", ylim=(0, 1), xlabel="million environment steps")
    right.legend(frameon=False, fontsize=7, loc="upper left")
    figure.savefig(path, dpi=110, metadata={"Software": None})

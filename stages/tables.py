"""Text tables for people."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stages.pipeline import Outcome

_MAX_METRICS = 4


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Left-aligned columns under a header, two spaces apart."""
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in [header, *rows]
    ]
    return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]]) + "\n"


def seconds(value: float) -> str:
    """A duration as people write it."""
    if value < 60:
        return f"{value:.1f} s"
    return f"{int(value // 60)} min {int(value % 60):02d} s" if value < 3600 else f"{value / 3600:.2f} h"


def metrics_text(metrics: dict[str, Any], limit: int = _MAX_METRICS) -> str:
    """The first few numbers of a stage."""
    shown = [(k, v) for k, v in metrics.items() if isinstance(v, (int, float, str)) and not isinstance(v, bool)]
    return ", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in shown[:limit])


def results_table(outcomes: Sequence[Outcome]) -> str:
    """Stages with states, times and metrics, then the paths of the report and the bundle."""
    rows = [
        [o.node.stage.name, m.ref, o.state, seconds(m.wall_time_s), metrics_text(m.metrics)]
        for o in outcomes
        for m in (o.manifest,)
    ]
    text = "\n" + table(["stage", "artifact", "state", "time", "metrics"], rows)
    for outcome in outcomes:
        if (outcome.folder / "report.html").is_file():
            text += f"report  {_short(outcome.folder / 'report.html')}\n"
        if outcome.manifest.kind == "bundle":
            text += f"bundle  {_short(outcome.folder)}\n"
    return text


def _short(path: Path) -> Path:
    here = Path.cwd()
    return path.relative_to(here) if here in path.parents else path


def sweep_table(rows: Sequence[tuple[Sequence[str], Sequence[Outcome], str | None]]) -> str:
    """One line a run: its point of the sweep, its last artifact, the time of all its stages, metrics or the error."""
    body = []
    for point, outcomes, error in rows:
        if error is not None:
            body.append([" ".join(point), "", "failed", "", error])
            continue
        last = outcomes[-1]
        spent = sum(o.manifest.wall_time_s for o in outcomes)
        body.append(
            [" ".join(point), last.manifest.ref, last.state, seconds(spent), metrics_text(last.manifest.metrics)]
        )
    return "\n" + table(["run", "artifact", "state", "time", "metrics"], body)


def size(count: int) -> str:
    """Bytes as people write them."""
    value = float(count)
    for unit in ("B", "KiB", "MiB", "GiB"):
        if value < 1024:
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1024
    return f"{value:.1f} TiB"

"""Plots as SVG text whose inks are CSS variables, so that one file serves light and dark pages."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from wbm.report.stats import ARM_LABELS, PAPER_SUCCESS

_INK, _MUTED, _GRID = "#010101", "#020202", "#030303"  # stand-ins, replaced in the SVG
_VARIABLES = {_INK: "var(--ink, #1b1f24)", _MUTED: "var(--muted, #667080)", _GRID: "var(--grid, #d9dee5)"}
_PRINT = {_INK: "#1b1f24", _MUTED: "#667080", _GRID: "#d9dee5"}
ARM_COLOURS = {"full": "#2a7de1", "no_active_vision": "#e08a1e", "joint_space": "#c4497c"}
SERIES_COLOURS = ("#2a7de1", "#e08a1e", "#2f9e77", "#c4497c", "#7d6bd6", "#8a8f98")
FAILURE_COLOUR = "#c4497c"

_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "wbm",
    "font.family": "sans-serif",
    "font.size": 11,
    "axes.edgecolor": _GRID,
    "axes.labelcolor": _MUTED,
    "axes.titlecolor": _INK,
    "axes.titlesize": 12,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": _GRID,
    "grid.linewidth": 0.8,
    "text.color": _INK,
    "xtick.color": _MUTED,
    "ytick.color": _MUTED,
    "xtick.major.size": 0,
    "ytick.major.size": 0,
    "legend.frameon": False,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
}


def to_svg(figure: Figure, label: str, standalone: bool = False) -> str:
    """Inline SVG that scales to its container; `label` is read out by screen readers. Same figure, same text.

    With `standalone` it is a file of its own: fixed inks on white.
    """
    buffer = io.StringIO()
    with matplotlib.rc_context(_STYLE):
        figure.savefig(
            buffer, format="svg", bbox_inches="tight", pad_inches=0.05, metadata={"Date": None, "Creator": None}
        )
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    for stand_in, variable in (_PRINT if standalone else _VARIABLES).items():
        svg = svg.replace(stand_in, variable)
    svg = re.sub(r"font: (?:[\w.]+ )*?([\d.]+)px [^;\"]*", r"font: \1px var(--font, sans-serif)", svg)
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.S)
    # Ids must differ between the figures of one page.
    prefix = re.sub(r"\W+", "-", label.lower())[:40]
    svg = re.sub(r'id="([^"]+)"', rf'id="{prefix}-\1"', svg)
    svg = re.sub(r"url\(#([^)]+)\)", rf"url(#{prefix}-\1)", svg)
    svg = re.sub(r'href="#([^"]+)"', rf'href="#{prefix}-\1"', svg)
    title = label.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    width, height = (float(re.search(rf'{side}="([\d.]+)pt"', svg).group(1)) for side in ("width", "height"))  # type: ignore[union-attr]
    ground = "background:#fff;" if standalone else ""
    size = f"width:100%;height:auto;max-width:{width * 4 / 3:.0f}px"
    head = f'<svg role="img" aria-label="{title}" style="{ground}{size}" '
    svg = re.sub(r'(width|height)="[\d.]+pt" ', "", svg, count=2)
    assert height > 0
    return svg.replace("<svg ", head, 1)


def to_png(figure: Figure, path: Any, dpi: int = 160) -> None:
    """Save for print: the same figure with fixed inks on white."""
    for artist in figure.findobj():
        for kind in ("color", "edgecolor", "facecolor"):
            getter, setter = getattr(artist, f"get_{kind}", None), getattr(artist, f"set_{kind}", None)
            if getter is None or setter is None:
                continue
            try:
                name = matplotlib.colors.to_hex(getter())
            except (ValueError, TypeError):
                continue
            if name in _PRINT:
                setter(_PRINT[name])
    figure.savefig(path, dpi=dpi, bbox_inches="tight", facecolor="white", metadata={"Software": None})


def _figure(width: float, height: float, columns: int = 1, **options: Any) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(1, columns, **options)


def draw_curves(ax: Axes, curves: dict[str, dict[str, Any]], colours: dict[str, str], xlabel: str, ylabel: str) -> None:
    """Mean over seeds with a band from the smallest to the largest, one line a key, named at its end."""
    ends = []
    for i, (name, curve) in enumerate(curves.items()):
        x, y = np.asarray(curve["steps"], dtype=float), np.atleast_2d(np.asarray(curve["values"], dtype=float))
        colour = colours.get(name, SERIES_COLOURS[i % len(SERIES_COLOURS)])
        ax.plot(x, y.mean(axis=0), color=colour, linewidth=2, label=ARM_LABELS.get(name, name), solid_capstyle="round")
        if len(y) > 1:
            ax.fill_between(x, y.min(axis=0), y.max(axis=0), color=colour, alpha=0.18, linewidth=0)
        ends.append((x[-1], y.mean(axis=0)[-1], colour))
    ax.set_xlabel(xlabel)
    ax.set_ylabel(ylabel)
    ax.margins(x=0.01)
    for x, y, colour in ends:
        ax.plot([x], [y], "o", color=colour, markersize=4, clip_on=False)
    if len(curves) > 1:
        ax.legend(loc="best", labelcolor=_INK, fontsize=10)
    ax.xaxis.set_major_formatter(lambda v, _: _short(v))
    ax.yaxis.set_major_formatter(lambda v, _: _short(v))


def draw_success(ax: Axes, arms: Sequence[dict[str, Any]]) -> None:
    """Success bars with 95 % intervals; the paper's value as an open diamond beside each."""
    for i, arm in enumerate(arms):
        value, (low, high) = 100 * arm["success_rate"], (100 * b for b in arm["success_ci95"])
        colour = ARM_COLOURS.get(arm["key"], SERIES_COLOURS[i % len(SERIES_COLOURS)])
        ax.bar(i, value, width=0.52, color=colour, alpha=0.9)
        ax.errorbar(
            i, value, yerr=[[max(0.0, value - low)], [max(0.0, high - value)]], color=_INK, capsize=4, linewidth=1.4
        )
        ax.annotate(
            f"{value:.0f}", (i, high), xytext=(0, 5), textcoords="offset points", ha="center", fontweight="bold"
        )
        if arm["key"] in PAPER_SUCCESS:
            ax.plot(
                i + 0.37,
                100 * PAPER_SUCCESS[arm["key"]],
                "D",
                markersize=6,
                markerfacecolor="none",
                markeredgecolor=_INK,
                clip_on=False,
            )
    ax.plot([], [], "D", markersize=6, markerfacecolor="none", markeredgecolor=_INK, linestyle="none", label="paper")
    ax.set_xticks(
        range(len(arms)),
        [arm.get("label", ARM_LABELS.get(arm["key"], arm["key"])).replace(" ", "\n", 1) for arm in arms],
        color=_INK,
    )
    ax.set_ylim(0, 112)
    ax.set_yticks(range(0, 101, 20))
    ax.set_ylabel("lifting success (%)")
    ax.grid(axis="x", visible=False)
    ax.legend(loc="upper right", labelcolor=_INK, fontsize=10)


def figure4(arms: Sequence[dict[str, Any]], title: str = "") -> Figure:
    """The paper's Figure 4 in one picture: (a) training reward with bands, (b) lifting success with intervals.

    Without curves only (b) is drawn.

    Args:
        arms: dictionaries with `key`, `success_rate`, `success_ci95`, and `curve` (`steps`, `values` [seeds][steps]).
        title: heading over both panels.
    """
    curves = _arm_curves(arms)
    with matplotlib.rc_context(_STYLE):
        if curves:
            figure, (left, right) = _figure(9.6, 3.7, 2, width_ratios=(1.35, 1))
            draw_curves(left, curves, ARM_COLOURS, "environment steps", "reward a step")
            left.set_title("(a) Training reward")
        else:
            figure, right = _figure(4.4, 3.7)
        draw_success(right, arms)
        right.set_title("(b) Lifting success")
        if title:
            figure.suptitle(title, x=0.01, ha="left", fontsize=12, color=_INK)
    return figure


def figure4_panels(arms: Sequence[dict[str, Any]]) -> tuple[Figure | None, Figure]:
    """The two panels of `figure4`, for pages that stack them; the first is None without curves."""
    with matplotlib.rc_context(_STYLE):
        left = None
        if curves := _arm_curves(arms):
            left, ax = _figure(4.9, 3.4)
            draw_curves(ax, curves, ARM_COLOURS, "environment steps", "reward a step")
            ax.set_title("(a) Training reward")
        right, ax = _figure(4.1, 3.4)
        draw_success(ax, arms)
        ax.set_title("(b) Lifting success")
    return left, right


def _arm_curves(arms: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {a["key"]: a["curve"] for a in arms if a.get("curve")}


def curves_figure(curves: dict[str, dict[str, Any]], ylabel: str, xlabel: str = "steps") -> Figure:
    """Training curves of one quantity."""
    with matplotlib.rc_context(_STYLE):
        figure, ax = _figure(4.9, 3.0)
        draw_curves(ax, curves, ARM_COLOURS, xlabel, ylabel)
    return figure


def failure_figure(failures: dict[str, int], episodes: int) -> Figure:
    """Horizontal bars of failures by reason, as a share of all episodes."""
    with matplotlib.rc_context(_STYLE):
        figure, ax = _figure(4.6, 0.55 + 0.38 * max(1, len(failures)))
        names = list(failures)[::-1]
        values = [100 * failures[n] / max(1, episodes) for n in names]
        ax.barh(range(len(names)), values, height=0.6, color=FAILURE_COLOUR, alpha=0.9)
        for i, (name, value) in enumerate(zip(names, values, strict=True)):
            ax.annotate(
                f"{failures[name]}",
                (value, i),
                xytext=(5, 0),
                textcoords="offset points",
                va="center",
                fontweight="bold",
            )
        ax.set_yticks(range(len(names)), [n.replace("_", " ") for n in names], color=_INK)
        ax.set_xlabel("share of all episodes (%)")
        ax.set_xlim(0, max([1.0, *values]) * 1.12)
        ax.grid(axis="y", visible=False)
    return figure


def _short(value: float) -> str:
    for limit, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= limit:
            return f"{value / limit:g}{unit}"
    return f"{value:g}"

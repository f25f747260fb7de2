"""The report: one self-contained HTML file that opens from disk on a desktop or a phone, without a network."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2

from wbm.report.plots import curves_figure, failure_figure, figure4_panels, to_svg
from wbm.report.stats import ARM_LABELS, PAPER_SUCCESS, percent, verdict
from wbm.report.video import KEY_PHASES, data_uri

_TEMPLATE = Path(__file__).with_name("page.html.j2")
_STYLE = Path(__file__).with_name("style.css")
_OBJECTS_SHOWN = 12


def write_page(
    path: str | Path,
    result: dict[str, Any],
    base: str | Path | None = None,
    title: str = "Whole-body grasping: evaluation",
    embed_mb: float = 24.0,
) -> Path:
    """Write the report of an evaluation.

    Args:
        path: the HTML file.
        result: the keys of `stats.summarise`, and optionally `records` (one dictionary an episode, see `summarise`;
            with `seed`, `instruction`, `video`: path or None, `filmstrip`: list of `phase`, `outer`, `camera` (paths),
            `time_s`), `curves` (name -> {arm -> {`steps`, `values`}}), `figure4` (list of `name`, `note`, `arms` as
            `plots.figure4` takes them), `notes` (sentences), `config` and `provenance` (JSON-ready).
        base: folder that paths in `result` are relative to; the page's folder by default.
        title: heading.
        embed_mb: largest total size of embedded videos, MB; failures of different reasons and successes come first.

    Returns:
        The path.

    Raises:
        FileNotFoundError: a video or still that `result` names does not exist.
    """
    path = Path(path)
    base = path.parent if base is None else Path(base)
    records = [
        {"time_to_grasp_s": None, "reason": "", "instruction": "", "seed": 0, **r} for r in result.get("records", [])
    ]
    successes, failed, left_out = _films(records, base, int(embed_mb * 1e6))
    objects = _worst_first(result["by_object"])
    names = list(objects)
    figures = [_figure4_item(item) for item in result.get("figure4", [])]
    strips = [_strip(r, base) for r in records if r.get("filmstrip")]
    curves = [
        {"name": name, "svg": to_svg(curves_figure(c, name), f"Curve of {name}")}
        for name, c in result.get("curves", {}).items()
    ]
    failures = result["failures"]
    sections = [
        ("summary", "Summary", True),
        ("figure4", "Ablations", figures),
        ("filmstrip", "Filmstrip", strips),
        ("successes", "Successes", successes),
        ("failures", "Failures", True),
        ("curves", "Training", curves),
        ("breakdown", "Breakdown", True),
        ("provenance", "Provenance", True),
    ]
    return render(
        _TEMPLATE,
        path,
        title=title,
        lead=_lead(result),
        r=result,
        phases=KEY_PHASES,
        sections=[(key, name) for key, name, there in sections if there],
        notes=[*result.get("notes", []), *(note for item in figures for note in item["verdict"])],
        figures4=figures,
        strips=strips,
        successes=successes,
        failed=failed,
        left_out=left_out,
        failure_svg=to_svg(failure_figure(failures, result["episodes"]), "Failures by reason") if failures else "",
        n_failures=sum(failures.values()),
        curves=curves,
        objects_first={n: objects[n] for n in names[:_OBJECTS_SHOWN]},
        objects_rest={n: objects[n] for n in names[_OBJECTS_SHOWN:]},
        provenance={k: v if isinstance(v, str) else json.dumps(v) for k, v in result.get("provenance", {}).items()},
        config=json.dumps(result["config"], indent=2, sort_keys=True) if result.get("config") else "",
        records=records,
    )


def render(template: Path, path: Path, **values: Any) -> Path:
    """Fill a template, which also gets `style` and `pct`, and write it whole or not at all; returns the path."""
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    style = _STYLE.read_text(encoding="utf-8")
    html = environment.from_string(template.read_text(encoding="utf-8")).render(style=style, pct=percent, **values)
    partial = path.with_name(path.name + ".partial")
    partial.write_text(html, encoding="utf-8")
    os.replace(partial, path)
    return path


def _lead(result: dict[str, Any]) -> str:
    policy = result.get("provenance", {}).get("policy", "The policy")
    where = result.get("config", {}).get("evaluation", {}).get("split")
    on = {"test": " that it has not been trained on", "train": " that it has been trained on"}.get(where, "")
    count = len({r["object_name"] for r in result.get("records", []) if "object_name" in r})
    what = (
        f"{count} objects{on} ({', '.join(result['by_object'])})"
        if count
        else f"{len(result['by_object'])} objects{on}"
    )
    return f"{policy} on {what}, in {len(result['by_scene'])} kinds of scene ({', '.join(result['by_scene'])})."


def _worst_first(groups: dict[str, Any]) -> dict[str, Any]:
    return dict(sorted(groups.items(), key=lambda kv: (kv[1]["success_rate"], kv[0])))


def _films(records: Sequence[dict[str, Any]], base: Path, budget: int) -> tuple[list[dict], list[dict], int]:
    """Embed videos: one of each reason first, then the others in order, while they fit."""
    filmed = [r for r in records if r.get("video")]
    firsts: dict[str, int] = {}
    for i, record in enumerate(filmed):
        firsts.setdefault("" if record["success"] else record["reason"], i)
    order = [*firsts.values(), *(i for i in range(len(filmed)) if i not in firsts.values())]
    chosen: dict[int, dict] = {}
    for i in order:
        data = (base / filmed[i]["video"]).read_bytes()
        if len(data) <= budget:
            budget -= len(data)
            chosen[i] = {**filmed[i], "uri": data_uri(data, "video/mp4")}
    shown = [chosen[i] for i in sorted(chosen)]
    return [s for s in shown if s["success"]], [s for s in shown if not s["success"]], len(filmed) - len(shown)


def _strip(record: dict[str, Any], base: Path) -> dict[str, Any]:
    def image(name: str | None) -> str:
        return (
            data_uri((base / name).read_bytes(), "image/png" if name.endswith(".png") else "image/jpeg") if name else ""
        )

    frames = [
        {"phase": f["phase"], "outer": image(f["outer"]), "camera": image(f.get("camera")), "time_s": f.get("time_s")}
        for f in record["filmstrip"]
    ]
    return {**record, "frames": frames}


def _figure4_item(item: dict[str, Any]) -> dict[str, Any]:
    arms = [
        {
            "target_visible": None,
            **a,
            "label": a.get("label", ARM_LABELS.get(a["key"], a["key"])),
            "paper": PAPER_SUCCESS.get(a["key"]),
        }
        for a in item["arms"]
    ]
    name = item.get("name", "")
    panels = zip(("reward", "success"), figure4_panels(arms), strict=True)
    svgs = [to_svg(figure, f"Figure 4 {name} {what}") for what, figure in panels if figure is not None]
    return {"name": name, "note": item.get("note", ""), "arms": arms, "svgs": svgs, "verdict": verdict(name, arms)}

"""Fill `docs/results/` from published artifacts: pages, figures, numbers, and what it takes to make them again.

    python benchmarks/publish_results.py [--root artifacts] [--to docs/results] [--machine TEXT] [ARTIFACT ...]

Without artifacts it takes `evaluation/main` and, where there is one, `evaluation/figure4`. Nothing is computed here:
every number is read from an artifact that the store has verified.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from wbm.artifacts.errors import ArtifactError, Missing
from wbm.artifacts.manifest import Manifest
from wbm.artifacts.store import Artifact, Store

DEFAULT = ("evaluation/main", "evaluation/figure4")
FILES = ("report.html", "summary.json", "figure4.json", "figure4.svg", "figure4.png", "figure4-student.svg",
         "figure4-student.png", "curve.png", "curve.json")  # fmt: skip
LARGE = 12 << 20
_LEFT_OUT = ("artifacts.root=", "--json", "--debug", "--force")


def publish(store: Store, names: Sequence[str], target: Path, machine: str) -> list[str]:
    """Copy what `names` show into `target`, replacing what an earlier call put there.

    Args:
        names: artifacts, as `Store.resolve` takes them.
        target: folder; receives one folder an artifact, `results.json` and `README.md`.
        machine: what the artifacts were made on, in words.

    Returns:
        Warnings.

    Raises:
        ArtifactError: an artifact is missing or damaged.
    """
    shown = [store.resolve(name) for name in names]
    problems = store.verify([artifact.ref for artifact in shown])
    if problems:
        raise ArtifactError(f"damaged: {problems[0]}; make it again before publishing it")
    line = lineage(store, shown)
    partial = target.with_name(target.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    warnings = []
    for artifact in [*shown, *(store.resolve(m.ref) for m in line if m.kind in ("teacher", "student"))]:
        folder = partial / f"{artifact.manifest.kind}-{artifact.manifest.name}"
        for name in FILES:
            source = artifact.path / name
            if source.is_file():
                folder.mkdir(exist_ok=True)
                shutil.copyfile(source, folder / name)
                if source.stat().st_size > LARGE:
                    warnings.append(f"{name} of {artifact.ref} has {source.stat().st_size >> 20} MiB; lower embed_mb")
    dirty = [m.ref for m in line if m.git.get("dirty")]
    if dirty:
        warnings.append(f"{dirty[0]} was made from a checkout with uncommitted changes")
    record = {"machine": machine, "commands": commands(line), "artifacts": [entry(m) for m in line]}
    (partial / "results.json").write_text(json.dumps(record, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    (partial / "README.md").write_text(readme(shown, line, machine), encoding="utf-8")
    shutil.rmtree(target, ignore_errors=True)
    os.replace(partial, target)
    return warnings


def lineage(store: Store, shown: Sequence[Artifact]) -> list[Manifest]:
    """Manifests of the artifacts and of all that they were made from, oldest first."""
    found: dict[str, Manifest] = {}
    waiting = [artifact.manifest for artifact in shown]
    while waiting:
        manifest = waiting.pop()
        if manifest.ref in found:
            continue
        found[manifest.ref] = manifest
        waiting += [store.manifest(item.ref) for item in manifest.inputs.values()]
    return sorted(found.values(), key=lambda m: (m.created, m.ref))


def commands(line: Sequence[Manifest]) -> list[str]:
    """The commands that made the artifacts, each once, without what belongs to the machine alone."""
    out: dict[str, None] = {}
    for manifest in line:
        words = shlex.split(manifest.command)[1:]
        out[shlex.join(["wbm", *(w for w in words if not w.startswith(_LEFT_OUT))])] = None
    return list(out)


def entry(m: Manifest) -> dict[str, Any]:
    """What `results.json` says of an artifact."""
    keep = ("threads", "cpu_capability", "machine", "system")
    return {
        "artifact": m.ref,
        "created": m.created,
        "seconds": m.wall_time_s,
        "seeds": m.seeds,
        "commit": m.git.get("commit", ""),
        "content_digest": m.content_digest,
        "environment": {k: m.environment[k] for k in keep if k in m.environment},
        "metrics": m.metrics,
    }


def readme(shown: Sequence[Artifact], line: Sequence[Manifest], machine: str) -> str:
    """The page that leads to the others."""
    text = ["# Results", "", f"Made on: {machine}.", ""]
    for artifact in shown:
        folder = f"{artifact.manifest.kind}-{artifact.manifest.name}"
        text += [f"## {artifact.manifest.kind}/{artifact.manifest.name}", ""]
        if (artifact.path / "figure4.json").is_file():
            text += [f"![Figure 4]({folder}/figure4.png)", ""]
            text += _figure4_table(json.loads((artifact.path / "figure4.json").read_text()))
        else:
            text += _summary_table(artifact.manifest.metrics)
        text += [
            "",
            f"The page: [{folder}/report.html]({folder}/report.html) (download it and open it in a browser).",
            "",
        ]
    text += ["## Made by", "", "```", *commands(line), "```", ""]
    text += ["| artifact | seeds | seconds, last sitting | commit |", "| --- | --- | --- | --- |"]
    for m in line:
        seeds = ", ".join(f"{k} {v}" for k, v in m.seeds.items())
        text.append(f"| {m.ref} | {seeds} | {m.wall_time_s:.0f} | {m.git.get('commit', '')[:10]} |")
    return "\n".join([*text, "", "Every number with its provenance: [results.json](results.json).", ""])


def _figure4_table(figure: dict[str, Any]) -> list[str]:
    rows = [
        "| reading | arm | success | 95 % interval | paper | target in view | runs x episodes |",
        "| --- " * 7 + "|",
    ]
    said = []
    for reading in figure["readings"]:
        for arm in reading["arms"]:
            low, high = arm["success_ci95"]
            seen = "" if arm["target_visible"] is None else f"{100 * arm['target_visible']:.0f} %"
            rows.append(
                f"| {reading['name']} | {arm['label']} | **{100 * arm['success_rate']:.1f} %** | {100 * low:.1f} to "
                f"{100 * high:.1f} % | {100 * arm['paper']:.0f} % | {seen} | {len(arm['runs'])} x "
                f"{arm['runs'][0]['episodes']} |"
            )
        said += [f"- {sentence}" for sentence in reading["verdict"]]
    return [*rows, "", *said]


def _summary_table(m: dict[str, Any]) -> list[str]:
    low, high = m["success_ci95"]
    percent = lambda v: "" if v is None else f"{100 * v:.1f} %"
    time = m.get("time_to_grasp_s")
    return [
        "| episodes | success | 95 % interval | collisions | wrong object | target in view | time to grasp |",
        "| --- " * 7 + "|",
        f"| {m['episodes']} | **{percent(m['success_rate'])}** | {100 * low:.1f} to {100 * high:.1f} % | "
        f"{percent(m.get('collision_rate'))} | {percent(m.get('wrong_object_rate'))} | "
        f"{percent(m.get('target_visible'))} | {'' if time is None else f'{time:.1f} s'} |",
    ]


def this_machine() -> str:
    """Cores, processor and system of the machine that this runs on."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [s.partition(":")[2].strip() for s in cpuinfo.read_text().splitlines() if s.startswith("model name")]
        model = names[0] if names else model
    return f"{os.cpu_count()} cores, {model}, {platform.system()}, no GPU used unless a command says so"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Fill docs/results/ from published artifacts.")
    parser.add_argument("artifacts", nargs="*", help="default: evaluation/main and evaluation/figure4")
    parser.add_argument("--root", default="artifacts", help="the store")
    parser.add_argument("--to", type=Path, default=Path("docs/results"))
    parser.add_argument("--machine", default="", help="what they were made on; default: this machine")
    options = parser.parse_args()
    store = Store.open(options.root)
    names = options.artifacts
    if not names:
        for name in DEFAULT:
            try:
                names.append(store.manifest(name).ref)
            except Missing:
                continue
    if not names:
        parser.error(f"{options.root} holds neither {' nor '.join(DEFAULT)}; run `wbm run` first")
    for warning in publish(store, names, options.to, options.machine or this_machine()):
        print(f"warning: {warning}")
    print(f"{options.to / 'README.md'} shows {', '.join(names)}")


if __name__ == "__main__":
    main()

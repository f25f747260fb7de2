"""`wbm bundle`: look at what the pipeline ends with, and try it out before it moves a robot."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from typer import Exit

from stages.commands import Options, composer, emit, open_store, run_once
from stages.convert import ConfigError
from wbm.artifacts.reference import is_reference

if TYPE_CHECKING:
    from wbm.deploy.bundle import Bundle

_WIDTH = 160


def show(path: str, overrides: Sequence[str], as_json: bool) -> None:
    """Print what a person wants to know first.

    Raises:
        ConfigError: there is no bundle.
        BundleError: it is damaged; the message names the part.
    """
    _print(_open(path, overrides).show(), as_json)


def verify(path: str, overrides: Sequence[str], as_json: bool) -> None:
    """Check everything that `show` checks, and the golden vectors; raises as `show`."""
    _print(_open(path, overrides).verify(), as_json)


def replay_log(log: str, path: str, overrides: Sequence[str], as_json: bool) -> None:
    """Run a bundle on the observations of a log and print how far its actions are from those that were logged.

    Raises:
        ConfigError: there is no log or no bundle.
        ValueError: the log holds no observations, or those of another schema.
    """
    from wbm.deploy.log import replay

    composer(overrides)  # a wrong setting is named first
    if not Path(log).is_file():
        raise ConfigError(f"{log}: no such file; name a log that RunLog or `wbm bundle soak --log FILE` wrote")
    _print(replay(log, _open(path, overrides)), as_json)


def soak_bundle(path: str, overrides: Sequence[str], minutes: float, log: str | None, as_json: bool) -> None:
    """Run a bundle in closed loop in real time; exit with 1 when a deadline was missed or memory grew."""
    from wbm.deploy.soak import soak

    if minutes <= 0:
        raise ConfigError(f"--minutes {minutes:g}: must be positive")
    answer = soak(_open(path, overrides), minutes, Path(log) if log else None)
    _print(answer, as_json)
    if not answer["ok"]:
        raise Exit(1)


def compare(overrides: Sequence[str], as_json: bool) -> None:
    """Evaluate a bundle and the student that it was made from on the same episodes; exit with 1 when they disagree.

    Args:
        overrides: settings of the evaluation; `policy=bundle/NAME` picks the bundle, by default `bundle/main`.
        as_json: print one JSON document.
    """
    from stages.bundle_check import compare_records, parity_per_step

    config = composer(overrides)
    store = open_store(config)
    bundle = store.resolve(config.policy or "bundle/main")
    if bundle.manifest.kind != "bundle":
        raise ConfigError(f"policy={bundle.manifest.ref}: name a bundle, for example policy=bundle/main")
    student, assets = (bundle.manifest.inputs[slot].ref for slot in ("student", "assets"))
    settings = [line for line in overrides if not line.startswith("policy=")]
    folders = {}
    for name, ref in (("student", student), ("bundle", bundle.manifest.ref)):
        lines = [*settings, f"policy={ref}", f"inputs.assets={assets}"]
        folders[name] = run_once(Options("evaluate", tuple(lines)), lines)[0].folder
    answer = compare_records(folders["student"], folders["bundle"])
    answer |= parity_per_step(store.resolve(student).path, bundle.path / "policy.wbm", folders["student"])
    answer |= {"ok": answer["intervals_overlap"] and answer["parity_max"] <= answer["parity_tolerance"]}
    _print({"bundle_artifact": bundle.manifest.ref, "student_artifact": student, **answer}, as_json)
    if not answer["ok"]:
        raise Exit(1)


def _open(path: str, overrides: Sequence[str]) -> Bundle:
    from wbm.deploy.bundle import Bundle

    place, config = Path(path), composer(overrides)
    if not place.exists() and (path.startswith("bundle/") or is_reference(path)):
        place = open_store(config).resolve(path, ("bundle",)).path
    if not place.exists():
        raise ConfigError(f"{path}: no such file; name a bundle's file, its folder, or bundle/NAME in the store")
    return Bundle.open(place / "policy.wbm" if place.is_dir() else place)


def _print(answer: Mapping[str, Any], as_json: bool) -> None:
    if as_json:
        emit(answer)
        return
    width = max(len(key) for key in answer) + 2
    for key, value in answer.items():
        text = f"{value:.4g}" if isinstance(value, float) else str(value)
        sys.stdout.write(f"{key:<{width}}{text if len(text) <= _WIDTH else text[: _WIDTH - 3] + '...'}\n")

"""`wbm bench`: the project's own benchmarks beside the peers, in one run."""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from stages.commands import emit
from stages.convert import ConfigError, nearest
from stages.progress import Progress
from stages.tables import table

# suite -> a function that can do without arguments and returns a tree of figures; adding a suite is one line
SUITES = {
    "wbc": "wbm.control.bench:bench_wbc",
    "sensors": "wbm.sensors.bench:bench_sensors",
    "data": "wbm.learning.bench:bench_data",
    "student": "wbm.learning.bench:bench_student",
    "env": "wbm.learning.bench_env:bench_env",
}


def bench(suite: str, settings: Sequence[str], as_json: bool) -> None:
    """Run one suite, or `all`, and print its figures.

    Args:
        suite: name of a suite, or `all`.
        settings: NAME=VALUE for whole numbers and switches of a single suite, such as `steps=1000000`.
        as_json: one JSON document in place of a table.

    Raises:
        ConfigError: no such suite, or a setting that it does not have.
    """
    if suite != "all" and suite not in SUITES:
        raise ConfigError(f"bench {suite}: no such suite{nearest(suite, [*SUITES, 'all'])}")
    if suite == "all" and settings:
        raise ConfigError(f"bench all: {settings[0]} belongs to one suite; name that suite")
    results: dict[str, Any] = {}
    with Progress() as progress:
        for name in progress.track(list(SUITES) if suite == "all" else [suite], "bench"):
            module, _, function = SUITES[name].partition(":")
            run = getattr(importlib.import_module(module), function)
            results[name] = run(**_arguments(suite, run, settings))
    if as_json:
        emit(results if suite == "all" else results[suite])
    else:
        sys.stdout.write(table(["figure", "value"], [[k, _text(v)] for k, v in _leaves(results)]))


def _arguments(suite: str, function: Any, settings: Sequence[str]) -> dict[str, Any]:
    """The settings as arguments of the suite's function: those whose default is a whole number or a switch."""
    known = {
        name: type(p.default)
        for name, p in inspect.signature(function).parameters.items()
        if type(p.default) in (int, bool)
    }
    out: dict[str, Any] = {}
    for setting in settings:
        name, _, value = setting.partition("=")
        if name not in known:
            raise ConfigError(f"bench {suite}: no setting {name!r}{nearest(name, list(known))}")
        try:
            out[name] = {"true": True, "false": False}[value] if known[name] is bool else int(value)
        except (KeyError, ValueError):
            kind = "true or false" if known[name] is bool else "a whole number"
            raise ConfigError(f"bench {suite}: {name} is {value!r}, give {kind}") from None
    return out


def _leaves(value: Any, where: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for name, item in value.items():
            yield from _leaves(item, f"{where}.{name}" if where else str(name))
    elif isinstance(value, (list, tuple)):
        for i, item in enumerate(value):
            yield from _leaves(item, f"{where}[{i}]")
    else:
        yield where, value


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)

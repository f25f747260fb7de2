"""`wbm bench`: the project's own benchmarks beside the peers, in one run."""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from stages.commands import composer, emit
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
        settings: NAME=VALUE for whole numbers and switches of a single suite, such as `steps=1000000`. What else stands
            there is checked against the configuration; the suites fix their own.
        as_json: one JSON document in place of a table.

    Raises:
        ConfigError: no such suite, or a setting that neither it nor the configuration has.
    """
    if suite != "all" and suite not in SUITES:
        raise ConfigError(f"bench {suite}: no such suite{nearest(suite, [*SUITES, 'all'])}")
    names = {} if suite == "all" else _known(_function(suite))
    own = [s for s in settings if s.partition("=")[0] in names and s.partition("=")[0] != "seed"]
    composer([s for s in settings if s not in own])
    results: dict[str, Any] = {}
    with Progress() as progress:
        for name in progress.track(list(SUITES) if suite == "all" else [suite], "bench"):
            results[name] = _function(name)(**_arguments(suite, names, own))
    if as_json:
        emit(results if suite == "all" else results[suite])
    else:
        sys.stdout.write(table(["figure", "value"], [[k, _text(v)] for k, v in _leaves(results)]))


def _function(suite: str) -> Callable[..., Mapping[str, Any]]:
    module, _, function = SUITES[suite].partition(":")
    return getattr(importlib.import_module(module), function)


def _known(function: Callable[..., Any]) -> dict[str, type]:
    """The function's settings by name: those whose default is a whole number or a switch."""
    parameters = inspect.signature(function).parameters
    return {name: type(p.default) for name, p in parameters.items() if type(p.default) in (int, bool)}


def _arguments(suite: str, known: Mapping[str, type], settings: Sequence[str]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for setting in settings:
        name, _, value = setting.partition("=")
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

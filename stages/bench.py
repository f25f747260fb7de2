"""`wbm bench`: the project's own benchmarks beside the peers, in one run."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator, Mapping
from typing import Any

from stages.commands import emit
from stages.convert import ConfigError, nearest
from stages.progress import Progress
from stages.tables import table

# suite -> a function that takes no argument and returns a tree of figures; adding a suite is one line
SUITES = {
    "sensors": "wbm.sensors.bench:bench_sensors",
    "data": "wbm.learning.bench:bench_data",
    "student": "wbm.learning.bench:bench_student",
    "env": "wbm.learning.bench_env:bench_env",
}


def bench(suite: str, as_json: bool) -> None:
    """Run one suite, or `all`, and print its figures.

    Raises:
        ConfigError: no such suite.
    """
    if suite != "all" and suite not in SUITES:
        raise ConfigError(f"bench {suite}: no such suite{nearest(suite, [*SUITES, 'all'])}")
    results: dict[str, Any] = {}
    with Progress() as progress:
        for name in progress.track(list(SUITES) if suite == "all" else [suite], "bench"):
            module, _, function = SUITES[name].partition(":")
            results[name] = getattr(importlib.import_module(module), function)()
    if as_json:
        emit(results if suite == "all" else results[suite])
    else:
        sys.stdout.write(table(["figure", "value"], [[k, _text(v)] for k, v in _leaves(results)]))


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

"""Arguments and options that several commands share, and how a command loads what it needs."""

from __future__ import annotations

import importlib
from typing import Annotated, Any

import typer

Overrides = Annotated[
    list[str] | None,
    typer.Argument(metavar="[OVERRIDE]...", help="Settings as KEY=VALUE in Hydra's grammar.", show_default=False),
]
Items = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[ARTIFACT]... [artifacts.root=DIR]",
        help="kind/name[/key] or reference[/name].",
        show_default=False,
    ),
]
Cfg = Annotated[bool, typer.Option("--cfg", help="Print the resolved configuration and stop.")]
Info = Annotated[bool, typer.Option("--info", help="Print the defaults list and stop.")]
Multi = Annotated[bool, typer.Option("-m", "--multirun", help="Sweep: a,b and range() give a run each.")]
Launcher = Annotated[str, typer.Option("--launcher", help="Where to run: local or slurm.")]
Detach = Annotated[bool, typer.Option("--detach", help="Submit and return at once.")]
Force = Annotated[bool, typer.Option("--force", help="Run even if up to date, from the beginning.")]
Source = Annotated[
    str | None, typer.Option("--from", metavar="reference", help="Let reference results stand in for long stages.")
]
Until = Annotated[str | None, typer.Option("--until", metavar="STAGE", help="Stop after this stage.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
Figure4 = Annotated[
    bool, typer.Option("--figure4", help="The paper's three arms instead, every seed; continues where it stopped.")
]
Json = Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")]


def call(module: str, function: str, *args: Any) -> None:
    """Call a function of `stages.<module>`, which is imported only now."""
    getattr(importlib.import_module(f"stages.{module}"), function)(*args)

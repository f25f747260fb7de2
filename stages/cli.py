"""The command line. Imports nothing heavy: each command loads what it needs when it runs."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

app = typer.Typer(
    name="wbm",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Learn whole-body grasping in simulation: from assets to a deployable policy. "
    "Settings follow as KEY=VALUE, for example profile=laptop seed=1.",
)
artifacts_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Look after what the stages published.")
app.add_typer(artifacts_app, name="artifacts")

Overrides = Annotated[
    list[str] | None,
    typer.Argument(metavar="[OVERRIDE]...", help="Settings as KEY=VALUE in Hydra's grammar.", show_default=False),
]
Cfg = Annotated[bool, typer.Option("--cfg", help="Print the resolved configuration and stop.")]
Info = Annotated[bool, typer.Option("--info", help="Print the defaults list and stop.")]
Multi = Annotated[bool, typer.Option("-m", "--multirun", help="Sweep: a,b and range() give a run each.")]
Launcher = Annotated[str, typer.Option("--launcher", help="Where to run: local or slurm.")]
Detach = Annotated[bool, typer.Option("--detach", help="Submit and return at once.")]
Force = Annotated[bool, typer.Option("--force", help="Run even if up to date, from the beginning.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
Json = Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")]


@app.command()
def run(
    overrides: Overrides = None,
    cfg: Cfg = False,
    info: Info = False,
    multirun: Multi = False,
    launcher: Launcher = "local",
    detach: Detach = False,
    force: Force = False,
    debug: Debug = False,
    as_json: Json = False,
) -> None:
    """Run all six stages in order; skip what is up to date, continue what was interrupted."""
    from stages.commands import run_command

    run_command(None, overrides or [], cfg, info, multirun, launcher, detach, force, as_json)


def _stage_command(name: str, text: str) -> None:
    def command(
        overrides: Overrides = None,
        cfg: Cfg = False,
        info: Info = False,
        multirun: Multi = False,
        launcher: Launcher = "local",
        detach: Detach = False,
        force: Force = False,
        debug: Debug = False,
        as_json: Json = False,
    ) -> None:
        from stages.commands import run_command

        run_command(name, overrides or [], cfg, info, multirun, launcher, detach, force, as_json)

    command.__doc__ = text
    app.command(name)(command)


_stage_command("prepare-assets", "Stage 1: objects, convex parts and settled scenes.")
_stage_command("train-teacher", "Stage 2: one local grasping teacher, by reinforcement learning.")
_stage_command("generate-rollouts", "Stage 3: successful whole-body trajectories with rendered observations.")
_stage_command("distill", "Stage 4: one student that sees point clouds and an instruction.")
_stage_command("evaluate", "Stage 5: closed-loop success on held-out objects, with a report.")
_stage_command("deploy-export", "Stage 6: the bundle that runs on the robot.")


@app.command()
def plan(
    overrides: Overrides = None,
    check: Annotated[bool, typer.Option("--check", help="Exit with 3 when a stage would run.")] = False,
    debug: Debug = False,
    as_json: Json = False,
) -> None:
    """Say which stages would run, and why."""
    from stages.commands import plan_command

    plan_command(overrides or [], check, as_json)


Root = Annotated[
    list[str] | None, typer.Argument(metavar="[OVERRIDE]...", help="artifacts.root=DIR", show_default=False)
]


@artifacts_app.command("ls")
def artifacts_ls(
    items: Annotated[list[str] | None, typer.Argument(metavar="[KIND[/NAME]]... [artifacts.root=DIR]")] = None,
    debug: Debug = False,
    as_json: Json = False,
) -> None:
    """List artifacts."""
    from stages.commands_artifacts import ls

    ls(items or [], as_json)


@artifacts_app.command("show")
def artifacts_show(
    items: Annotated[list[str], typer.Argument(metavar="ARTIFACT [artifacts.root=DIR]")],
    debug: Debug = False,
    as_json: Json = False,
) -> None:
    """Show one artifact: settings, inputs, metrics, files."""
    from stages.commands_artifacts import show

    show(items, as_json)


@artifacts_app.command("verify")
def artifacts_verify(
    items: Annotated[list[str] | None, typer.Argument(metavar="[ARTIFACT]... [artifacts.root=DIR]")] = None,
    debug: Debug = False,
    as_json: Json = False,
) -> None:
    """Read every byte and find what changed or is missing."""
    from stages.commands_artifacts import verify

    verify(items or [], as_json)


def main(arguments: list[str] | None = None) -> int:
    """Entry point. Exit codes: 0 done, 1 failed, 2 usage, 3 stale (`plan --check`)."""
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments
    try:
        result = app(arguments, prog_name="wbm", standalone_mode=False)
        code = result if isinstance(result, int) else 0  # what typer.Exit carried
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 0 if stop.code is None else 1
    except KeyboardInterrupt:
        code = _complain("interrupted", 1)
    except BrokenPipeError:
        sys.stderr.close()
        code = 1
    except Exception as error:
        if debug:
            raise
        code = _exit_code(error)
    sys.exit(code)


def _exit_code(error: Exception) -> int:
    from typer import Exit

    if isinstance(error, Exit):
        return error.exit_code
    if hasattr(error, "exit_code") and hasattr(error, "format_message"):  # a usage error of the vendored click
        return _complain(error.format_message(), 2)  # pyright: ignore[reportAttributeAccessIssue]
    kind = type(error).__name__
    if kind == "Abort":
        return _complain("interrupted", 1)
    if kind == "ConfigError":
        return _complain(str(error), 2)
    if kind in ("StageError", "Interrupted", "ArtifactError", "Missing", "Conflict"):
        return _complain(str(error), 1)
    text = " ".join(str(error).split())
    hint = "" if isinstance(error, OSError) else "; add --debug for the traceback"
    return _complain(f"{kind}: {text}{hint}", 1)


def _complain(message: str, code: int) -> int:
    sys.stderr.write(f"wbm: {message}\n")
    return code


if __name__ == "__main__":
    main()

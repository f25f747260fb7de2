"""The command line. Imports nothing heavy: each command loads what it needs when it runs."""

from __future__ import annotations

import sys
from typing import Annotated, Any

import typer

from stages.cli_groups import artifacts_app, bundle_app, jobs_app, robot_app
from stages.cli_options import (
    Cfg,
    Debug,
    Detach,
    Figure4,
    Force,
    Info,
    Items,
    Json,
    Launcher,
    Multi,
    Overrides,
    Source,
    Until,
    call,
)

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
app.add_typer(artifacts_app, name="artifacts")
app.add_typer(robot_app, name="robot")
app.add_typer(bundle_app, name="bundle")
app.add_typer(jobs_app, name="jobs")

STAGES = {
    "prepare-assets": "Stage 1: objects, convex parts, settled scenes.",
    "train-teacher": "Stage 2: a local grasping teacher.",
    "generate-rollouts": "Stage 3: successful whole-body trajectories.",
    "distill": "Stage 4: one student that sees and is told.",
    "evaluate": "Stage 5: success on held-out objects, a report.",
    "deploy-export": "Stage 6: the bundle that runs on the robot.",
}


def _run(stage: str | None, overrides: list[str] | None, **options: Any) -> None:
    from stages.commands import Options, run_command

    run_command(Options(stage, tuple(overrides or ()), **options))


@app.command()
def run(
    overrides: Overrides = None,
    cfg: Cfg = False,
    info: Info = False,
    multirun: Multi = False,
    launcher: Launcher = "local",
    detach: Detach = False,
    force: Force = False,
    until: Until = None,
    source: Source = None,
    debug: Debug = False,
    as_json: Json = False,
) -> None:
    """Run all six stages, skipping what is up to date."""
    _run(None, overrides, cfg=cfg, info=info, multirun=multirun, launcher=launcher, detach=detach, force=force,
         until=until, source=source, as_json=as_json)  # fmt: skip


def _add_stage(name: str, text: str) -> None:
    def command(
        overrides: Overrides = None,
        cfg: Cfg = False,
        info: Info = False,
        multirun: Multi = False,
        launcher: Launcher = "local",
        detach: Detach = False,
        force: Force = False,
        source: Source = None,
        debug: Debug = False,
        as_json: Json = False,
    ) -> None:
        _run(name, overrides, cfg=cfg, info=info, multirun=multirun, launcher=launcher, detach=detach, force=force,
             source=source, as_json=as_json)  # fmt: skip

    command.__doc__ = text
    app.command(name)(command)


def _add_evaluate(text: str) -> None:
    def command(
        overrides: Overrides = None,
        figure4: Figure4 = False,
        cfg: Cfg = False,
        info: Info = False,
        multirun: Multi = False,
        launcher: Launcher = "local",
        detach: Detach = False,
        force: Force = False,
        source: Source = None,
        debug: Debug = False,
        as_json: Json = False,
    ) -> None:
        if figure4:
            if cfg or info or multirun or detach or source or launcher != "local":
                raise typer.BadParameter("--figure4 goes with --force, --debug and --json alone")
            call("commands_figure4", "figure4_command", overrides or [], force, as_json)
            return
        _run("evaluate", overrides, cfg=cfg, info=info, multirun=multirun, launcher=launcher, detach=detach,
             force=force, source=source, as_json=as_json)  # fmt: skip

    command.__doc__ = text
    app.command("evaluate")(command)


for _name, _text in STAGES.items():
    if _name == "evaluate":
        _add_evaluate(_text)
    else:
        _add_stage(_name, _text)


@app.command()
def plan(
    overrides: Overrides = None,
    check: Annotated[bool, typer.Option("--check", help="Exit with 3 when a stage would run.")] = False,
    until: Until = None,
    source: Source = None,
    figure4: Figure4 = False,
    debug: Debug = False,
    as_json: Json = False,
) -> None:
    """Say which stages would run, and why."""
    if figure4:
        call("commands_figure4", "figure4_plan", overrides or [], check, as_json)
    else:
        call("commands", "plan_command", overrides or [], check, as_json, until, source)


@app.command("repro-diff")
def repro_diff(items: Items = None, debug: Debug = False, as_json: Json = False) -> None:
    """Name the first step and tensor that differ."""
    call("commands_artifacts", "repro_diff", items or [], as_json)


@app.command()
def doctor(overrides: Overrides = None, debug: Debug = False, as_json: Json = False) -> None:
    """What this machine can do, and how to get the rest."""
    call("doctor", "doctor", overrides or [], as_json)


@app.command()
def bench(
    suite: Annotated[str, typer.Argument(metavar="SUITE", help="wbc, sensors, env, data, student or all.")],
    settings: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME=VALUE]...", help="Sizes of one suite: steps=1000000.", show_default=False),
    ] = None,
    debug: Debug = False,
    as_json: Json = False,
) -> None:
    """The project's own benchmarks beside the peers."""
    call("bench", "bench", suite, settings or [], as_json)


@app.command()
def view(
    items: Items = None,
    port: Annotated[int, typer.Option("--port", help="Port on 127.0.0.1.")] = 8080,
    debug: Debug = False,
) -> None:
    """Look at an artifact, or the robot, in the browser."""
    call("view", "view", items or [], port)


@app.command()
def completion(shell: Annotated[str, typer.Argument(help="bash, zsh or fish.")], debug: Debug = False) -> None:
    """Print a completion script for your shell."""
    call("completion", "script", shell)


def main(arguments: list[str] | None = None) -> None:
    """Entry point. Exit codes: 0 done, 1 failed, 2 usage, 3 stale (`plan --check`)."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        if arguments[:1] == ["--complete"]:
            call("completion", "answer", " ".join(arguments[1:]))
            sys.exit(0)
        result = app(arguments, prog_name="wbm", standalone_mode=False)
        code = result if isinstance(result, int) else 0  # what typer.Exit carried
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except KeyboardInterrupt:
        code = _complain("interrupted", 1)
    except BrokenPipeError:
        sys.stderr.close()
        code = 1
    except BaseException as error:
        if "--debug" in arguments:
            raise
        code = _exit_code(error)
    sys.exit(code)


_TOLD = (
    "StageError", "Interrupted", "FactsError", "ArtifactError", "Missing", "Conflict", "LaunchError", "BundleError",
    "Refused",
)  # fmt: skip
"""Errors whose text says what, where and what to do."""


def _exit_code(error: BaseException) -> int:
    kind = type(error).__name__
    if hasattr(error, "exit_code") and hasattr(error, "format_message"):  # a usage error of Typer
        text: str = error.format_message().rstrip(".")  # pyright: ignore[reportAttributeAccessIssue]
        path = getattr(getattr(error, "ctx", None), "command_path", "wbm")
        return _complain(f"{text}; see `{path} --help`", 2)
    if kind == "Abort":
        return _complain("interrupted", 1)
    if kind == "ConfigError":
        return _complain(str(error), 2)
    if kind in _TOLD:
        return _complain(str(error), 1)
    text = " ".join(str(error).split())
    if isinstance(error, OSError):
        return _complain(f"{error.filename}: {error.strerror}" if error.filename and error.strerror else text, 1)
    return _complain(f"{text if kind == 'ValueError' else f'{kind}: {text}'}; add --debug for the traceback", 1)


def _complain(message: str, code: int) -> int:
    sys.stderr.write(f"wbm: {message}\n")
    return code


if __name__ == "__main__":
    main()

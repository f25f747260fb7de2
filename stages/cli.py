"""The command line. Imports nothing heavy: each command loads what it needs when it runs."""

from __future__ import annotations

import importlib
import sys
from typing import Annotated, Any

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
robot_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="The robot that everything is built on.")
app.add_typer(robot_app, name="robot")
bundle_app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Look at what deploy-export made, and try it out."
)
app.add_typer(bundle_app, name="bundle")
jobs_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="What was submitted to the cluster.")
app.add_typer(jobs_app, name="jobs")

STAGES = {
    "prepare-assets": "Stage 1: objects, convex parts, settled scenes.",
    "train-teacher": "Stage 2: a local grasping teacher.",
    "generate-rollouts": "Stage 3: successful whole-body trajectories.",
    "distill": "Stage 4: one student that sees and is told.",
    "evaluate": "Stage 5: success on held-out objects, a report.",
    "deploy-export": "Stage 6: the bundle that runs on the robot.",
}


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


def _call(module: str, function: str, *args: Any) -> None:
    getattr(importlib.import_module(f"stages.{module}"), function)(*args)


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
            _call("commands_figure4", "figure4_command", overrides or [], force, as_json)
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
        _call("commands_figure4", "figure4_plan", overrides or [], check, as_json)
    else:
        _call("commands", "plan_command", overrides or [], check, as_json, until, source)


@app.command("repro-diff")
def repro_diff(items: Items = None, debug: Debug = False, as_json: Json = False) -> None:
    """Name the first step and tensor that differ."""
    _call("commands_artifacts", "repro_diff", items or [], as_json)


@app.command()
def doctor(overrides: Overrides = None, debug: Debug = False, as_json: Json = False) -> None:
    """What this machine can do, and how to get the rest."""
    _call("doctor", "doctor", overrides or [], as_json)


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
    _call("bench", "bench", suite, settings or [], as_json)


@app.command()
def view(
    items: Items = None,
    port: Annotated[int, typer.Option("--port", help="Port on 127.0.0.1.")] = 8080,
    debug: Debug = False,
) -> None:
    """Look at an artifact, or the robot, in the browser."""
    _call("view", "view", items or [], port)


@app.command()
def completion(shell: Annotated[str, typer.Argument(help="bash, zsh or fish.")], debug: Debug = False) -> None:
    """Print a completion script for your shell."""
    _call("completion", "script", shell)


@artifacts_app.command()
def ls(items: Items = None, debug: Debug = False, as_json: Json = False) -> None:
    """List artifacts."""
    _call("commands_artifacts", "ls", items or [], as_json)


@artifacts_app.command()
def show(items: Items = None, debug: Debug = False, as_json: Json = False) -> None:
    """Settings, inputs, metrics and files of one."""
    _call("commands_artifacts", "show", items or [], as_json)


@artifacts_app.command()
def why(items: Items = None, debug: Debug = False, as_json: Json = False) -> None:
    """What it was made from, and what from it."""
    _call("commands_artifacts", "why", items or [], as_json)


@artifacts_app.command()
def diff(items: Items = None, debug: Debug = False, as_json: Json = False) -> None:
    """Settings, code, inputs, metrics, files of two."""
    _call("commands_artifacts", "diff", items or [], as_json)


@artifacts_app.command()
def verify(items: Items = None, debug: Debug = False, as_json: Json = False) -> None:
    """Find every changed or missing byte."""
    _call("commands_artifacts", "verify", items or [], as_json)


@artifacts_app.command()
def gc(
    items: Items = None,
    delete: Annotated[bool, typer.Option("--delete", help="Delete; without it, only list.")] = False,
    grace: Annotated[float, typer.Option("--grace", help="Leave alone attempts younger than this (hours).")] = 24.0,
    debug: Debug = False,
    as_json: Json = False,
) -> None:
    """Delete what no reference or pin reaches."""
    _call("commands_artifacts", "gc", items or [], delete, grace, as_json)


@artifacts_app.command()
def pin(
    items: Items = None,
    remove: Annotated[bool, typer.Option("--remove", help="Take the pin off.")] = False,
    debug: Debug = False,
    as_json: Json = False,
) -> None:
    """Keep out of gc's reach, with its inputs."""
    _call("commands_artifacts", "pin", items or [], remove, as_json)


@artifacts_app.command()
def rm(items: Items = None, force: Force = False, debug: Debug = False, as_json: Json = False) -> None:
    """Delete an artifact that nothing was made from."""
    _call("commands_artifacts", "rm", items or [], force, as_json)


@artifacts_app.command()
def publish(
    items: Items = None,
    name: Annotated[str | None, typer.Option("--as", metavar="NAME", help="Default: the kind, or kind_name.")] = None,
    without: Annotated[list[str] | None, typer.Option("--without", metavar="PATTERN", help="Leave files out.")] = None,
    limit: Annotated[float, typer.Option("--limit-mb", help="Largest size of all reference results, MB.")] = 20.0,
    debug: Debug = False,
    as_json: Json = False,
) -> None:
    """Copy one to the reference results, to be committed."""
    _call("commands_artifacts", "publish", items or [], name, without or [], limit, as_json)


FilePath = Annotated[str, typer.Argument(metavar="PATH", help="A file or folder.")]


@robot_app.command("show")
def robot_show(overrides: Overrides = None, debug: Debug = False, as_json: Json = False) -> None:
    """Joints, limits, masses and spheres."""
    _call("commands_robot", "robot_show", overrides or [], as_json)


@robot_app.command("export")
def robot_export(path: FilePath, overrides: Overrides = None, debug: Debug = False) -> None:
    """Write a standalone MJCF that opens in MuJoCo's viewer."""
    _call("commands_robot", "robot_export", path, overrides or [])


@robot_app.command("facts")
def robot_facts(overrides: Overrides = None, debug: Debug = False) -> None:
    """Print the facts that robot.facts=FILE is laid over."""
    _call("commands_robot", "robot_facts", overrides or [])


BundlePath = Annotated[str, typer.Argument(metavar="BUNDLE", help="A file, its folder, or bundle/NAME in the store.")]
LogPath = Annotated[str, typer.Argument(metavar="LOG", help="A run's log, as RunLog wrote it (.mcap).")]
Minutes = Annotated[float, typer.Option("--minutes", help="How long.")]
RunLogPath = Annotated[str | None, typer.Option("--log", metavar="FILE", help="Also log as on a robot (MCAP).")]


@bundle_app.command("show")
def bundle_show(path: BundlePath, overrides: Overrides = None, debug: Debug = False, as_json: Json = False) -> None:
    """The contract and provenance of a bundle."""
    _call("commands_bundle", "show", path, overrides or [], as_json)


@bundle_app.command("verify")
def bundle_verify(path: BundlePath, overrides: Overrides = None, debug: Debug = False, as_json: Json = False) -> None:
    """Check every part of a bundle, and its golden vectors."""
    _call("commands_bundle", "verify", path, overrides or [], as_json)


@bundle_app.command("replay")
def bundle_replay(
    log: LogPath, path: BundlePath, overrides: Overrides = None, debug: Debug = False, as_json: Json = False
) -> None:
    """Run a bundle on what another one saw, and compare the actions."""
    _call("commands_bundle", "replay_log", log, path, overrides or [], as_json)


@bundle_app.command("soak")
def bundle_soak(
    path: BundlePath,
    overrides: Overrides = None,
    minutes: Minutes = 10.0,
    log: RunLogPath = None,
    debug: Debug = False,
    as_json: Json = False,
) -> None:
    """Closed loop in real time: deadlines, jitter, memory."""
    _call("commands_bundle", "soak_bundle", path, overrides or [], minutes, log, as_json)


@bundle_app.command("compare")
def bundle_compare(overrides: Overrides = None, debug: Debug = False, as_json: Json = False) -> None:
    """Evaluate a bundle and its student on the same seeds."""
    _call("commands_bundle", "compare", overrides or [], as_json)


Submission = Annotated[str, typer.Argument(metavar="SUBMISSION", help="Its id, or the beginning of it, or latest.")]


@jobs_app.command("ls")
def jobs_ls(overrides: Overrides = None, debug: Debug = False, as_json: Json = False) -> None:
    """List submissions and where their tasks are."""
    _call("commands_jobs", "ls", overrides or [], as_json)


@jobs_app.command("logs")
def jobs_logs(
    submission: Submission = "latest",
    overrides: Overrides = None,
    task: Annotated[str, typer.Option("--task", metavar="TASK", help="Only this one.")] = "",
    lines: Annotated[int, typer.Option("-n", "--lines", help="Last lines of each log.")] = 20,
    debug: Debug = False,
) -> None:
    """Show the logs of a submission."""
    _call("commands_jobs", "logs", submission, overrides or [], task, lines)


@jobs_app.command("cancel")
def jobs_cancel(submission: Submission, overrides: Overrides = None, debug: Debug = False) -> None:
    """Cancel all jobs of a submission."""
    _call("commands_jobs", "cancel", submission, overrides or [])


Remote = Annotated[str, typer.Argument(metavar="URL", help="s3://bucket/prefix or a directory.")]


@artifacts_app.command()
def push(url: Remote, items: Items = None, debug: Debug = False, as_json: Json = False) -> None:
    """Copy artifacts, with inputs, to another store."""
    _call("commands_artifacts", "transfer", url, items or [], True, as_json)


@artifacts_app.command()
def pull(url: Remote, items: Items = None, debug: Debug = False, as_json: Json = False) -> None:
    """Copy artifacts, with inputs, from another store."""
    _call("commands_artifacts", "transfer", url, items or [], False, as_json)


def main(arguments: list[str] | None = None) -> None:
    """Entry point. Exit codes: 0 done, 1 failed, 2 usage, 3 stale (`plan --check`)."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        if arguments[:1] == ["--complete"]:
            _call("completion", "answer", " ".join(arguments[1:]))
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

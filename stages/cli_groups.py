"""The groups of commands: artifacts, robot, bundle and jobs."""

from __future__ import annotations

from typing import Annotated

import typer

from stages.cli_options import Debug, Force, Items, Json, Overrides, call

artifacts_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Look after what the stages published.")
robot_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="The robot that everything is built on.")
bundle_app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Look at what deploy-export made, and try it out."
)
jobs_app = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="What was submitted to the cluster.")

LOOKS = {
    "ls": "List artifacts.",
    "show": "Settings, inputs, metrics and files of one.",
    "why": "What it was made from, and what from it.",
    "diff": "Settings, code, inputs, metrics, files of two.",
    "verify": "Find every changed or missing byte.",
}

Remote = Annotated[str, typer.Argument(metavar="URL", help="s3://bucket/prefix or a directory.")]
FilePath = Annotated[str, typer.Argument(metavar="PATH", help="A file or folder.")]
BundlePath = Annotated[str, typer.Argument(metavar="BUNDLE", help="A file, its folder, or bundle/NAME in the store.")]
LogPath = Annotated[str, typer.Argument(metavar="LOG", help="A run's log, as RunLog wrote it (.mcap).")]
Minutes = Annotated[float, typer.Option("--minutes", help="How long.")]
RunLogPath = Annotated[str | None, typer.Option("--log", metavar="FILE", help="Also log as on a robot (MCAP).")]
Submission = Annotated[str, typer.Argument(metavar="SUBMISSION", help="Its id, or the beginning of it, or latest.")]


def _add_look(name: str, text: str) -> None:
    def command(items: Items = None, debug: Debug = False, as_json: Json = False) -> None:
        call("commands_artifacts", name, items or [], as_json)

    command.__doc__ = text
    artifacts_app.command(name)(command)


for _name, _text in LOOKS.items():
    _add_look(_name, _text)


@artifacts_app.command()
def gc(
    items: Items = None,
    delete: Annotated[bool, typer.Option("--delete", help="Delete; without it, only list.")] = False,
    grace: Annotated[float, typer.Option("--grace", help="Leave alone attempts younger than this (hours).")] = 24.0,
    debug: Debug = False,
    as_json: Json = False,
) -> None:
    """Delete what no reference or pin reaches."""
    call("commands_artifacts", "gc", items or [], delete, grace, as_json)


@artifacts_app.command()
def pin(
    items: Items = None,
    remove: Annotated[bool, typer.Option("--remove", help="Take the pin off.")] = False,
    debug: Debug = False,
    as_json: Json = False,
) -> None:
    """Keep out of gc's reach, with its inputs."""
    call("commands_artifacts", "pin", items or [], remove, as_json)


@artifacts_app.command()
def rm(items: Items = None, force: Force = False, debug: Debug = False, as_json: Json = False) -> None:
    """Delete an artifact that nothing was made from."""
    call("commands_artifacts", "rm", items or [], force, as_json)


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
    call("commands_artifacts", "publish", items or [], name, without or [], limit, as_json)


@artifacts_app.command()
def push(url: Remote, items: Items = None, debug: Debug = False, as_json: Json = False) -> None:
    """Copy artifacts, with inputs, to another store."""
    call("commands_artifacts", "transfer", url, items or [], True, as_json)


@artifacts_app.command()
def pull(url: Remote, items: Items = None, debug: Debug = False, as_json: Json = False) -> None:
    """Copy artifacts, with inputs, from another store."""
    call("commands_artifacts", "transfer", url, items or [], False, as_json)


@robot_app.command("show")
def robot_show(overrides: Overrides = None, debug: Debug = False, as_json: Json = False) -> None:
    """Joints, limits, masses and spheres."""
    call("commands_robot", "robot_show", overrides or [], as_json)


@robot_app.command("export")
def robot_export(path: FilePath, overrides: Overrides = None, debug: Debug = False) -> None:
    """Write a standalone MJCF that opens in MuJoCo's viewer."""
    call("commands_robot", "robot_export", path, overrides or [])


@robot_app.command("facts")
def robot_facts(overrides: Overrides = None, debug: Debug = False) -> None:
    """Print the facts that robot.facts=FILE is laid over."""
    call("commands_robot", "robot_facts", overrides or [])


@bundle_app.command("show")
def bundle_show(path: BundlePath, overrides: Overrides = None, debug: Debug = False, as_json: Json = False) -> None:
    """The contract and provenance of a bundle."""
    call("commands_bundle", "show", path, overrides or [], as_json)


@bundle_app.command("verify")
def bundle_verify(path: BundlePath, overrides: Overrides = None, debug: Debug = False, as_json: Json = False) -> None:
    """Check every part of a bundle, and its golden vectors."""
    call("commands_bundle", "verify", path, overrides or [], as_json)


@bundle_app.command("replay")
def bundle_replay(
    log: LogPath, path: BundlePath, overrides: Overrides = None, debug: Debug = False, as_json: Json = False
) -> None:
    """Run a bundle on what another one saw, and compare the actions."""
    call("commands_bundle", "replay_log", log, path, overrides or [], as_json)


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
    call("commands_bundle", "soak_bundle", path, overrides or [], minutes, log, as_json)


@bundle_app.command("compare")
def bundle_compare(overrides: Overrides = None, debug: Debug = False, as_json: Json = False) -> None:
    """Evaluate a bundle and its student on the same seeds."""
    call("commands_bundle", "compare", overrides or [], as_json)


@jobs_app.command("ls")
def jobs_ls(overrides: Overrides = None, debug: Debug = False, as_json: Json = False) -> None:
    """List submissions and where their tasks are."""
    call("commands_jobs", "ls", overrides or [], as_json)


@jobs_app.command("logs")
def jobs_logs(
    submission: Submission = "latest",
    overrides: Overrides = None,
    task: Annotated[str, typer.Option("--task", metavar="TASK", help="Only this one.")] = "",
    lines: Annotated[int, typer.Option("-n", "--lines", help="Last lines of each log.")] = 20,
    debug: Debug = False,
) -> None:
    """Show the logs of a submission."""
    call("commands_jobs", "logs", submission, overrides or [], task, lines)


@jobs_app.command("cancel")
def jobs_cancel(submission: Submission, overrides: Overrides = None, debug: Debug = False) -> None:
    """Cancel all jobs of a submission."""
    call("commands_jobs", "cancel", submission, overrides or [])

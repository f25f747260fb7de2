"""`wbm robot`: look at what the pipeline starts from."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from stages.commands import composer, emit


def robot_show(overrides: Sequence[str], as_json: bool) -> None:
    """Print joints, limits, masses and spheres.

    Raises:
        FactsError: `robot.facts` makes no robot.
    """
    from wbm.robot.export import describe_robot, format_robot
    from wbm.robot.model import load_robot

    robot = load_robot(composer(overrides).robot.facts)
    if as_json:
        emit(describe_robot(robot))
    else:
        sys.stdout.write(format_robot(robot) + "\n")


def robot_export(path: str, overrides: Sequence[str]) -> None:
    """Write a standalone MJCF.

    Raises:
        OSError: the file cannot be written.
        FactsError: `robot.facts` makes no robot.
    """
    from wbm.robot.export import export_robot

    export_robot(Path(path), composer(overrides).robot)
    sys.stderr.write(f"{path}: written; open it with `python -m mujoco.viewer --mjcf={path}`\n")


def robot_facts() -> None:
    """Print the standard facts: what `robot.facts` is laid over."""
    from wbm.robot.facts import standard_text

    sys.stdout.write(standard_text())

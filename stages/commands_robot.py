"""`wbm robot`: look at what the pipeline starts from."""

from __future__ import annotations

import sys
from pathlib import Path

from stages.commands import emit


def robot_show(as_json: bool) -> None:
    """Print joints, limits, masses and spheres."""
    from wbm.robot.export import describe_robot, format_robot

    if as_json:
        emit(describe_robot())
    else:
        sys.stdout.write(format_robot() + "\n")


def robot_export(path: str) -> None:
    """Write a standalone MJCF.

    Raises:
        OSError: the file cannot be written.
    """
    from wbm.robot.export import export_robot

    export_robot(Path(path))
    sys.stderr.write(f"{path}: written; open it with `python -m mujoco.viewer --mjcf={path}`\n")

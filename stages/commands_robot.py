"""`wbm robot` and `wbm bundle`: look at what the pipeline starts from, and at what it ends with."""

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


def bundle(path: str, verify: bool, as_json: bool) -> None:
    """Show or verify a bundle: a file, or the folder of a `bundle` artifact.

    Raises:
        FileNotFoundError: there is no bundle.
        BundleError: it is damaged; the message names the part.
    """
    from wbm.deploy.bundle import Bundle

    place = Path(path)
    opened = Bundle.open(place / "policy.wbm" if place.is_dir() else place)
    answer = opened.verify() if verify else opened.show()
    if as_json:
        emit(answer)
        return
    for key, value in answer.items():
        text = str(value)
        sys.stdout.write(f"{key:<16} {text if len(text) <= 160 else text[:157] + '...'}\n")

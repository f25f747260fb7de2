"""The objects of an assets artifact laid out on the floor beside the robot, for the viewer."""

from __future__ import annotations

import numpy as np

from wbm.artifacts.mcap_io import MESH, EpisodeTracks, Solid
from wbm.report.tracks import robot_tracks
from wbm.scenes.assets import Assets

MAX_OBJECTS, COLUMNS, PITCH = 240, 20, 0.22
NEAREST = 0.9  # m from the robot's base to the first row
_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def gallery_tracks(assets: Assets) -> EpisodeTracks:
    """One still of the robot at home and of at most `MAX_OBJECTS` objects spread over the set, in rows, upright."""
    objects = assets.objects
    shown = np.unique(np.linspace(0, len(objects) - 1, min(len(objects), MAX_OBJECTS)).round().astype(int))
    solids = []
    for place, index in enumerate(shown.tolist()):
        row, column = divmod(place, COLUMNS)
        across = (column - (COLUMNS - 1) / 2) * PITCH
        pos = np.array([NEAREST + row * PITCH, -across, objects.half_extent[index, 2]])
        rgba = (*np.asarray(objects.rgb[index], dtype=float), 1.0)
        solids.append(Solid(str(objects.name[index]), MESH, (0.0, 0.0, 0.0), rgba, pos, _UPRIGHT, *objects.mesh(index)))
    still = robot_tracks(assets.robot, seconds=1.0, rate_hz=1.0)
    return EpisodeTracks(**{**still.__dict__, "solids": tuple(solids)})

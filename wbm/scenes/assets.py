"""The `assets` artifact: objects, scenes, instructions and, where it is the user's own, the robot, in one folder."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from wbm.robot.model import RobotModel, load_robot
from wbm.scenes.bank import SceneBank
from wbm.scenes.instructions import Texts
from wbm.scenes.objects import ObjectSet

OBJECTS, SCENES, TEXTS, REPORT = "objects.npz", "scenes.npz", "instructions.npz", "report.json"
ROBOT = "robot_facts.yaml"


@dataclass(frozen=True, eq=False)
class Assets:
    """Everything that later stages read of the world.

    Attributes:
        objects: the object set.
        scenes: the bank of settled scenes.
        texts: instruction sentences and their embeddings.
        robot: the robot that the scenes were made for.
    """

    objects: ObjectSet
    scenes: SceneBank
    texts: Texts
    robot: RobotModel = field(default_factory=load_robot)

    @cached_property
    def meshes(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """Union mesh (vertices [V,3], faces [F,3], object frame) of every object that has hulls, by object index."""
        return {int(o): self.objects.mesh(int(o)) for o in np.flatnonzero(self.objects.has_mesh())}

    def save(self, folder: Path, report: dict[str, Any]) -> None:
        """Write the arrays, the report and a user's robot into `folder`."""
        self.objects.save(folder / OBJECTS)
        self.scenes.save(folder / SCENES)
        self.texts.save(folder / TEXTS)
        if self.robot.facts:
            (folder / ROBOT).write_bytes(self.robot.facts)
        (folder / REPORT).write_text(json.dumps(report, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def robot_of(folder: Path) -> RobotModel:
    """The robot of an assets folder: the user's own where the folder holds its facts."""
    return load_robot(folder / ROBOT if (folder / ROBOT).is_file() else "")


def load_assets(path: Path | str) -> Assets:
    """Read an assets folder.

    Raises:
        FileNotFoundError: `path` is no assets folder.
        ValueError: its files do not fit together.
    """
    folder = Path(path)
    missing = [name for name in (OBJECTS, SCENES, TEXTS) if not (folder / name).is_file()]
    if missing:
        raise FileNotFoundError(f"{folder} is not an assets artifact: lacks {', '.join(missing)}")
    objects, texts = ObjectSet.load(folder / OBJECTS), Texts.load(folder / TEXTS)
    assets = Assets(objects, SceneBank.load(folder / SCENES), texts, robot_of(folder))
    scenes, texts = assets.scenes, assets.texts
    if len(scenes) and scenes.object.max() >= len(assets.objects):
        raise ValueError(f"{folder}: scenes name object {scenes.object.max()}, the set has {len(assets.objects)}")
    last = max(scenes.text.max(), scenes.text_held_out.max()) if len(scenes) else -1
    if last >= len(texts.sentence) or len(texts.sentence) != len(texts.embedding):
        raise ValueError(f"{folder}: scenes and instructions do not fit together")
    return assets

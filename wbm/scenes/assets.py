"""The `assets` artifact: objects, scenes and instructions in one folder."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from wbm.scenes.bank import SceneBank
from wbm.scenes.instructions import Texts
from wbm.scenes.objects import ObjectSet

OBJECTS, SCENES, TEXTS, REPORT = "objects.npz", "scenes.npz", "instructions.npz", "report.json"


@dataclass(frozen=True, eq=False)
class Assets:
    """Everything that later stages read of the world.

    Attributes:
        objects: the object set.
        scenes: the bank of settled scenes.
        texts: instruction sentences and their embeddings.
    """

    objects: ObjectSet
    scenes: SceneBank
    texts: Texts

    @cached_property
    def meshes(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """Union mesh (vertices [V,3], faces [F,3], object frame) of every object that has hulls, by object index."""
        return {int(o): self.objects.mesh(int(o)) for o in np.flatnonzero(self.objects.has_mesh())}

    def save(self, folder: Path, report: dict[str, Any]) -> None:
        """Write the arrays and the report into `folder`."""
        self.objects.save(folder / OBJECTS)
        self.scenes.save(folder / SCENES)
        self.texts.save(folder / TEXTS)
        (folder / REPORT).write_text(json.dumps(report, indent=1, sort_keys=True) + "\n", encoding="utf-8")


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
    assets = Assets(ObjectSet.load(folder / OBJECTS), SceneBank.load(folder / SCENES), Texts.load(folder / TEXTS))
    scenes, texts = assets.scenes, assets.texts
    if len(scenes) and scenes.object.max() >= len(assets.objects):
        raise ValueError(f"{folder}: scenes name object {scenes.object.max()}, the set has {len(assets.objects)}")
    last = max(scenes.text.max(), scenes.text_held_out.max()) if len(scenes) else -1
    if last >= len(texts.sentence) or len(texts.sentence) != len(texts.embedding):
        raise ValueError(f"{folder}: scenes and instructions do not fit together")
    return assets

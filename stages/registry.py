"""Which stages there are, in order, and what a stage module must define.

A stage module is light to import (torch, warp and mujoco are imported inside `run`) and defines

    KIND: str                    kind of the artifact it publishes
    SECTIONS: tuple[str, ...]    sections of the configuration it reads; reading another one fails
    INPUTS: tuple[str, ...]      input slots: "assets", "teacher/*" (the whole suite), "policy:student" (slot:kind)
    def name(cfg) -> str         name of the artifact under this configuration
    def run(cfg, inputs, draft, progress) -> None
    def outside(cfg) -> dict[str, str]
                                 optional: digests, by name, of what it reads outside the store; they join the key
    EACH: tuple[str, str]        optional: ("teacher", "teachers") makes `wbm run` run the stage once for each ENTRY of
                                 `teachers`, with the override `teacher=ENTRY`

and, for clusters, optionally

    def uses_gpu(cfg) -> bool    whether a GPU helps under this configuration
    RANKED = True                several processes can run it together (torch.distributed)
    def parts(cfg) -> int        into how many parts the work falls; jobs on different nodes make them with
    def make_parts(cfg, inputs, places, workers) -> Iterator[int]    which makes part k in the folder `places[k]` and
                                 yields k; `run` finds it as the folder PARTS/k below `draft.path`
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

PARTS = "parts"
MODULES: dict[str, str] = {
    "prepare-assets": "stages.prepare_assets",
    "train-teacher": "stages.train_teacher",
    "generate-rollouts": "stages.generate_rollouts",
    "distill": "stages.distill",
    "evaluate": "stages.evaluate",
    "deploy-export": "stages.deploy_export",
}
# Stages beside the pipeline: `wbm evaluate --figure4` runs them.
FIGURE4: dict[str, str] = {"figure4-run": "stages.figure4_run", "figure4": "stages.figure4"}


@dataclass(frozen=True)
class Slot:
    """An input: its name for the stage, the kind of artifact, and whether it takes the whole suite."""

    name: str
    kind: str
    every: bool


@dataclass(frozen=True)
class Stage:
    """A stage as the pipeline sees it."""

    name: str
    module: str
    kind: str
    sections: tuple[str, ...]
    slots: tuple[Slot, ...]
    artifact_name: Callable[[Any], str]
    run: Callable[..., None]
    each: tuple[str, str] | None
    uses_gpu: Callable[[Any], bool] = lambda cfg: False
    ranked: bool = False
    parts: Callable[[Any], int] | None = None
    make_parts: Callable[..., Iterator[int]] | None = None
    outside: Callable[[Any], dict[str, str]] = lambda cfg: {}


def slot(text: str) -> Slot:
    """Parse `kind`, `kind/*` or `slot:kind`."""
    every = text.endswith("/*")
    name, _, kind = text.removesuffix("/*").partition(":")
    return Slot(name, kind or name, every)


def load(name: str) -> Stage:
    """Import a stage module.

    Raises:
        KeyError: no such stage.
        AttributeError: the module does not define what a stage must.
    """
    where = (MODULES | FIGURE4)[name]
    module = importlib.import_module(where)
    return Stage(
        name=name,
        module=where,
        kind=module.KIND,
        sections=tuple(module.SECTIONS),
        slots=tuple(slot(text) for text in module.INPUTS),
        artifact_name=module.name,
        run=module.run,
        each=getattr(module, "EACH", None),
        uses_gpu=getattr(module, "uses_gpu", Stage.uses_gpu),
        ranked=getattr(module, "RANKED", False),
        parts=getattr(module, "parts", None),
        make_parts=getattr(module, "make_parts", None),
        outside=getattr(module, "outside", Stage.outside),
    )


def load_all() -> list[Stage]:
    """All stages in pipeline order."""
    return [load(name) for name in MODULES]


def load_until(name: str) -> list[Stage]:
    """The stages up to and including `name`."""
    names = list(MODULES)
    return [load(other) for other in names[: names.index(name) + 1]]

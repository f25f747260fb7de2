"""Settled scenes as arrays, and what the controller and the sensors need of them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from wbm.robot.rotations import multiply, rotate
from wbm.scenes.parts import BOX

NUM_SUPPORTS = 8
TOP_DOWN, SIDE = 0, 1
"""Pre-grasp hints: approach from above, or horizontally."""


@dataclass(frozen=True, eq=False)
class SceneBank:
    """K scenes; column 0 of the object arrays is the target, the others are D distractors (-1 where there is none).

    Units m, rad, quaternions w x y z, environment-local world frame.

    Attributes:
        kind: [K] index into `config.KINDS`; split: [K] str.
        support_size: [K,8,3] half sizes; support_pos [K,8,3]; support_quat [K,8,4]; support_count [K];
            support_rgb [K,3].
        surface_z: [K] height on which the target rests; ceiling_z [K] height of what is above it (inf: nothing is).
        object: [K,1+D] object index; object_pos [K,1+D,3], object_quat [K,1+D,4] settled poses.
        q_start: [K,32] collision-free start; base_grasp [K,3] base x, y, yaw from which the target is in reach.
        approach: [K] `TOP_DOWN` or `SIDE`, the hint for the pre-grasp.
        text: [K,3] rows of the instruction table: training phrasings; text_held_out [K,1]: phrasings never trained on.
    """

    kind: np.ndarray
    split: np.ndarray
    support_size: np.ndarray
    support_pos: np.ndarray
    support_quat: np.ndarray
    support_count: np.ndarray
    support_rgb: np.ndarray
    surface_z: np.ndarray
    ceiling_z: np.ndarray
    object: np.ndarray
    object_pos: np.ndarray
    object_quat: np.ndarray
    q_start: np.ndarray
    base_grasp: np.ndarray
    approach: np.ndarray
    text: np.ndarray
    text_held_out: np.ndarray

    def __len__(self) -> int:
        return len(self.kind)

    @property
    def num_distractors(self) -> int:
        return self.object.shape[1] - 1

    def where(self, split: str | None = None, kinds: tuple[int, ...] | None = None) -> np.ndarray:
        """Indices of the scenes of a split and of some kinds."""
        keep = np.ones(len(self), dtype=bool)
        if split is not None:
            keep &= self.split == split
        if kinds is not None:
            keep &= np.isin(self.kind, kinds)
        return np.flatnonzero(keep)

    def select(self, index: np.ndarray) -> SceneBank:
        """The scenes at `index`."""
        return SceneBank(**{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def save(self, path: Path) -> None:
        """Write one compressed `.npz` without pickles."""
        np.savez_compressed(path, **{f.name: getattr(self, f.name) for f in fields(self)})

    @staticmethod
    def load(path: Path) -> SceneBank:
        """Read what `save` wrote.

        Raises:
            ValueError: the file lacks an array.
        """
        with np.load(path, allow_pickle=False) as data:
            missing = [f.name for f in fields(SceneBank) if f.name not in data]
            if missing:
                raise ValueError(f"{path}: not a scene bank, lacks {', '.join(missing)}")
            return SceneBank(**{f.name: data[f.name] for f in fields(SceneBank)})


def stack_scenes(rows: list[dict]) -> SceneBank:
    """A bank from one dict of values a scene."""
    return SceneBank(**{f.name: np.array([row[f.name] for row in rows]) for f in fields(SceneBank)})


@dataclass(frozen=True, eq=False)
class Boxes:
    """Box obstacles [n,M]: `type` (-1 unused), half `size` [n,M,3], and pose in the frame of `body`.

    `body` [n,M] is -1 for boxes fixed in the world, 0 for the target and 1 + i for distractor i.
    """

    type: np.ndarray
    size: np.ndarray
    pos: np.ndarray
    quat: np.ndarray
    body: np.ndarray

    def world(self, object_pos: np.ndarray, object_quat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World poses [n,M,3], [n,M,4] for objects at `object_pos` [n,1+D,3], `object_quat` [n,1+D,4]."""
        rows = np.arange(len(self.body))[:, None]
        moving = self.body >= 0
        base = np.maximum(self.body, 0)
        quat = object_quat[rows, base]
        pos = object_pos[rows, base] + rotate(quat, self.pos)
        return np.where(moving[..., None], pos, self.pos), np.where(
            moving[..., None], multiply(quat, self.quat), self.quat
        )


def obstacle_boxes(bank: SceneBank, objects, scenes: np.ndarray, with_target: bool = True) -> Boxes:
    """Supports, then the principal boxes of target and distractors: M = 8 + 2 (1 + D), the target's first.

    Without the target its two entries are unused (type -1).
    """
    count, slots = len(scenes), 1 + bank.num_distractors
    per = objects.box_pos.shape[1]
    support = np.arange(NUM_SUPPORTS) < bank.support_count[scenes, None]
    chosen = bank.object[scenes]
    used = (np.arange(per) < objects.box_count[chosen][..., None]) & (chosen >= 0)[..., None]
    if not with_target:
        used[:, 0] = False
    identity = np.broadcast_to((1.0, 0.0, 0.0, 0.0), (count, slots * per, 4))
    return Boxes(
        type=np.where(np.concatenate([support, used.reshape(count, -1)], axis=1), BOX, -1).astype(np.int32),
        size=np.concatenate([bank.support_size[scenes], objects.box_size[chosen].reshape(count, -1, 3)], axis=1),
        pos=np.concatenate([bank.support_pos[scenes], objects.box_pos[chosen].reshape(count, -1, 3)], axis=1),
        quat=np.concatenate([bank.support_quat[scenes], identity], axis=1),
        body=np.broadcast_to(
            np.r_[np.full(NUM_SUPPORTS, -1), np.repeat(np.arange(slots), per)], (count, NUM_SUPPORTS + slots * per)
        ),
    )

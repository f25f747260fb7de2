"""Instructions that name the target unambiguously in its scene, by name, colour, size or relation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from wbm.robot.rotations import rotate
from wbm.scenes.bank import SceneBank
from wbm.scenes.objects import ObjectSet

NUM_TRAINING, NUM_HELD_OUT = 3, 1
TRAINING = (
    "pick up the {}",
    "grasp the {}",
    "grab the {}",
    "lift the {}",
    "take the {}",
    "please pick up the {}",
    "get hold of the {}",
    "pick the {} up",
)
HELD_OUT = (
    "could you fetch the {}",
    "hand me the {}",
    "I would like the {}",
    "bring me the {}",
    "raise the {} for me",
)
SIDE_MARGIN = 0.05
"""How much further left, right or near (m) an object must be for a relation to name it."""


@dataclass(frozen=True, eq=False)
class Texts:
    """Sentences [T] and their embeddings [T,E] (unit length, float32)."""

    sentence: np.ndarray
    embedding: np.ndarray

    def save(self, path: Path) -> None:
        """Write one `.npz` without pickles."""
        np.savez_compressed(path, sentence=self.sentence, embedding=self.embedding)

    @staticmethod
    def load(path: Path) -> Texts:
        """Read what `save` wrote."""
        with np.load(path, allow_pickle=False) as data:
            return Texts(data["sentence"], data["embedding"])


def _fits(noun: str, other: str) -> bool:
    """Whether a noun may mean a thing called `other` too: "car" fits a "toy car", "object" fits everything."""
    return set(noun.split()) <= {*other.split(), "object"}


def descriptions(objects: ObjectSet, bank: SceneBank, scene: int) -> list[str]:
    """Phrases that fit the target of a scene and nothing else in it, the plainest first.

    Words name it by (size and) colour and noun; relations are seen from the robot, which looks along the support's x.
    """
    chosen = bank.object[scene]
    others = np.flatnonzero(chosen >= 0)[1:]
    target = int(chosen[0])

    def words(o: int) -> dict[str, str]:
        return {"size": str(objects.size_word[o]), "color": str(objects.color[o]), "noun": str(objects.noun[o])}

    def meant(keys: tuple[str, ...], other: dict[str, str]) -> bool:
        return all(_fits(mine[k], other[k]) if k == "noun" else mine[k] == other[k] for k in keys)

    mine, rest = words(target), [words(int(chosen[i])) for i in others]
    phrases = []
    for keys in (("color", "noun"), ("noun",), ("size", "color", "noun"), ("size", "noun"), ("color",), ("size",)):
        if all(mine[k] for k in keys) and not any(meant(keys, other) for other in rest):
            phrase = " ".join(mine[k] for k in keys)
            phrases.append(phrase if "noun" in keys else f"{phrase} object")
    if len(others) == 0:
        return [*phrases, "object in front of you"]
    inverse = bank.support_quat[scene, 0] * np.array([1.0, -1.0, -1.0, -1.0])
    local = rotate(inverse, bank.object_pos[scene])
    for i, words_i in zip(others, rest, strict=True):
        same = [other for other in rest if _fits(words_i["noun"], other["noun"])]
        if len(same) > 1 or _fits(words_i["noun"], mine["noun"]):
            continue  # the reference must itself be unambiguous
        offset = local[0, 1] - local[i, 1]
        if abs(offset) > SIDE_MARGIN and abs(offset) > abs(local[0, 0] - local[i, 0]):
            side = "left" if offset > 0 else "right"
            beyond = [j for j in others if j != i and (local[j, 1] - local[i, 1]) * offset > 0]
            if not any(_fits(mine["noun"], words(int(chosen[j]))["noun"]) for j in beyond):
                phrases.append(f"{mine['noun']} to the {side} of the {words_i['noun']}")
    left = local[0, 1] - local[others, 1]
    near = local[others, 0] - local[0, 0]
    if (left > SIDE_MARGIN).all():
        phrases.append("leftmost object")
    if (left < -SIDE_MARGIN).all():
        phrases.append("rightmost object")
    if (near > SIDE_MARGIN).all():
        phrases.append("object nearest to you")
    return phrases


def write_instructions(objects: ObjectSet, bank: SceneBank, seed: int) -> tuple[SceneBank, np.ndarray]:
    """The bank with its `text` and `text_held_out` rows, and the sentences [T] that they point to.

    Raises:
        ValueError: a target cannot be told from the other objects of its scene.
    """
    table: dict[str, int] = {}
    train = np.zeros((len(bank), NUM_TRAINING), dtype=np.int64)
    held_out = np.zeros((len(bank), NUM_HELD_OUT), dtype=np.int64)
    for k in range(len(bank)):
        phrases = descriptions(objects, bank, k)
        if not phrases:
            raise ValueError(f"scene {k}: no words tell the target from its neighbours")
        rng = np.random.default_rng([seed, k, 0x7E7])
        for column, templates in ((train, TRAINING), (held_out, HELD_OUT)):
            for i in range(column.shape[1]):
                # The plainest phrase for the first column, so that every scene has one; any fitting one after it.
                phrase = phrases[0 if i == 0 else int(rng.integers(len(phrases)))]
                sentence = templates[int(rng.integers(len(templates)))].format(phrase)
                column[k, i] = table.setdefault(sentence, len(table))
    return replace(bank, text=train, text_held_out=held_out), np.array(list(table))

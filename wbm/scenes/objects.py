"""Objects as arrays: convex parts, mass, words, rest poses, surface points, principal boxes."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from wbm.robot.rotations import quat_to_mat
from wbm.scenes.parts import (
    IDENTITY,
    MAX_PARTS,
    MESH,
    Part,
    bounds,
    combined_moments,
    moved,
    part_mesh,
    surface_samples,
)

MAX_BOXES = 2
MAX_RESTS = 4
SURFACE_POINTS = 256
SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class ObjectEntry:
    """One object before it joins a set; the frame's origin is the centre of its bounds at the upright pose."""

    name: str
    noun: str
    family: str
    color: str
    size_word: str
    rgb: tuple[float, float, float]
    parts: list[Part]
    mass: float
    split: str
    rests: list[tuple[float, float, float, float]]
    seed: int


@dataclass(frozen=True, eq=False)
class ObjectSet:
    """O objects of at most `MAX_PARTS` convex parts each. Units: m, kg; quaternions w x y z; object frame.

    Strings: `name`, `noun`, `family`, `color`, `size_word`, `split` [O]. Parts: `slot_type` [O,8] (MuJoCo's numbers, -1
    unused), `slot_size`, `slot_pos` [O,8,3], `slot_quat` [O,8,4], `slot_hull` [O,8] (index of the hull of a mesh part).
    Mass: `mass` [O], `com` [O,3], principal `inertia` [O,3] in frame `iquat` [O,4]. Bounds: `half_extent` [O,3] about
    the origin. `rest_quat` [O,4,4], `rest_height` [O,4] (origin above the support), `rest_count` [O]. `box_pos`,
    `box_size` [O,2,3] (half sizes, axis-aligned in the object frame), `box_count` [O]: principal boxes. `points`,
    `normals` [O,256,3]: surface samples. `width` [O]: smallest horizontal extent upright. Hulls: `hull_vertices` [V,3],
    `hull_start` [H+1].
    """

    name: np.ndarray
    noun: np.ndarray
    family: np.ndarray
    color: np.ndarray
    size_word: np.ndarray
    split: np.ndarray
    rgb: np.ndarray
    slot_type: np.ndarray
    slot_size: np.ndarray
    slot_pos: np.ndarray
    slot_quat: np.ndarray
    slot_hull: np.ndarray
    mass: np.ndarray
    com: np.ndarray
    inertia: np.ndarray
    iquat: np.ndarray
    half_extent: np.ndarray
    width: np.ndarray
    rest_quat: np.ndarray
    rest_height: np.ndarray
    rest_count: np.ndarray
    box_pos: np.ndarray
    box_size: np.ndarray
    box_count: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    hull_vertices: np.ndarray
    hull_start: np.ndarray

    def __len__(self) -> int:
        return len(self.name)

    @cached_property
    def num_hulls(self) -> int:
        return len(self.hull_start) - 1

    def hull(self, index: int) -> np.ndarray:
        """Vertices [V,3] of hull `index`, in its object's frame."""
        return self.hull_vertices[self.hull_start[index] : self.hull_start[index + 1]]

    def parts(self, index: int) -> list[Part]:
        """The convex parts of object `index`."""
        result = []
        for k in np.flatnonzero(self.slot_type[index] >= 0):
            vertices = self.hull(self.slot_hull[index, k]) if self.slot_type[index, k] == MESH else None
            pose = (tuple(self.slot_pos[index, k]), tuple(self.slot_quat[index, k]))
            result.append(Part(int(self.slot_type[index, k]), tuple(self.slot_size[index, k]), *pose, vertices))
        return result

    def mesh(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Union of an object's part meshes as one triangle soup: vertices [V,3], faces [F,3]."""
        pieces = [part_mesh(part) for part in self.parts(index)]
        offsets = np.cumsum([0] + [len(v) for v, _ in pieces[:-1]])
        faces = [f + o for (_, f), o in zip(pieces, offsets, strict=True)]
        return np.concatenate([v for v, _ in pieces]), np.concatenate(faces)

    def has_mesh(self) -> np.ndarray:
        """[O] bool: some part is a hull rather than a primitive."""
        return (self.slot_type == MESH).any(axis=1)

    def save(self, path: Path) -> None:
        """Write one compressed `.npz` without pickles."""
        np.savez_compressed(path, **{f.name: getattr(self, f.name) for f in fields(self)})

    @staticmethod
    def load(path: Path) -> ObjectSet:
        """Read what `save` wrote.

        Raises:
            ValueError: the file lacks an array.
        """
        with np.load(path, allow_pickle=False) as data:
            missing = [f.name for f in fields(ObjectSet) if f.name not in data]
            if missing:
                raise ValueError(f"{path}: not an object set, lacks {', '.join(missing)}")
            return ObjectSet(**{f.name: data[f.name] for f in fields(ObjectSet)})


def stack_objects(entries: list[ObjectEntry]) -> ObjectSet:
    """Turn entries into the arrays of an `ObjectSet`; hulls are concatenated in order."""
    rows: dict[str, list] = {f.name: [] for f in fields(ObjectSet)}
    hulls: list[np.ndarray] = []
    for entry in entries:
        for key, value in _row(entry, hulls).items():
            rows[key].append(value)
    starts = np.cumsum([0] + [len(h) for h in hulls])
    vertices = np.concatenate(hulls) if hulls else np.zeros((0, 3))
    del rows["hull_vertices"], rows["hull_start"]
    return ObjectSet(**{k: np.array(v) for k, v in rows.items()}, hull_vertices=vertices, hull_start=starts)


def centred(parts: list[Part]) -> list[Part]:
    """Parts moved so that the centre of their bounds is the origin."""
    low, high = bounds(parts)
    return [moved(part, -(low + high) / 2) for part in parts]


def _row(entry: ObjectEntry, hulls: list[np.ndarray]) -> dict:
    parts = centred(entry.parts)
    if not 1 <= len(parts) <= MAX_PARTS:
        raise ValueError(f"object {entry.name}: {len(parts)} parts, between 1 and {MAX_PARTS} fit")
    slot_type = np.full(MAX_PARTS, -1, dtype=np.int32)
    slot_hull = np.full(MAX_PARTS, -1, dtype=np.int32)
    slot_size, slot_pos = np.zeros((MAX_PARTS, 3)), np.zeros((MAX_PARTS, 3))
    slot_quat = np.tile(IDENTITY, (MAX_PARTS, 1))
    for k, part in enumerate(parts):
        slot_type[k], slot_size[k], slot_pos[k], slot_quat[k] = part.type, part.size, part.pos, part.quat
        if part.type == MESH:
            slot_hull[k] = len(hulls)
            hulls.append(part.vertices)  # pyright: ignore[reportArgumentType]
    volume, com, tensor = combined_moments(parts)
    moments, axes = np.linalg.eigh(tensor * entry.mass / volume)
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    half = bounds(parts)[1]
    boxes = principal_boxes(parts)
    rest_quat = np.tile(IDENTITY, (MAX_RESTS, 1))
    rest_height = np.zeros(MAX_RESTS)
    for k, quat in enumerate(entry.rests):
        rest_quat[k] = quat
        rest_height[k] = lowest_height(parts, np.asarray(quat))
    points, normals = surface_samples(parts, SURFACE_POINTS, np.random.default_rng(entry.seed))
    box_pos, box_size = np.zeros((MAX_BOXES, 3)), np.zeros((MAX_BOXES, 3))
    for k, (low, high) in enumerate(boxes):
        box_pos[k], box_size[k] = (low + high) / 2, (high - low) / 2
    return dict(
        name=entry.name,
        noun=entry.noun,
        family=entry.family,
        color=entry.color,
        size_word=entry.size_word,
        split=entry.split,
        rgb=np.asarray(entry.rgb, dtype=np.float32),
        slot_type=slot_type,
        slot_size=slot_size,
        slot_pos=slot_pos,
        slot_quat=slot_quat,
        slot_hull=slot_hull,
        mass=entry.mass,
        com=com,
        inertia=moments,
        iquat=Rotation.from_matrix(axes).as_quat(scalar_first=True),
        half_extent=half,
        width=2 * min(half[0], half[1]),
        rest_quat=rest_quat,
        rest_height=rest_height,
        rest_count=len(entry.rests),
        box_pos=box_pos,
        box_size=box_size,
        box_count=len(boxes),
        points=points.astype(np.float32),
        normals=normals.astype(np.float32),
    )


def lowest_height(parts: list[Part], quat: np.ndarray) -> float:
    """Height (m) of the origin above the support when the object rests in orientation `quat`."""
    rot = quat_to_mat(quat)
    lowest = np.inf
    for part in parts:
        if part.vertices is not None:
            lowest = min(lowest, float((part.vertices @ rot[2]).min()))
            continue
        centre = rot @ np.asarray(part.pos)
        turned = Rotation.from_matrix(rot @ quat_to_mat(np.asarray(part.quat))).as_quat(scalar_first=True)
        lowest = min(lowest, float(bounds([Part(part.type, part.size, tuple(centre), tuple(turned))])[0][2]))
    return -lowest


def principal_boxes(parts: list[Part]) -> list[tuple[np.ndarray, np.ndarray]]:
    """One or two axis-aligned boxes (lower, upper) about the parts: two where that saves a quarter of the volume."""
    each = [bounds([part]) for part in parts]

    def around(group: list[int]) -> tuple[np.ndarray, np.ndarray]:
        return np.min([each[i][0] for i in group], axis=0), np.max([each[i][1] for i in group], axis=0)

    def volume(box: tuple[np.ndarray, np.ndarray]) -> float:
        return float(np.prod(box[1] - box[0]))

    whole = around(list(range(len(parts))))
    best, best_volume = [whole], 0.75 * volume(whole)
    centres = np.array([(low + high) / 2 for low, high in each])
    for axis in range(3):
        order = np.argsort(centres[:, axis], kind="stable").tolist()
        for cut in range(1, len(parts)):
            pair = [around(order[:cut]), around(order[cut:])]
            total = volume(pair[0]) + volume(pair[1])
            if total < best_volume:
                best, best_volume = pair, total
    return best

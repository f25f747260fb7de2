"""Contact sheets of objects and scenes, ray traced by MuJoCo on the CPU: no display and no OpenGL."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
from PIL import Image, ImageDraw

from wbm.scenes.assets import Assets
from wbm.scenes.config import KINDS
from wbm.scenes.model import SceneModel, SceneModelConfig
from wbm.scenes.objects import ObjectSet
from wbm.scenes.parts import part_mesh

MAX_OBJECTS, MAX_SCENES = 96, 12
_SKY = np.array([0.95, 0.96, 0.98])
_LIGHT = np.array([-0.45, 0.35, 0.82]) / np.linalg.norm([-0.45, 0.35, 0.82])
_SUPERSAMPLE = 2


def render(
    model: mujoco.MjModel, data: mujoco.MjData, eye: np.ndarray, look: np.ndarray, size: tuple[int, int], fov: float
) -> np.ndarray:
    """Shaded image [height,width,3] uint8 of a scene seen from `eye` towards `look` (m); `fov` is vertical, degrees."""
    width, height = size[0] * _SUPERSAMPLE, size[1] * _SUPERSAMPLE
    ahead = (look - eye) / np.linalg.norm(look - eye)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    up = np.cross(right, ahead)
    half = np.tan(np.radians(fov) / 2)
    y, x = np.mgrid[0:height, 0:width]
    across = ((x + 0.5) / width * 2 - 1) * half * width / height
    down = ((y + 0.5) / height * 2 - 1) * half
    ray = ahead + across[..., None] * right - down[..., None] * up
    ray = (ray / np.linalg.norm(ray, axis=-1, keepdims=True)).reshape(-1, 3)
    geom = np.full(len(ray), -1, dtype=np.int32)
    distance, normal = np.zeros(len(ray)), np.zeros((len(ray), 3))
    mujoco.mj_multiRay(model, data, eye, ray.ravel(), None, 1, -1, geom, distance, normal.ravel(), len(ray), 20.0)
    hit = geom >= 0
    facing = np.where((normal * ray).sum(axis=1, keepdims=True) > 0, -normal, normal)
    light = 0.45 + 0.55 * np.clip(facing @ _LIGHT, 0, 1) - 0.1 * np.clip((facing * ray).sum(axis=1) + 1, 0, 1)
    image = np.where(hit[:, None], model.geom_rgba[geom, :3] * light[:, None], _SKY)
    image = image.reshape(size[1], _SUPERSAMPLE, size[0], _SUPERSAMPLE, 3).mean(axis=(1, 3))
    return (np.clip(image, 0, 1) * 255).astype(np.uint8)


def object_sheet(objects: ObjectSet, path: Path, size: tuple[int, int] = (128, 112), columns: int = 12) -> None:
    """One tile an object, at most `MAX_OBJECTS` spread over the set, all at the same scale."""
    shown = np.unique(np.linspace(0, len(objects) - 1, min(len(objects), MAX_OBJECTS)).round().astype(int))
    tiles = []
    for o in shown:
        model, data = _alone(objects, int(o))
        image = render(model, data, np.array([0.26, -0.24, 0.26]), np.zeros(3), size, 28.0)
        words = [str(objects.size_word[o]), str(objects.color[o]), str(objects.noun[o])]
        tiles.append((image, " ".join(w for w in words if w)))
    _write_sheet(tiles, columns, path)


def scene_sheet(assets: Assets, path: Path, size: tuple[int, int] = (320, 240)) -> None:
    """One tile a scene, at most `MAX_SCENES` spread over the kinds, each with the robot at its start."""
    objects, bank = assets.objects, assets.scenes
    model = SceneModel(objects, SceneModelConfig(num_distractors=bank.num_distractors), robot=assets.robot)
    by_kind = [bank.where(kinds=(k,)) for k in range(len(KINDS))]
    by_kind = [index for index in by_kind if len(index)]
    each = MAX_SCENES // max(1, len(by_kind))
    shown = [
        int(k) for index in by_kind for k in index[np.linspace(0, len(index) - 1, min(len(index), each)).astype(int)]
    ]
    tiles = []
    for k in shown:
        compiled = model.compile_scene(bank, k)
        data = mujoco.MjData(compiled)
        mujoco.mj_resetDataKeyframe(compiled, data, 0)
        mujoco.mj_forward(compiled, data)
        middle = np.array([*(0.6 * bank.object_pos[k, 0] + 0.4 * bank.q_start[k, :3])[:2], 0.45])
        image = render(compiled, data, middle + np.array([-1.2, -1.9, 1.3]), middle, size, 44.0)
        tiles.append(
            (image, f"{KINDS[bank.kind[k]]}: {objects.color[bank.object[k, 0]]} {objects.noun[bank.object[k, 0]]}")
        )
    _write_sheet(tiles, 4, path)


def _alone(objects: ObjectSet, o: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    spec = mujoco.MjSpec()
    for k, part in enumerate(objects.parts(o)):
        rgba = [*objects.rgb[o].tolist(), 1.0]
        if part.vertices is None:
            kind = mujoco.mjtGeom(part.type)
            spec.worldbody.add_geom(type=kind, size=part.size, pos=part.pos, quat=part.quat, rgba=rgba)
        else:
            vertices, faces = part_mesh(part)
            spec.add_mesh(name=f"m{k}", uservert=vertices.ravel(), userface=faces.ravel())
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"m{k}", rgba=rgba)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def _write_sheet(tiles: list[tuple[np.ndarray, str]], columns: int, path: Path) -> None:
    """Images [h,w,3] of one size with captions, in rows, as a PNG."""
    height, width = tiles[0][0].shape[:2]
    caption = 14
    rows = -(-len(tiles) // columns)
    sheet = Image.new("RGB", (columns * width, rows * (height + caption)), "white")
    draw = ImageDraw.Draw(sheet)
    for i, (image, text) in enumerate(tiles):
        x, y = (i % columns) * width, (i // columns) * (height + caption)
        sheet.paste(Image.fromarray(image), (x, y))
        while draw.textlength(text) > width - 4:
            text = text[:-1]
        draw.text((x + 3, y + height + 1), text, fill=(40, 40, 40))
    sheet.save(path, optimize=True)

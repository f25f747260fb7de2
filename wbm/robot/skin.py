"""Dresses the robot in the published meshes of MuJoCo Menagerie (visual only; collision stays primitive)."""

from __future__ import annotations

import os
from pathlib import Path

import mujoco

PARTS = (
    # prefix of our bodies, model and entry point in the collection, file of the entry point
    ("arm", "franka_emika_panda", "panda_nohand", "panda_nohand.xml"),
    ("hand", "leap_hand", "right_hand", "right_hand.xml"),
    ("neck", "agilex_piper", "piper", "piper.xml"),
    ("base", "stanford_tidybot", "base", "base.xml"),
)
BODY_NAMES = {"base": {"base_link": "base", "base": "base"}}
"""Bodies that are not called `<prefix>_<published name>` here."""

REPLACED = ("neck_link7", "neck_link8")  # the gripper that this robot replaces by its camera
HIDDEN_GROUP, SKIN_GROUP = 3, 2


def menagerie_xml(model: str, entry: str, file: str) -> Path:
    """Path of a published description, from `MENAGERIE_ROOT` or through the `mujoco-menagerie` package.

    Raises:
        FileNotFoundError: neither has it; the message says what to do.
    """
    root = os.environ.get("MENAGERIE_ROOT")
    if root:
        path = Path(root) / model / file
        if not path.is_file():
            raise FileNotFoundError(f"robot.skin=menagerie: MENAGERIE_ROOT={root} has no {model}/{file}")
        return path
    try:
        import mujoco_menagerie
    except ImportError:
        raise FileNotFoundError(
            "robot.skin=menagerie needs the published meshes: `pip install mujoco-menagerie`, or set MENAGERIE_ROOT to "
            "a copy of github.com/google-deepmind/mujoco_menagerie; robot.skin=primitives needs neither"
        ) from None
    try:
        return Path(mujoco_menagerie.get(model).xml(entry))
    except (mujoco_menagerie.MenagerieError, OSError) as error:
        raise FileNotFoundError(
            f"robot.skin=menagerie: {model} cannot be had ({error}); set MENAGERIE_ROOT to a local copy, or use "
            "robot.skin=primitives"
        ) from error


def add_skin(spec: mujoco.MjSpec) -> int:
    """Add the published visual meshes to the robot's bodies and hide its primitives; returns the number of meshes.

    Raises:
        FileNotFoundError: the meshes cannot be had.
    """
    count = 0
    for prefix, model, entry, file in PARTS:
        count += _dress(spec, prefix, menagerie_xml(model, entry, file))
    for body in spec.bodies:
        for geom in body.geoms:
            if geom.group == 1:
                geom.group = HIDDEN_GROUP
    return count


def _dress(spec: mujoco.MjSpec, prefix: str, path: Path) -> int:
    published = mujoco.MjSpec.from_file(str(path))
    meshes = {mesh.name: mesh for mesh in published.meshes}
    colors = {material.name: material.rgba for material in published.materials}
    ours = {body.name: body for body in spec.bodies}
    added: set[str] = set()
    for body in published.bodies:
        name = BODY_NAMES.get(prefix, {}).get(body.name, f"{prefix}_{body.name}")
        if name not in ours or name in REPLACED:
            continue
        for geom in body.geoms:
            mesh = meshes.get(geom.meshname)
            visual = geom.contype == 0 and geom.conaffinity == 0
            if mesh is None or not visual:
                continue
            asset = f"{prefix}_{geom.meshname}"
            if asset not in added:
                file = path.parent / published.meshdir / mesh.file
                spec.add_mesh(name=asset, file=str(file.resolve()), scale=mesh.scale, inertia=mesh.inertia)
                added.add(asset)
            ours[name].add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=asset,
                pos=geom.pos,
                quat=geom.quat,
                rgba=colors.get(geom.material, geom.rgba),
                contype=0,
                conaffinity=0,
                mass=0.0,
                group=SKIN_GROUP,
            )
    return len(added)

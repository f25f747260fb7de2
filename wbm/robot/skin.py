"""Dresses the robot in the published meshes of MuJoCo Menagerie (visual only; collision stays primitive)."""

from __future__ import annotations

import os
from pathlib import Path

import mujoco

from wbm.robot.mjcf import PRIMITIVE_GROUP

PARTS = (
    # prefix of our bodies, model and entry point in the collection, file of the entry point
    ("arm", "franka_emika_panda", "panda_nohand", "panda_nohand.xml"),
    ("hand", "leap_hand", "right_hand", "right_hand.xml"),
    ("neck", "agilex_piper", "piper", "piper.xml"),
    ("base", "stanford_tidybot", "base", "base.xml"),
)
BODY_NAMES = {"base_base_link": "base"}
"""Bodies that are not called `<prefix>_<published name>` here."""

UNPUBLISHED = ("neck_mast", "lidar_body", "neck_d435")
"""Geoms of this platform's own that no published mesh shows: they stay visible."""

HIDDEN_GROUP, SKIN_GROUP = 3, 2  # MuJoCo's viewer draws groups 0 to 2


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
    """Add the published visual meshes to the robot's bodies and hide the primitives below them.

    Returns:
        The number of mesh files.

    Raises:
        FileNotFoundError: the meshes cannot be had.
        ValueError: a published description has no visual mesh for any body of this robot.
    """
    count = 0
    for prefix, model, entry, file in PARTS:
        path = menagerie_xml(model, entry, file)
        added = _dress(spec, prefix, path)
        if added == 0:
            raise ValueError(f"robot.skin=menagerie: {path} has no mesh for the robot's {prefix}; use another version")
        count += added
    for body in spec.bodies:
        if any(geom.group == SKIN_GROUP for geom in body.geoms):
            for geom in body.geoms:
                if geom.group == PRIMITIVE_GROUP and geom.name not in UNPUBLISHED:
                    geom.group = HIDDEN_GROUP
    return count


def _dress(spec: mujoco.MjSpec, prefix: str, path: Path) -> int:
    published = mujoco.MjSpec.from_file(str(path))
    meshes = {mesh.name or Path(mesh.file).stem: mesh for mesh in published.meshes}  # MJCF names a mesh by its file
    colors = {material.name: material.rgba for material in published.materials}
    ours = {body.name: body for body in spec.bodies}
    added: set[str] = set()
    for body in published.bodies:
        name = f"{prefix}_{body.name}"
        target = ours.get(BODY_NAMES.get(name, name))
        for geom in body.geoms if target else ():
            mesh = meshes.get(geom.meshname)
            color = colors.get(geom.material, geom.rgba)
            if mesh is None or geom.group >= HIDDEN_GROUP or color[3] == 0:  # not drawn there either
                continue
            asset = f"{prefix}_{geom.meshname}"
            if asset not in added:
                file = path.parent / published.meshdir / mesh.file
                spec.add_mesh(name=asset, file=str(file.resolve()), scale=mesh.scale, inertia=mesh.inertia)
                added.add(asset)
            target.add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=asset,
                pos=geom.pos,
                quat=geom.quat,
                rgba=color,
                contype=0,
                conaffinity=0,
                mass=0.0,
                group=SKIN_GROUP,
            )
    return len(added)

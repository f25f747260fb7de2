"""Turns a mesh into at most eight convex hulls that stand on their most stable face; results are cached by content."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, QhullError

from wbm.scenes.cache import load_arrays, store_arrays
from wbm.scenes.config import ObjectsConfig
from wbm.scenes.meshfile import MeshError, read_mesh, scale_rule

VERSION = "1"
"""Part of the cache's key: raise it when the same file should give other hulls."""

CONVEX = 0.97
"""A body that fills this share of its convex hull is taken as convex."""

MIN_THICKNESS = 0.001
_SECTION = "meshes"


@dataclass(frozen=True, eq=False)
class Imported:
    """Hulls (vertices [V,3], m, standing on z = 0), or the reason why there are none, and the scale rule in words."""

    hulls: list[np.ndarray]
    reason: str = ""
    rule: str = ""


def cached_import(path: Path, cfg: ObjectsConfig) -> Imported | None:
    """The result for this file's content, if an earlier run kept it; a reason if the file cannot even be read."""
    try:
        kept = load_arrays(_SECTION, import_key(path, cfg))
    except OSError as error:
        return Imported([], f"cannot be read ({error.strerror})")
    if kept is None:
        return None
    hulls = [kept["vertices"][a:b] for a, b in pairwise(kept["starts"])]
    return Imported(hulls, str(kept["words"][0]), str(kept["words"][1]))


def keep_import(path: Path, cfg: ObjectsConfig, result: Imported) -> None:
    """Keep a result for later runs, under the content of its file."""
    vertices = np.concatenate(result.hulls) if result.hulls else np.zeros((0, 3))
    starts = np.cumsum([0] + [len(h) for h in result.hulls])
    words = np.array([result.reason, result.rule])
    store_arrays(_SECTION, import_key(path, cfg), vertices=vertices, starts=starts, words=words)


def import_mesh(path: Path, cfg: ObjectsConfig) -> Imported:
    """Read, repair, scale and decompose one file. A file that cannot be used gives the reason."""
    try:
        mesh = read_mesh(path, cfg)
        factor, rule = scale_rule(mesh.extents, cfg.extent)
        mesh.apply_scale(factor)
        return Imported(standing(convex_parts(mesh, cfg)), rule=rule)
    except MeshError as error:
        return Imported([], str(error))


def import_key(path: Path, cfg: ObjectsConfig) -> str:
    """Digest of a file's content and of the settings that decide what becomes of it.

    Raises:
        OSError: the file cannot be read.
    """
    settings = (VERSION, cfg.extent, cfg.max_hulls, cfg.max_hull_vertices, cfg.coacd_threshold, cfg.max_faces)
    digest = hashlib.blake2b(repr((settings, path.suffix.lower())).encode(), digest_size=16)
    if path.stat().st_size <= cfg.max_file_mb * 1e6:  # a larger one is refused by its size alone
        with open(path, "rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    else:
        digest.update(repr((path.stat().st_size, cfg.max_file_mb)).encode())
    return digest.hexdigest()


def convex_parts(mesh: trimesh.Trimesh, cfg: ObjectsConfig) -> list[np.ndarray]:
    """Vertices of at most `cfg.max_hulls` convex hulls that together fill the mesh (m).

    A convex mesh is its own hull; a mesh of few convex bodies is taken as it is; all others go to CoACD (Wei et al.
    2022).
    """
    if filled_share(mesh) > CONVEX:
        return _thick([mesh.vertices], cfg)
    bodies = mesh.split(only_watertight=False)
    if 1 < len(bodies) <= cfg.max_hulls and all(filled_share(body) > CONVEX for body in bodies):
        return _thick([body.vertices for body in bodies], cfg)
    import coacd

    coacd.set_log_level("error")
    pieces = coacd.run_coacd(
        coacd.Mesh(mesh.vertices, mesh.faces),
        threshold=cfg.coacd_threshold,
        max_convex_hull=cfg.max_hulls,
        max_ch_vertex=cfg.max_hull_vertices,
        decimate=True,
        preprocess_resolution=30,
        resolution=500,
        mcts_iterations=30,
        mcts_max_depth=2,
        seed=0,
    )
    return _thick([np.asarray(vertices) for vertices, _ in pieces][: cfg.max_hulls], cfg)


def filled_share(mesh: trimesh.Trimesh) -> float:
    """Volume of a mesh relative to its convex hull's; 0 when it has no volume."""
    try:
        hull = ConvexHull(mesh.vertices).volume
    except (QhullError, ValueError):
        return 0.0
    return abs(float(mesh.volume)) / hull if hull > 0 and mesh.is_watertight else 0.0


def _thick(clouds: list[np.ndarray], cfg: ObjectsConfig) -> list[np.ndarray]:
    """Hull vertices of the clouds, few enough each; clouds thinner than a millimetre are dropped."""
    hulls = []
    for cloud in clouds:
        try:
            vertices = cloud[np.sort(ConvexHull(cloud).vertices)]
            vertices = fewer(vertices, cfg.max_hull_vertices)
            width = np.ptp(
                (vertices - vertices.mean(axis=0)) @ np.linalg.svd(vertices - vertices.mean(axis=0))[2].T, axis=0
            )
            if width.min() >= MIN_THICKNESS:
                hulls.append(vertices)
        except (QhullError, ValueError):
            continue
    if not hulls:
        raise MeshError("no part of it is thicker than a millimetre")
    return hulls


def fewer(vertices: np.ndarray, limit: int) -> np.ndarray:
    """At most `limit` of the vertices, spread out: each next one is the farthest from those already taken."""
    if len(vertices) <= limit:
        return vertices
    taken = [int(np.argmin(vertices[:, 2]))]
    distance = np.linalg.norm(vertices - vertices[taken[0]], axis=1)
    while len(taken) < limit:
        taken.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(vertices - vertices[taken[-1]], axis=1))
    chosen = vertices[np.sort(taken)]
    return chosen[np.sort(ConvexHull(chosen).vertices)]


def standing(hulls: list[np.ndarray]) -> list[np.ndarray]:
    """Hulls turned to their most probable rest pose (a face of the common hull down), centred, on z = 0."""
    cloud = np.concatenate(hulls)
    whole = trimesh.convex.convex_hull(cloud)
    bodies = [trimesh.convex.convex_hull(h) for h in hulls]
    centre = np.average([b.center_mass for b in bodies], axis=0, weights=[b.volume for b in bodies])
    poses, chances = trimesh.poses.compute_stable_poses(whole, center_mass=centre, sigma=0.0, n_samples=1)
    if len(poses) == 0:
        raise MeshError("has no stable rest pose")
    best = poses[int(np.argmax(chances))]
    turned = [h @ best[:3, :3].T for h in hulls]
    cloud = np.concatenate(turned)
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    return [h - np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]]) for h in turned]

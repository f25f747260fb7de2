"""Reads one mesh file from a stranger: bounded before it is parsed, repaired, and scaled to a graspable size."""

from __future__ import annotations

import json
import logging
import struct
from pathlib import Path

import numpy as np
import trimesh

from wbm.scenes.config import ObjectsConfig

SUFFIXES = (".obj", ".stl", ".ply", ".glb")
UNITS = ((1.0, "metres"), (0.01, "centimetres"), (0.001, "millimetres"), (0.0254, "inches"))
PLAUSIBLE = (0.03, 0.30)
"""Largest dimension (m) of a thing on a table: the first unit that brings a mesh into it is taken as the file's."""

GRASP_WIDTH = 0.09
"""Largest smallest dimension (m): at least one way around the object must fit into the hand."""

OPEN_EDGES = 0.05
MAX_ELEMENTS = 8
"""Array elements a face: three corners, and at most as many vertices with position, normal, colour and two textures."""

_HEADER = 1 << 16


class MeshError(ValueError):
    """A mesh that cannot be used; the message is the reason, without the file's name."""


def read_mesh(path: Path, cfg: ObjectsConfig) -> trimesh.Trimesh:
    """A finite, non-empty, (nearly) closed mesh, in the file's units.

    Raises:
        MeshError: the file is empty, too big, malformed, not finite, flat, or open beyond repair.
    """
    check_bounds(path, cfg)
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # it prints tracebacks of what is reported here by name
    try:
        return repaired(_as_mesh(trimesh.load(path, process=False, skip_materials=True), cfg.max_faces))
    except MeshError:
        raise
    except MemoryError:
        raise MeshError("needs more memory than a mesh may take") from None
    except Exception as error:  # parsers fail in as many ways as files are damaged
        text = " ".join(str(error).split())[:80]
        raise MeshError(f"cannot be parsed ({type(error).__name__}: {text})") from None


def check_bounds(path: Path, cfg: ObjectsConfig) -> None:
    """Refuse what declares or holds more than the limits, before anything is allocated.

    Raises:
        MeshError: with the reason.
    """
    size = path.stat().st_size
    if size == 0:
        raise MeshError("empty file")
    if size > cfg.max_file_mb * 1e6:
        raise MeshError(f"{size / 1e6:.0f} MB, more than objects.max_file_mb={cfg.max_file_mb:g}")
    declared = 0
    if path.suffix.lower() == ".ply":
        declared = _declared_ply(path)
    elif path.suffix.lower() == ".glb":
        declared = _declared_glb(path, size)
    elif path.suffix.lower() == ".stl":
        declared = _declared_stl(path, size)
    if declared > MAX_ELEMENTS * cfg.max_faces:
        raise MeshError(f"declares {declared:.3g} elements, more than objects.max_faces={cfg.max_faces} allows")


def _declared_ply(path: Path) -> int:
    """Largest element count that a PLY header announces."""
    with open(path, "rb") as stream:
        header = stream.read(_HEADER)
    if not header.startswith(b"ply") or b"end_header" not in header:
        raise MeshError("no PLY header")
    counts = [0]
    for line in header.split(b"end_header")[0].splitlines():
        words = line.split()
        if len(words) == 3 and words[0] == b"element":
            if not words[2].isdigit():
                raise MeshError("PLY header with a bad element count")
            counts.append(int(words[2]))
    return max(counts)


def _declared_stl(path: Path, size: int) -> int:
    """Triangles that a binary STL announces; 0 for text."""
    with open(path, "rb") as stream:
        header = stream.read(84)
    if header[:5].lower() == b"solid" and b"\0" not in header:
        return 0
    if len(header) < 84:
        raise MeshError("truncated STL header")
    count = struct.unpack("<I", header[80:84])[0]
    if size < 84 + 50 * count:
        raise MeshError(f"truncated: announces {count} triangles, holds {(size - 84) // 50}")
    return count


def _declared_glb(path: Path, size: int) -> int:
    """Elements that a GLB's accessors announce, times the instances of the meshes that use them."""
    with open(path, "rb") as stream:
        head = stream.read(20)
        if len(head) < 20 or head[:4] != b"glTF" or head[16:20] != b"JSON":
            raise MeshError("no GLB header")
        total, length = struct.unpack("<I", head[8:12])[0], struct.unpack("<I", head[12:16])[0]
        if total > size or length > size:
            raise MeshError(f"truncated: announces {total} bytes, holds {size}")
        try:
            tree = json.loads(stream.read(length))
            if any("uri" in b and not str(b["uri"]).startswith("data:") for b in tree.get("buffers", ())):
                raise MeshError("refers to another file: a GLB must hold its own buffers")
            accessors = [int(a.get("count", 0)) for a in tree.get("accessors", ())]
            if any(count < 0 for count in accessors):
                raise MeshError("negative accessor count")
            per_mesh = []
            for mesh in tree.get("meshes", ()):
                used = [p.get("attributes", {}).get("POSITION") for p in mesh["primitives"]]
                used += [p.get("indices") for p in mesh["primitives"]]
                per_mesh.append(sum(accessors[i] for i in used if i is not None))
            instances = [per_mesh[n["mesh"]] for n in tree.get("nodes", ()) if "mesh" in n]
        except MeshError:
            raise
        except (ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError) as error:
            raise MeshError(f"malformed GLB tree ({type(error).__name__})") from None
    return max(sum(accessors), sum(instances))


def _as_mesh(loaded: object, max_faces: int) -> trimesh.Trimesh:
    if isinstance(loaded, trimesh.Scene):
        pieces = [g for g in loaded.geometry.values() if isinstance(g, trimesh.Trimesh)]
        if not pieces:
            raise MeshError("holds no triangles")
        count = sum(len(loaded.geometry[loaded.graph[n][1]].faces) for n in loaded.graph.nodes_geometry)
        if count > max_faces:
            raise MeshError(f"{count} faces, more than objects.max_faces={max_faces}")
        loaded = loaded.to_mesh()
    if not isinstance(loaded, trimesh.Trimesh) or len(loaded.faces) == 0:
        raise MeshError("holds no triangles")
    if len(loaded.faces) > max_faces:
        raise MeshError(f"{len(loaded.faces)} faces, more than objects.max_faces={max_faces}")
    return trimesh.Trimesh(np.asarray(loaded.vertices, dtype=float), np.asarray(loaded.faces), process=False)


def repaired(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh without duplicate vertices and degenerate faces, holes filled, faces outward.

    Raises:
        MeshError: not finite, flat, or open beyond repair.
    """
    if len(mesh.faces) and (mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices)):
        raise MeshError("faces name vertices that do not exist")
    used = mesh.vertices[np.unique(mesh.faces)]
    if not np.isfinite(used).all():
        raise MeshError("vertices are not finite")
    if np.abs(used).max() > 1e9:
        raise MeshError("coordinates beyond 1e9")
    size = np.ptp(used, axis=0)
    if size.max() < 1e-9 or size.min() < 1e-4 * size.max():
        raise MeshError("flat: it encloses no volume")
    mesh = trimesh.Trimesh(mesh.vertices / size.max(), mesh.faces, process=True, validate=True)
    if len(mesh.faces) < 4:
        raise MeshError("fewer than four faces enclose no volume")
    if not mesh.is_watertight:
        trimesh.repair.fill_holes(mesh)
    trimesh.repair.fix_normals(mesh)
    counts = np.bincount(mesh.edges_unique_inverse)
    open_share = float((counts == 1).mean())
    if open_share > OPEN_EDGES:
        raise MeshError(f"open beyond repair: {open_share:.0%} of its edges have one face only")
    mesh.apply_scale(size.max())
    return mesh


def scale_rule(extents: np.ndarray, extent: tuple[float, float]) -> tuple[float, str]:
    """Factor that takes a mesh of these extents [3] to metres at a graspable size, and the rule in words."""
    largest = float(extents.max())
    for unit, name in UNITS:
        if PLAUSIBLE[0] <= largest * unit <= PLAUSIBLE[1]:
            factor, rule = unit, f"read as {name}"
            break
    else:
        factor, rule = np.sqrt(extent[0] * extent[1]) / largest, "unknown unit, scaled to fit"
    fitted = float(np.clip(largest * factor, *extent)) / largest
    fitted = min(fitted, GRASP_WIDTH / float(extents.min()))
    if abs(fitted / factor - 1) > 1e-9 and not rule.endswith("fit"):
        rule += f", then scaled by {fitted / factor:.3g}"
    return fitted, rule

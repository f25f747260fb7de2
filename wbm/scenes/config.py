"""Settings of objects and scenes: values only."""

from __future__ import annotations

from dataclasses import dataclass, field

KINDS = ("table", "shelf", "bin")
SOURCES = ("procedural", "meshes", "pybullet")


@dataclass(frozen=True)
class ObjectsConfig:
    """Where objects come from and what is asked of them.

    Attributes:
        source: `procedural`, `meshes` (a folder of OBJ, STL, PLY, GLB) or `pybullet` (the bundled random objects).
        path: folder for `meshes`.
        count: number of objects; for meshes and pybullet at most this many files are read (0 takes all).
        families: procedural families to draw from; empty takes all.
        held_out: families that appear in the test split only.
        test_share, val_share: shares of the other families' objects.
        density: range of densities, kg/m^3.
        mass: bounds on the mass, kg.
        extent: largest dimension that imported meshes are scaled into, m.
        max_hulls: convex parts of an imported mesh, at most 8.
        max_hull_vertices: vertices of one convex part.
        coacd_threshold: concavity at which CoACD stops.
        max_file_mb, max_faces: larger meshes are skipped.
        workers: processes for imports; 0 takes every CPU.
    """

    source: str = "procedural"
    path: str = field(default="", metadata={"key": False})  # what lies there counts
    count: int = 240
    families: tuple[str, ...] = ()
    held_out: tuple[str, ...] = ("carton", "prism")
    test_share: float = 0.15
    val_share: float = 0.08
    density: tuple[float, float] = (300.0, 1100.0)
    mass: tuple[float, float] = (0.05, 0.40)
    extent: tuple[float, float] = (0.06, 0.14)
    max_hulls: int = 8
    max_hull_vertices: int = 32
    coacd_threshold: float = 0.08
    max_file_mb: float = 64.0
    max_faces: int = 500_000
    workers: int = field(default=0, metadata={"key": False})

    def __post_init__(self) -> None:
        if self.source not in SOURCES:
            raise ValueError(f"objects.source={self.source}: use one of {', '.join(SOURCES)}")
        if self.source == "meshes" and not self.path:
            raise ValueError("objects.path is empty: objects=meshes needs objects.path=FOLDER")
        if self.count < (0 if self.source != "procedural" else 2):
            raise ValueError(f"objects.count={self.count}: at least 2 procedural objects are needed")
        if not (0 <= self.test_share < 1 and 0 <= self.val_share < 1 and self.test_share + self.val_share < 1):
            raise ValueError("objects.test_share and objects.val_share must be shares that leave room for training")
        for name in ("density", "mass", "extent"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise ValueError(f"objects.{name}={[low, high]}: give a positive range, low first")
        if not 1 <= self.max_hulls <= 8:
            raise ValueError(f"objects.max_hulls={self.max_hulls}: between 1 and 8")
        if self.max_hull_vertices < 8:
            raise ValueError(f"objects.max_hull_vertices={self.max_hull_vertices}: at least 8")


@dataclass(frozen=True)
class ScenesConfig:
    """How scenes are drawn.

    Attributes:
        count: scenes of every kind (per split: `count` for train, `test_count` for test, a fifth of count for val).
        test_count: scenes of every kind on test objects.
        kinds: `table`, `shelf`, `bin`.
        num_distractors: free bodies besides the target that the compiled model holds.
        distractors: range of distractors in a scene.
        table_height, shelf_height, bin_table_height: height of the resting surface, m.
        shelf_clearance: space between the resting board and the one above, m.
        target_depth: distance of the target from the support's front edge, m.
        start_distance: how far behind its grasp position the base starts, m.
        start_lateral: largest sideways offset of the start, m.
        start_yaw: largest yaw offset of the start, rad.
        grasp_reach: distance of the base from the target at the grasp position, m.
        settle_time: simulated time a scene must stay at rest, s.
        settle_tolerance: largest movement in that time, m.
        encoder: folder of all-MiniLM-L6-v2; empty takes the installed package's.
    """

    count: int = 64
    test_count: int = 32
    kinds: tuple[str, ...] = KINDS
    num_distractors: int = 3
    distractors: tuple[int, int] = (0, 3)
    table_height: tuple[float, float] = (0.40, 0.75)
    shelf_height: tuple[float, float] = (0.45, 0.85)
    bin_table_height: tuple[float, float] = (0.40, 0.60)
    shelf_clearance: tuple[float, float] = (0.30, 0.40)
    target_depth: tuple[float, float] = (0.12, 0.35)
    start_distance: tuple[float, float] = (0.4, 0.9)
    start_lateral: float = 0.3
    start_yaw: float = 0.4
    grasp_reach: float = 0.65
    settle_time: float = 1.0
    settle_tolerance: float = 0.005
    encoder: str = field(default="", metadata={"key": False})  # one digest is accepted

    def __post_init__(self) -> None:
        unknown = [k for k in self.kinds if k not in KINDS]
        if unknown or not self.kinds:
            raise ValueError(f"scenes.kinds={list(self.kinds)}: use {', '.join(KINDS)}")
        if self.count < 1 or self.test_count < 0:
            raise ValueError("scenes.count must be at least 1, scenes.test_count not negative")
        low, high = self.distractors
        if not 0 <= low <= high <= self.num_distractors:
            raise ValueError(
                f"scenes.distractors={[low, high]}: between 0 and scenes.num_distractors={self.num_distractors}"
            )
        for name in (
            "table_height",
            "shelf_height",
            "bin_table_height",
            "shelf_clearance",
            "target_depth",
            "start_distance",
        ):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise ValueError(f"scenes.{name}={[low, high]}: give a positive range, low first")

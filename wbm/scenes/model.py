"""One compiled `MjModel` for all scenes: loading a scene writes per-environment model fields and `qpos`.

The template holds the robot, a floor, eight static boxes, a free body `target` and D free bodies `distractor_i`, each
with eight geometry slots. A slot becomes any primitive or any hull of the object set by writing its fields. Midphase is
off, because its bounding volumes belong to the compiled geometry and cannot vary.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from wbm.robot.mjcf import OBJECT_BIT, STATIC_BIT, MjcfOptions, add_contact_sensors, build_robot
from wbm.robot.model import RobotModel, load_robot
from wbm.robot.rotations import quat_to_mat
from wbm.scenes.bank import NUM_SUPPORTS, SceneBank
from wbm.scenes.fields import body_tables, columns, write
from wbm.scenes.objects import ObjectSet
from wbm.scenes.parts import BOX, MAX_PARTS, MESH, Part, part_mesh
from wbm.scenes.spec import EVERYTHING, add_mesh, add_slot, add_support, compile_with_hulls

Field = Callable[[str], Any]
"""Returns the live per-environment values [N, ...] of a model field (NumPy array or torch tensor)."""

PARK_DEPTH = -3.0
ASIDE = 30.0
# The compiler shortens kinematics where a geom's frame is its body's or its inertia's: here none may coincide.
_TILT = (0.9238795325112867, 0.3826834323650898, 0.0, 0.0)
_LEAN = (0.9238795325112867, 0.0, 0.3826834323650898, 0.0)
_GEOM_FIELDS = ("geom_type", "geom_dataid", "geom_size", "geom_pos", "geom_quat", "geom_rbound", "geom_aabb")
_BIT_FIELDS = ("geom_contype", "geom_conaffinity")
_BODY_FIELDS = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_gravcomp", "body_invweight0")
_DOF_FIELDS = ("dof_invweight0", "dof_M0")


@dataclass(frozen=True)
class SceneModelConfig:
    """How the template is compiled.

    Attributes:
        num_distractors: free bodies besides the target.
        slots: `native` keeps primitives primitive (fast; geometry types differ between environments). `mesh` makes
            every slot a mesh, for engines where type and collision bits are the same in all environments.
        sections: corners of a circle when a primitive becomes a mesh.
    """

    num_distractors: int = 3
    slots: str = "native"
    sections: int = 16

    def __post_init__(self) -> None:
        if self.num_distractors < 0:
            raise ValueError(f"scenes.num_distractors={self.num_distractors} must not be negative")
        if self.slots not in ("native", "mesh"):
            raise ValueError(f"scenes.slots={self.slots}: use native or mesh")


class SceneModel:
    """The template and the tables from which scenes are loaded.

    Attributes:
        model: the compiled template; `objects` the object set.
        bodies: names of target and distractors; sensors: names of the contact sensors.
        body_ids: [1+D]; support_geoms [8] and slot_geoms [1+D,8]: geom ids; robot_nq: 32.
        fields: names of the model fields that `load_scene` writes; expand them before the first call.
    """

    def __init__(
        self,
        objects: ObjectSet,
        cfg: SceneModelConfig | None = None,
        robot_options: MjcfOptions | None = None,
        robot: RobotModel | None = None,
    ) -> None:
        self.objects = objects
        self.cfg = cfg or SceneModelConfig()
        self.robot_options = robot_options or MjcfOptions()
        self.robot = robot or load_robot(self.robot_options.facts)
        self.bodies = ("target", *(f"distractor_{i}" for i in range(self.cfg.num_distractors)))
        self._mesh_of = _mesh_numbers(objects, self.cfg.slots)
        self.model = compile_with_hulls(self._template())
        model = self.model
        self.body_ids = np.array([model.body(name).id for name in self.bodies])
        self.support_geoms = np.array([model.geom(f"support_{i}").id for i in range(NUM_SUPPORTS)])
        self.slot_geoms = np.array([[model.geom(f"{b}_{k}").id for k in range(MAX_PARTS)] for b in self.bodies])
        self.sensors = tuple(model.sensor(i).name for i in range(model.nsensor))
        self.robot_nq = len(self.robot.joint_names)
        self._robot_mass = float(model.body_subtreemass[0] - model.body_mass[self.body_ids].sum())
        self._tables = self._geom_tables() | body_tables(objects)
        native = self.cfg.slots == "native"
        self.geom_fields = tuple(f for f in _GEOM_FIELDS if native or f != "geom_type") + (
            _BIT_FIELDS if native else ()
        )
        self.fields = (*self.geom_fields, "geom_friction", *_BODY_FIELDS, "body_subtreemass", *_DOF_FIELDS)
        first, last = self.slot_geoms[0, 0], self.slot_geoms[-1, -1]
        assert last - first + 1 == self.slot_geoms.size
        self._slots = slice(int(first), int(last) + 1)
        self._supports = slice(int(self.support_geoms[0]), int(self.support_geoms[-1]) + 1)
        self._bodies = slice(int(self.body_ids[0]), int(self.body_ids[-1]) + 1)
        self._dofs = slice(self.robot_nq, self.robot_nq + 6 * len(self.bodies))
        self.object_qpos = slice(self.robot_nq, self.robot_nq + 7 * len(self.bodies))

    def load_scene(
        self,
        field: Field,
        qpos: Any,
        ids: np.ndarray,
        bank: SceneBank,
        scenes: np.ndarray,
        mass_scale: np.ndarray | None = None,
        friction: np.ndarray | None = None,
    ) -> None:
        """Put scenes into environments; every derived mass field is written too, so `set_const` is not needed.

        Args:
            field: gives live model fields, such as `Simulation.field`.
            qpos: [N,nq] live positions.
            ids: [n] environments.
            scenes: [n] rows of `bank`.
            mass_scale: [n] or [n,1+D] factor on the objects' masses.
            friction: [n] or [n,1+D] sliding friction of the objects.

        Raises:
            ValueError: the bank was made for another number of distractors.
        """
        if bank.num_distractors != self.cfg.num_distractors:
            raise ValueError(
                f"scene bank holds {bank.num_distractors} distractors, the model {self.cfg.num_distractors}: "
                "set scenes.num_distractors alike"
            )
        count, width = len(ids), len(self.bodies)
        chosen = bank.object[scenes]  # -1 takes the last row of every table: the empty slot
        tables = self._tables
        for name in self.geom_fields:
            values = tables[name][chosen]
            write(field(name), ids, self._slots, values.reshape(count, width * MAX_PARTS, *values.shape[3:]))
        self._load_supports(field, ids, bank, scenes)
        if friction is not None:
            per_slot = np.repeat(np.broadcast_to(columns(friction), (count, width)), MAX_PARTS, axis=1)
            write(field("geom_friction"), ids, self._slots, per_slot, component=0)
        scale = np.ones((count, width)) if mass_scale is None else np.broadcast_to(columns(mass_scale), (count, width))
        self._load_masses(field, ids, chosen, scale)
        pos = bank.object_pos[scenes]
        if self.cfg.slots == "mesh":  # empty slots collide there too: below the floor it would throw them up
            aside = np.stack([np.full(width, ASIDE), 2.0 * np.arange(width), np.ones(width)], axis=1)
            pos = np.where((chosen < 0)[..., None], aside, pos)
        poses = np.concatenate([pos, bank.object_quat[scenes]], axis=2).reshape(count, -1)
        write(qpos, ids, slice(0, self.object_qpos.stop), np.concatenate([bank.q_start[scenes], poses], axis=1))

    def _load_supports(self, field: Field, ids: np.ndarray, bank: SceneBank, scenes: np.ndarray) -> None:
        size = bank.support_size[scenes]
        values = {
            "geom_size": size,
            "geom_pos": bank.support_pos[scenes],
            "geom_quat": bank.support_quat[scenes],
            "geom_rbound": np.linalg.norm(size, axis=2),
            "geom_aabb": np.concatenate([np.zeros_like(size), size], axis=2),
        }
        for name, value in values.items():
            write(field(name), ids, self._supports, value)
        if "geom_contype" in self.geom_fields:
            used = np.arange(NUM_SUPPORTS) < bank.support_count[scenes, None]
            write(field("geom_contype"), ids, self._supports, np.where(used, STATIC_BIT, 0))

    def _load_masses(self, field: Field, ids: np.ndarray, chosen: np.ndarray, scale: np.ndarray) -> None:
        tables = self._tables
        mass = tables["body_mass"][chosen] * scale
        values = {
            "body_mass": mass,
            "body_inertia": tables["body_inertia"][chosen] * scale[..., None],
            "body_ipos": tables["body_ipos"][chosen],
            "body_iquat": tables["body_iquat"][chosen],
            "body_gravcomp": tables["body_gravcomp"][chosen],
            "body_invweight0": tables["body_invweight0"][chosen] / scale[..., None],
            "body_subtreemass": mass,
        }
        for name, value in values.items():
            write(field(name), ids, self._bodies, value)
        write(field("body_subtreemass"), ids, slice(0, 1), self._robot_mass + mass.sum(axis=1, keepdims=True))
        count = len(ids)
        write(field("dof_M0"), ids, self._dofs, (tables["dof_M0"][chosen] * scale[..., None]).reshape(count, -1))
        inverse = tables["dof_invweight0"][chosen] / scale[..., None]
        write(field("dof_invweight0"), ids, self._dofs, inverse.reshape(count, -1))

    def _template(self) -> mujoco.MjSpec:
        spec = self._base_spec()
        for i in range(NUM_SUPPORTS):
            add_support(spec, i, np.full(3, 0.5), np.array([0.0, 0.0, -5.0 - i]), np.asarray(_TILT))
        for i, name in enumerate(self.bodies):
            body = self._add_object(spec, name, np.array([0.0, 0.0, PARK_DEPTH - i]), np.array([1.0, 0, 0, 0]))
            body.mass, body.inertia = 0.1, [1e-4, 2e-4, 3e-4]
            body.ipos, body.iquat, body.explicitinertial = [0.01, 0.02, 0.03], _TILT, True
            for k in range(MAX_PARTS):
                geom = dict(name=f"{name}_{k}", pos=[0.03, 0.01, 0.02], quat=_LEAN)
                if self.cfg.slots == "mesh":
                    add_slot(body, type=mujoco.mjtGeom.mjGEOM_MESH, meshname="nothing", **geom)
                else:
                    add_slot(body, type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 0.1, 0.1], **geom)
        add_contact_sensors(spec, self.bodies[0], self.bodies[1:])
        return spec

    def _base_spec(self) -> mujoco.MjSpec:
        spec = mujoco.MjSpec()
        spec.modelname = "wbm_scene"
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
        build_robot(spec, self.robot, self.robot_options)
        spec.worldbody.add_geom(
            name="floor",
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[0, 0, 1],
            contype=STATIC_BIT,
            conaffinity=0,
            rgba=[0.75, 0.73, 0.70, 1.0],
        )
        spec.worldbody.add_light(pos=[0, 0, 3], dir=[0, 0, -1])
        self._add_meshes(spec)
        return spec

    def _add_meshes(self, spec: mujoco.MjSpec) -> None:
        """Every hull of the object set (and in mesh mode every primitive) as an asset, in the order of `_mesh_of`."""
        tetrahedron = 1e-4 * np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
        for number, (o, k) in enumerate(zip(*np.nonzero(self._mesh_of >= 0), strict=True)):
            part = self._part(int(o), int(k))
            vertices, faces = part_mesh(part, self.cfg.sections)
            if part.type != MESH:  # the slot's pose places it, as it does the primitive
                vertices = (vertices - np.asarray(part.pos)) @ quat_to_mat(np.asarray(part.quat))
            add_mesh(spec, f"part_{number}", vertices, faces)
        add_mesh(spec, "nothing", tetrahedron, np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]))

    def _part(self, o: int, k: int) -> Part:
        objects = self.objects
        kind = int(objects.slot_type[o, k])
        vertices = objects.hull(objects.slot_hull[o, k]) if kind == MESH else None
        return Part(
            kind,
            tuple(objects.slot_size[o, k]),
            tuple(objects.slot_pos[o, k]),
            tuple(objects.slot_quat[o, k]),
            vertices,
        )

    def _add_object(self, spec: mujoco.MjSpec, name: str, pos: np.ndarray, quat: np.ndarray) -> mujoco.MjsBody:
        body = spec.worldbody.add_body(name=name, pos=pos, quat=quat)
        body.add_freejoint(name=name)
        return body

    def _add_parts(self, body: mujoco.MjsBody, name: str, o: int) -> None:
        for k in np.flatnonzero(self.objects.slot_type[o] >= 0):
            part = self._part(o, int(k))
            geom = dict(name=f"{name}_{k}", pos=part.pos, quat=part.quat, rgba=[*self.objects.rgb[o], 1.0])
            if self._mesh_of[o, k] >= 0:
                add_slot(body, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"part_{self._mesh_of[o, k]}", **geom)
            else:
                add_slot(body, type=mujoco.mjtGeom(part.type), size=part.size, **geom)

    def compile_scene(self, bank: SceneBank, scene: int) -> mujoco.MjModel:
        """One scene compiled on its own, as the template with that scene loaded behaves (oracle, viewer and export)."""
        return self.scene_spec(bank, scene).compile()

    def scene_spec(self, bank: SceneBank, scene: int) -> mujoco.MjSpec:
        """The spec of one scene with only the bodies and geoms that it has; `key("start")` is its start state."""
        spec = self._base_spec()
        for i in range(int(bank.support_count[scene])):
            geom = add_support(
                spec, i, bank.support_size[scene, i], bank.support_pos[scene, i], bank.support_quat[scene, i]
            )
            geom.rgba = [*bank.support_rgb[scene], 1.0]
        names, poses = [], []
        for i, o in enumerate(bank.object[scene]):
            if o < 0:
                continue
            names.append(self.bodies[i])
            poses.append(np.r_[bank.object_pos[scene, i], bank.object_quat[scene, i]])
            body = self._add_object(spec, names[-1], poses[-1][:3], poses[-1][3:])
            body.mass, body.inertia = self.objects.mass[o], self.objects.inertia[o]
            body.ipos, body.iquat, body.explicitinertial = self.objects.com[o], self.objects.iquat[o], True
            self._add_parts(body, names[-1], int(o))
        add_contact_sensors(spec, names[0], names[1:])
        spec.add_key(name="start", qpos=np.concatenate([bank.q_start[scene], *poses]), ctrl=bank.q_start[scene])
        return spec

    def _geom_tables(self) -> dict[str, np.ndarray]:
        """Compiled slot fields [O+1,8,...] of every object, read from a model that holds each object once."""
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        self._add_meshes(spec)
        for o in range(len(self.objects)):
            self._add_parts(spec.worldbody.add_body(name=f"o{o}"), f"o{o}", o)
        nothing = spec.worldbody.add_body(name="empty")
        add_slot(nothing, name="nothing", type=mujoco.mjtGeom.mjGEOM_MESH, meshname="nothing")
        model = spec.compile()
        used = self.objects.slot_type >= 0
        native = self.cfg.slots == "native"
        tables = {}
        for name in _GEOM_FIELDS:
            values = getattr(model, name)
            table = np.zeros((len(self.objects) + 1, MAX_PARTS, *values.shape[1:]), dtype=values.dtype)
            table[:] = values[model.geom("nothing").id]
            if native and name == "geom_type":
                table[:] = BOX
            if native and name == "geom_dataid":
                table[:] = -1
            owners, slots = np.nonzero(used)
            table[owners, slots] = [values[model.geom(f"o{o}_{k}").id] for o, k in zip(owners, slots, strict=True)]
            tables[name] = table
        used = np.concatenate([used, np.zeros((1, MAX_PARTS), dtype=bool)])
        tables["geom_contype"] = np.where(used, OBJECT_BIT, 0).astype(np.int32)
        tables["geom_conaffinity"] = np.where(used, EVERYTHING, 0).astype(np.int32)
        return tables


def _mesh_numbers(objects: ObjectSet, slots: str) -> np.ndarray:
    """[O,8] number of the mesh asset that a slot uses, -1 for primitives."""
    used = objects.slot_type >= 0 if slots == "mesh" else objects.slot_type == MESH
    return np.where(used, np.cumsum(used.ravel()).reshape(used.shape) - 1, -1)

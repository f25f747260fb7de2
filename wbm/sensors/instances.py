"""Scenes as sensor instances: the same parts that physics collides with."""

from __future__ import annotations

import numpy as np

from wbm.robot.model import RobotModel
from wbm.scenes.bank import SceneBank
from wbm.scenes.objects import ObjectSet
from wbm.scenes.parts import BOX, MAX_PARTS, MESH, convex_mesh
from wbm.sensors.scene import Instances, Semantic, floor_instance, robot_instances


def hull_meshes(objects: ObjectSet) -> list[tuple[np.ndarray, np.ndarray]]:
    """Every hull of the object set as (vertices, faces), in the order of `ObjectSet.slot_hull`."""
    return [convex_mesh(objects.hull(i)) for i in range(objects.num_hulls)]


class SceneInstances:
    """Builds the instances of scenes; bodies are the robot's L links, then the target, then the distractors."""

    def __init__(self, robot: RobotModel, objects: ObjectSet, bank: SceneBank) -> None:
        self.objects, self.bank = objects, bank
        self.first_body = len(robot.link_names)
        self.num_bodies = self.first_body + 1 + bank.num_distractors
        self._fixed = Instances.concat([floor_instance(), robot_instances(robot)])
        self.count = len(self._fixed.type) + bank.support_size.shape[1] + (1 + bank.num_distractors) * MAX_PARTS

    def of_scene(self, scene: int) -> Instances:
        """Floor, robot, supports, target and distractors of one scene, unused places left out."""
        return Instances.concat([self._fixed, self._supports(scene), *self._things(scene)])

    def _supports(self, scene: int) -> Instances:
        count = int(self.bank.support_count[scene])
        out = Instances.empty(count)
        out.type[:], out.id[:] = BOX, Semantic.SUPPORT
        out.size[:] = self.bank.support_size[scene, :count]
        out.pos[:] = self.bank.support_pos[scene, :count]
        out.quat[:] = self.bank.support_quat[scene, :count]
        out.color[:] = self.bank.support_rgb[scene]
        return out

    def _things(self, scene: int) -> list[Instances]:
        parts = []
        for place, index in enumerate(self.bank.object[scene]):
            if index < 0:
                continue
            o = self.objects
            used = np.flatnonzero(o.slot_type[index] >= 0)
            out = Instances.empty(len(used))
            out.type[:] = o.slot_type[index, used]
            out.size[:] = o.slot_size[index, used]
            mesh = out.type == MESH
            # A hull's vertices are in the object's frame already; its slot pose belongs to physics.
            out.mesh[mesh] = o.slot_hull[index, used][mesh]
            out.pos[~mesh] = o.slot_pos[index, used][~mesh]
            out.quat[~mesh] = o.slot_quat[index, used][~mesh]
            out.body[:] = self.first_body + place
            out.id[:] = Semantic.TARGET if place == 0 else Semantic.DISTRACTOR + place - 1
            out.color[:] = o.rgb[index]
            parts.append(out)
        return parts

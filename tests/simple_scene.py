"""A binding of boxes and cylinders on a table: enough scene for tests of the environment."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from wbm.envs.binding import SceneTable
from wbm.robot.mjcf import add_contact_sensors, robot_spec
from wbm.sim.simulation import Simulation

TABLE_HEIGHT = 0.70
BOX, CYLINDER = 6, 5


class SimpleBinding:
    """S scenes, each with one box or upright cylinder at a random place on a table in front of the robot."""

    def __init__(self, count: int = 32, seed: int = 0, max_half: float = 0.042) -> None:
        spec = robot_spec()
        spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=4, conaffinity=3)
        spec.worldbody.add_geom(
            name="table", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.35, 0.6, 0.02], pos=[0.35, 0, TABLE_HEIGHT - 0.02],
            contype=4, conaffinity=3,
        )  # fmt: skip
        target = spec.worldbody.add_body(name="target", pos=[0.3, 0, TABLE_HEIGHT + max_half])
        target.add_freejoint(name="target")
        target.add_geom(
            name="target_0", type=mujoco.mjtGeom.mjGEOM_BOX, size=[max_half] * 3, mass=0.4, priority=1, contype=2, conaffinity=7,
            friction=[1.0, 0.005, 0.0001],
        )  # fmt: skip
        add_contact_sensors(spec, "target", [])
        self.model = spec.compile()
        self.target_body = self.model.body("target").id
        self.target_geoms = (self.model.geom("target_0").id,)
        joint = self.model.joint("target")
        self.target_qpos = slice(int(joint.qposadr[0]), int(joint.qposadr[0]) + 7)
        self.target_dofs = slice(int(joint.dofadr[0]), int(joint.dofadr[0]) + 6)
        self.num_distractors = 0

        rng = np.random.default_rng(seed)
        half = rng.uniform(0.018, max_half, (count, 3)).astype(np.float32)
        self.kind = torch.from_numpy(np.where(rng.random(count) < 0.5, BOX, CYLINDER).astype(np.int32))
        cylinder = self.kind.numpy() == CYLINDER
        half[cylinder, 1] = half[cylinder, 0]
        self.half = torch.from_numpy(half)
        self.mass = torch.from_numpy(rng.uniform(0.05, 0.4, count))
        pos = np.stack([rng.uniform(0.15, 0.4, count), rng.uniform(-0.25, 0.25, count), TABLE_HEIGHT + half[:, 2]], 1)
        yaw = rng.uniform(-np.pi, np.pi, count)
        quat = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], 1)
        static_type = torch.tensor([BOX]).repeat(count, 1)
        self.table = SceneTable(
            target_pos=torch.tensor(pos, dtype=torch.float32),
            target_quat=torch.tensor(quat, dtype=torch.float32),
            box_centre=torch.zeros(count, 3),
            box_half=self.half,
            support_height=torch.full((count,), TABLE_HEIGHT),
            obstacle_type=static_type.int(),
            obstacle_size=torch.tensor([0.35, 0.6, 0.02]).repeat(count, 1, 1),
            obstacle_pos=torch.tensor([0.35, 0.0, TABLE_HEIGHT - 0.02]).repeat(count, 1, 1),
            obstacle_quat=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1, 1),
        )

    def load(self, sim: Simulation, ids: torch.Tensor, scenes: torch.Tensor) -> None:
        geom, body = self.target_geoms[0], self.target_body
        half, cylinder = self.half[scenes].double(), (self.kind[scenes] == CYLINDER).unsqueeze(1)
        size = torch.where(cylinder, torch.stack([half[:, 0], half[:, 2], torch.zeros(len(ids))], 1), half)
        sim.field("geom_type")[ids, geom] = self.kind[scenes]
        sim.field("geom_size")[ids, geom] = size
        sim.field("geom_rbound")[ids, geom] = half.norm(dim=1)
        mass = self.mass[scenes].double()
        square = half.square()
        inertia = mass.unsqueeze(1) / 3 * (square.sum(1, keepdim=True) - square)
        sim.field("body_mass")[ids, body] = mass
        sim.field("body_inertia")[ids, body] = inertia
        sim.qpos[ids, self.target_qpos] = torch.cat([self.table.target_pos[scenes], self.table.target_quat[scenes]], 1)

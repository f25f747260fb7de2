"""The student's observation: clouds of depth camera and LiDAR, proprioception, last action, instruction."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from wbm.control.links import LinkPoses
from wbm.robot.model import RobotModel
from wbm.robot.proprio import FRAMES, proprioception
from wbm.robot.schema import PolicySchema
from wbm.scenes.bank import SceneBank
from wbm.scenes.objects import ObjectSet
from wbm.sensors.cloud import PointCloud
from wbm.sensors.config import SensorsConfig
from wbm.sensors.depth import DepthCamera, pixel_areas
from wbm.sensors.instances import SceneInstances, hull_meshes
from wbm.sensors.lidar import Lidar
from wbm.sensors.scene import RayScene, Semantic

MIN_TARGET_PIXELS = 3
"""The target counts as visible when this many depth returns lie on it."""


@dataclass
class Sight:
    """One observation and what only the simulator knows of it.

    Attributes:
        obs: the fields of the policy schema, [N, ...] each.
        target_pixels: depth returns on the target [N], in pixels of an even grid.
        target_pos_b: target's position in the base frame [N,3], m.
    """

    obs: dict[str, Tensor]
    target_pixels: Tensor
    target_pos_b: Tensor


class Perception:
    """Sensors of N environments over the scenes of a bank; seeded by (seed, episode, step)."""

    def __init__(
        self,
        robot: RobotModel,
        objects: ObjectSet,
        bank: SceneBank,
        cfg: SensorsConfig,
        schema: PolicySchema,
        num_envs: int,
        seed: int = 0,
        device: str = "cpu",
    ) -> None:
        self.schema = schema.with_points(cfg.depth_cloud.num_points, cfg.lidar_cloud.num_points)
        self.num_envs, self.device = num_envs, device
        self.links = LinkPoses(robot, num_envs, device)
        self.instances = SceneInstances(robot, objects, bank)
        self.scene = RayScene(
            num_envs, self.instances.num_bodies, self.instances.count, hull_meshes(objects), device=device
        )
        frames = robot.frames
        self.camera = DepthCamera(cfg.depth, self.scene, exclude_body=frames["camera"].link, seed=seed)
        areas = pixel_areas(cfg.depth.width, cfg.depth.height, cfg.depth.center)
        self._areas = torch.as_tensor(areas, dtype=torch.float32, device=device)
        self.lidar = Lidar(cfg.lidar, self.scene, exclude_body=frames["lidar"].link, seed=seed)
        self.clouds = (
            PointCloud(cfg.depth_cloud, self.camera, seed=seed),
            PointCloud(cfg.lidar_cloud, self.lidar, seed=seed + 1),
        )
        self._body_pos, self._body_quat = wp.to_torch(self.scene.body_pos), wp.to_torch(self.scene.body_quat)
        self._frames = [*FRAMES, "lidar"]
        self.text = torch.zeros(num_envs, schema.text_dim, device=device)

    def begin(self, ids: Tensor, scenes: Tensor, episodes: Tensor, text: Tensor) -> None:
        """Show environments `ids` [K] the scenes [K] for the episodes [K], with instruction embeddings [K,D]."""
        env_ids = ids.cpu().numpy()
        for env, scene in zip(env_ids, scenes.cpu().numpy(), strict=True):
            self.scene.update_envs([env], self.instances.of_scene(int(scene)))
        self.text[ids] = text
        for sensor, cloud in zip((self.camera, self.lidar), self.clouds, strict=True):
            wp.to_torch(sensor.key)[ids] = episodes.to(torch.int32)
            cloud.reset(env_ids)

    def observe(
        self,
        q: Tensor,
        qd: Tensor,
        object_pose: Tensor,
        previous_action: Tensor,
        step: Tensor,
        ids: Tensor | None = None,
    ) -> Sight:
        """Render and assemble.

        Args:
            q: joint positions [N,32]; qd: velocities [N,32].
            object_pose: world poses of target and distractors [N,1+D,7], position and quaternion w x y z.
            previous_action: [N,32] in the units of the action schema.
            step: policy step of the episode [N].
            ids: environments to render; the others keep their last clouds. None renders all.
        """
        self.links.update(q)
        first = self.instances.first_body
        self._body_pos[:, :first], self._body_quat[:, :first] = self.links.pos, self.links.quat
        self._body_pos[:, first:] = object_pose[..., :3]
        self._body_quat[:, first:] = object_pose[..., 3:]
        pos, quat = self.links.frames(self._frames)
        env_ids = None if ids is None else ids.cpu().numpy()
        for sensor, cloud, frame in zip((self.camera, self.lidar), self.clouds, ("camera", "lidar"), strict=True):
            at = self._frames.index(frame)
            wp.to_torch(sensor.pos)[:], wp.to_torch(sensor.quat)[:] = pos[:, at], quat[:, at]
            wp.to_torch(sensor.step)[:] = step.to(torch.int32)
            wp.to_torch(cloud.base_pos)[:], wp.to_torch(cloud.base_quat)[:] = pos[:, 0], quat[:, 0]
            sensor.render(env_ids)
            cloud.assemble(env_ids)
        depth, lidar = self.clouds
        count = len(FRAMES)
        obs = {
            "depth_xyz": wp.to_torch(depth.xyz).clone(),
            "depth_rgb": (wp.to_torch(depth.rgb) * 255.0).round().to(torch.uint8),
            "depth_valid": wp.to_torch(depth.valid).to(torch.uint8),
            "depth_target": wp.to_torch(depth.target).to(torch.uint8),
            "lidar_xyz": wp.to_torch(lidar.xyz).clone(),
            "lidar_valid": wp.to_torch(lidar.valid).to(torch.uint8),
            "proprio": proprioception(torch, q, qd, pos[:, :count], quat[:, :count]).float(),
            "prev_action": previous_action.clone(),
            "text": self.text.clone(),
        }
        pixels = (wp.to_torch(self.camera.id) == int(Semantic.TARGET)).float() @ self._areas
        return Sight(obs, pixels, self._in_base(pos[:, 0], quat[:, 0], object_pose[:, 0, :3]))

    def _in_base(self, pos: Tensor, quat: Tensor, point: Tensor) -> Tensor:
        """World points [N,3] in the base frame; the base turns about z alone."""
        delta = point - pos
        c, s = 1 - 2 * quat[:, 3] ** 2, 2 * quat[:, 0] * quat[:, 3]
        return torch.stack([c * delta[:, 0] + s * delta[:, 1], -s * delta[:, 0] + c * delta[:, 1], delta[:, 2]], -1)

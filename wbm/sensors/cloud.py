"""Point clouds of a fixed size in the base frame: what the student sees."""

from __future__ import annotations

import warp as wp

from wbm.kernels.points import assemble_cloud
from wbm.sensors.config import CloudConfig
from wbm.sensors.delay import FrameDelay
from wbm.sensors.ray_sensor import EnvIds, RaySensor
from wbm.sensors.scene import Semantic

FIELDS = ("xyz", "rgb", "valid", "target", "robot", "id")


class PointCloud:
    """Fixed-size cloud of one sensor, drawn without replacement; the draw depends on (seed, key, step) alone.

    Live inputs: `base_pos` [N] vec3, `base_quat` [N] vec4 (w x y z), pose of the base frame in the world when the frame
    was measured; points stay in that frame however late they are delivered.

    Outputs [N,P]: `xyz` [vec3], base frame, m; `rgb` [vec3] in 0..1; `valid`, `target`, `robot` [bool]; `id` [int32].
    Where a scan has too few points the last places are zeros with `valid` False. `age` [N] int32: the latency, steps.
    """

    def __init__(self, config: CloudConfig, sensor: RaySensor, target_id: int = Semantic.TARGET, seed: int = 0) -> None:
        """Allocate; `sensor` gives the scans, their steps and keys."""
        self.config, self.sensor, self.target_id, self.seed = config, sensor, int(target_id), int(seed)
        device, shape = sensor.scene.device, (sensor.num_envs, config.num_points)
        self.base_pos = wp.zeros(shape[0], dtype=wp.vec3, device=device)
        self.base_quat = wp.zeros(shape[0], dtype=wp.vec4, device=device)
        self.base_quat.fill_(wp.vec4(1.0, 0.0, 0.0, 0.0))
        dtypes = (wp.vec3, wp.vec3, wp.bool, wp.bool, wp.bool, wp.int32)
        newest = {name: wp.zeros(shape, dtype=t, device=device) for name, t in zip(FIELDS, dtypes, strict=True)}
        self._newest = newest
        self._class = wp.zeros((shape[0], sensor.num_rays), dtype=wp.int8, device=device)
        self._delay = FrameDelay(config.delay, newest, sensor.key, seed) if config.delay.active else None
        out = self._delay.out if self._delay else newest
        self.xyz, self.rgb, self.valid = out["xyz"], out["rgb"], out["valid"]
        self.target, self.robot, self.id = out["target"], out["robot"], out["id"]
        self.age = self._delay.age if self._delay else wp.zeros(shape[0], dtype=wp.int32, device=device)

    def reset(self, env_ids: EnvIds = None) -> None:
        """Start an episode in the given environments (all for None): no frame from before it is delivered.

        Raises:
            ValueError: an index out of range.
        """
        if self._delay:
            self._delay.reset(self.sensor.env_index(env_ids))

    def assemble(self, env_ids: EnvIds = None) -> None:
        """Turn the sensor's newest scans into clouds and pass them through the latency.

        Raises:
            ValueError: an index out of range.
        """
        c, s, ids = self.config, self.sensor, self.sensor.env_index(env_ids)
        if ids.shape[0] == 0:
            return
        wp.launch(
            assemble_cloud,
            dim=ids.shape[0],
            inputs=[
                ids, s.step, s.key, self.seed, self.base_pos, self.base_quat, wp.vec3(*c.crop_min),
                wp.vec3(*c.crop_max), self.target_id, int(Semantic.ROBOT), c.self_filter,
                int(c.target_share * c.num_points), s.valid, s.id, s.color, s.point_w, self._class,
            ],
            outputs=[self._newest[name] for name in FIELDS],
            device=s.scene.device,
        )  # fmt: skip
        if self._delay:
            self._delay.push(ids)

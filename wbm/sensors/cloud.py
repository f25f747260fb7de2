"""Point clouds of a fixed size in the base frame: what the student sees."""

from __future__ import annotations

from dataclasses import dataclass, field

import warp as wp

from wbm.kernels.points import assemble_cloud
from wbm.sensors.delay import DelayConfig, FrameDelay
from wbm.sensors.ray_sensor import EnvIds, RaySensor
from wbm.sensors.scene import Semantic

FIELDS = ("xyz", "rgb", "valid", "target", "robot", "id")


@dataclass(frozen=True)
class CloudConfig:
    """How a scan becomes a cloud.

    Attributes:
        num_points: P.
        target_share: share of the P points that may lie on the target while others can fill the rest.
        crop_min, crop_max: corners of the box of points that are kept, base frame, m.
        self_filter: whether points on the robot are left out.
        delay: latency of the cloud.
    """

    num_points: int = 256
    target_share: float = 0.4
    crop_min: tuple[float, float, float] = (-3.0, -3.0, -0.1)
    crop_max: tuple[float, float, float] = (3.0, 3.0, 2.5)
    self_filter: bool = False
    delay: DelayConfig = field(default_factory=DelayConfig)

    def __post_init__(self) -> None:
        if self.num_points < 1:
            raise ValueError(f"cloud: num_points must be >= 1, got {self.num_points}")
        if not 0 <= self.target_share <= 1:
            raise ValueError("cloud: target_share must lie in [0, 1]")
        if any(lo >= hi for lo, hi in zip(self.crop_min, self.crop_max, strict=True)):
            raise ValueError("cloud: crop_min must lie below crop_max")


class PointCloud:
    """Fixed-size cloud of one sensor, drawn without replacement; the draw depends on (seed, key, step) alone.

    Live inputs: `base_pos` [N] vec3, `base_quat` [N] vec4 (w x y z), pose of the base frame in the world when the frame
    was measured; points stay in that frame however late they are delivered.

    Outputs [N,P]: `xyz` [vec3], base frame, m; `rgb` [vec3] in 0..1; `valid`, `target`, `robot` [bool]; `id` [int32].
    Where a scan has too few points the last places are zeros with `valid` False. `age` [N] int32 is the latency in steps.
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
                ids, s.step, s.key, self.seed, self.base_pos, self.base_quat, wp.vec3(*c.crop_min), wp.vec3(*c.crop_max),
                self.target_id, int(Semantic.ROBOT), c.self_filter, int(c.target_share * c.num_points), s.valid, s.id,
                s.color, s.point_w, self._class,
            ],
            outputs=[self._newest[name] for name in FIELDS],
            device=s.scene.device,
        )  # fmt: skip
        if self._delay:
            self._delay.push(ids)

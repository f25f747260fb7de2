"""Pictures of a scene without a display or GL, by the sensors' own ray routine."""

from __future__ import annotations

import numpy as np
import warp as wp

from wbm.kernels.rays_shade import shade_rays
from wbm.sensors.depth import pinhole_rays
from wbm.sensors.poses import optical_axis
from wbm.sensors.ray_sensor import RaySensor
from wbm.sensors.scene import RayScene

LIGHT = (1.2, -1.6, 3.6)  # centre of the light, relative to the point looked at, m
LIGHT_RADIUS = 0.35
FAR = 60.0
_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))


class Renderer:
    """A free camera that draws one environment of a scene as a shaded colour image."""

    def __init__(
        self, width: int = 480, height: int = 360, fov_deg: float = 50.0, supersample: int = 2, light_samples: int = 6
    ) -> None:
        """Prepare the rays.

        Args:
            width, height: pixels of the image.
            fov_deg: vertical field of view, degrees.
            supersample: rays along each side of a pixel.
            light_samples: points of the area light that cast shadows.

        Raises:
            ValueError: a size below one or a field of view outside (0, 180).
        """
        if min(width, height, supersample, light_samples) < 1 or not 0 < fov_deg < 180:
            raise ValueError("renderer: sizes must be >= 1 and fov_deg in (0, 180)")
        self.width, self.height, self.supersample = width, height, supersample
        hfov = 2 * np.degrees(np.arctan(np.tan(np.radians(fov_deg) / 2) * width / height))
        self._rays = pinhole_rays(width * supersample, height * supersample, hfov, fov_deg)[None]
        k = np.arange(light_samples)
        radius = LIGHT_RADIUS * np.sqrt((k + 0.5) / light_samples)
        disc = np.stack([radius * np.cos(k * _GOLDEN), radius * np.sin(k * _GOLDEN), 0 * radius], axis=1)
        self._lights = disc + np.array(LIGHT)
        self._sensors: tuple[RaySensor, RaySensor] | None = None
        self._shape: tuple = ()

    def draw(self, scene: RayScene, env: int, pos: np.ndarray, quat: np.ndarray, exclude_body: int = -1) -> np.ndarray:
        """Image [H,W,3] uint8 of environment `env` from the optical frame at `pos` [3], `quat` [4] (w x y z).

        Args:
            exclude_body: body that is not drawn: the camera's own, for a camera inside its housing (-1: none).

        Raises:
            ValueError: an environment out of range or a pose that is not finite.
        """
        pos, quat = np.asarray(pos, float), np.asarray(quat, float)
        if not (np.isfinite(pos).all() and np.isfinite(quat).all()):
            raise ValueError("renderer: the camera's pose is not finite")
        camera, light = self._bind(scene)
        camera.exclude_body = exclude_body
        camera.scene.copy_envs(scene, [env])
        light.scene.copy_envs(scene, [env] * len(self._lights))
        camera.pos.assign(pos[None].astype(np.float32))
        camera.quat.assign(quat[None].astype(np.float32))
        # The light stands over what the camera looks at, so that every picture is lit alike.
        focus = pos + 1.5 * optical_axis(quat)
        light.pos.assign((self._lights + focus * (1.0, 1.0, 0.0)).astype(np.float32))
        camera.trace(camera.env_index(None))
        light.trace(light.env_index(None))
        return self._shade(camera, light)

    def _bind(self, scene: RayScene) -> tuple[RaySensor, RaySensor]:
        """Sensors over private copies of one environment, kept while scenes of the same shape and meshes are drawn."""
        shape = (scene.num_bodies, scene.num_instances, scene.mesh_ids.ptr, str(scene.device))
        if self._sensors is None or self._shape != shape:
            around = np.concatenate([np.eye(3), -np.eye(3)])[None]
            camera = RaySensor(scene.like(1), self._rays, 0.0, FAR)
            light = RaySensor(scene.like(len(self._lights)), around, 0.0, FAR, keep_slots=True)
            self._sensors, self._shape = (camera, light), shape
        return self._sensors

    def _shade(self, camera: RaySensor, light: RaySensor) -> np.ndarray:
        s, num = camera.scene, camera.num_rays
        rgb = wp.zeros(num, dtype=wp.vec3, device=s.device)
        wp.launch(
            shade_rays,
            dim=num,
            inputs=[
                camera.rays, camera.true_pos, camera.true_quat, camera.true_range, camera.true_instance, s.view,
                s.color, light.true_pos, light.slots,
            ],
            outputs=[rgb],
            device=s.device,
        )  # fmt: skip
        k = self.supersample
        image = rgb.numpy().reshape(self.height, k, self.width, k, 3).mean(axis=(1, 3))
        return (np.clip(image, 0.0, 1.0) ** (1 / 1.1) * 255.0 + 0.5).astype(np.uint8)


def render_rgb(
    scene: RayScene,
    env: int,
    pos: np.ndarray,
    quat: np.ndarray,
    width: int = 480,
    height: int = 360,
    fov_deg: float = 50.0,
) -> np.ndarray:
    """One picture [H,W,3] uint8; keep a `Renderer` for a video. See `Renderer.draw`."""
    return Renderer(width, height, fov_deg).draw(scene, env, pos, quat)

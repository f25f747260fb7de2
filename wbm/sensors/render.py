"""Pictures of a scene without a display or GL, by the sensors' own ray routine."""

from __future__ import annotations

import numpy as np
import warp as wp

from wbm.kernels.rays_shade import shade_rays
from wbm.sensors.depth import pinhole_rays
from wbm.sensors.ray_sensor import RaySensor
from wbm.sensors.scene import RayScene

LIGHT = (1.2, -1.6, 3.6)  # centre of the light, relative to the point looked at, m
LIGHT_RADIUS = 0.35
FAR = 60.0
_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))


def look_at(pos: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Quaternion [4] (w x y z) of the optical frame at `pos` [3] whose z axis points at `target` [3], image upright."""
    z = np.asarray(target, float) - np.asarray(pos, float)
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = np.array([0.0, -1.0, 0.0]) if np.linalg.norm(x) < 1e-6 else x / np.linalg.norm(x)
    m = np.stack([x, np.cross(z, x), z], axis=1)
    # The largest of the four squared components decides which one is divided by (Shepperd, 1978).
    k = int(np.argmax([np.trace(m), *np.diag(m)])) - 1
    q = np.empty(4)
    if k < 0:
        q[:] = 1 + np.trace(m), m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    else:
        i, j, n = k, (k + 1) % 3, (k + 2) % 3
        q[0] = m[n, j] - m[j, n]
        q[1 + i], q[1 + j], q[1 + n] = 1 + m[i, i] - m[j, j] - m[n, n], m[j, i] + m[i, j], m[n, i] + m[i, n]
    return q / np.linalg.norm(q)


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

    def draw(self, scene: RayScene, env: int, pos: np.ndarray, quat: np.ndarray) -> np.ndarray:
        """Image [H,W,3] uint8 of environment `env` from the optical frame at `pos` [3], `quat` [4] (w x y z).

        Raises:
            ValueError: an environment out of range or a pose that is not finite.
        """
        pos, quat = np.asarray(pos, float), np.asarray(quat, float)
        if not (np.isfinite(pos).all() and np.isfinite(quat).all()):
            raise ValueError("renderer: the camera's pose is not finite")
        camera, light = self._bind(scene)
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
            self._sensors, self._shape = (camera, RaySensor(scene.like(len(self._lights)), around, 0.0, FAR)), shape
        return self._sensors

    def _shade(self, camera: RaySensor, light: RaySensor) -> np.ndarray:
        s, num = camera.scene, camera.num_rays
        rgb = wp.zeros(num, dtype=wp.vec3, device=s.device)
        wp.launch(
            shade_rays,
            dim=num,
            inputs=[
                camera.rays, camera.true_pos, camera.true_quat, camera.true_range, camera.true_instance, s.body_pos,
                s.body_quat, s.type, s.size, s.mesh, s.body, s.pos, s.quat, s.color, s.mesh_ids, light.true_pos,
                *light.placed,
            ],
            outputs=[rgb],
            device=s.device,
        )  # fmt: skip
        k = self.supersample
        image = rgb.numpy().reshape(self.height, k, self.width, k, 3).mean(axis=(1, 3))
        return (np.clip(image, 0.0, 1.0) ** (1 / 1.1) * 255.0 + 0.5).astype(np.uint8)


def optical_axis(quat: np.ndarray) -> np.ndarray:
    """The z axis [3] of a frame with quaternion [4] (w x y z)."""
    w, x, y, z = quat / np.linalg.norm(quat)
    return np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])


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

"""Films and strips of recorded trajectories, drawn by the sensors' own ray caster: no display and no GL."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from wbm.control.links import LinkPoses
from wbm.report.video import film_frame, follow_camera, jpeg_bytes, key_steps, write_mp4
from wbm.scenes.assets import Assets
from wbm.sensors.instances import SceneInstances, hull_meshes
from wbm.sensors.render import Renderer
from wbm.sensors.scene import RayScene

CAMERA_FOV, OUTER_FOV = 58.0, 42.0
"""Vertical fields of view of the robot's camera and of the one beside it, degrees."""


@dataclass(frozen=True)
class Trajectory:
    """Joint positions `q` [T,32], poses of target and distractors `pose` [T,1+D,7], `phase` [T], `held` [T]."""

    q: np.ndarray
    pose: np.ndarray
    phase: np.ndarray
    held: np.ndarray


class FilmStudio:
    """Draws any moment of an episode in any scene of an assets artifact."""

    def __init__(self, assets: Assets, size: tuple[int, int]) -> None:
        self.size = size
        self.links = LinkPoses(assets.robot, 1)
        self.instances = SceneInstances(assets.robot, assets.objects, assets.scenes)
        self.scene = RayScene(1, self.instances.num_bodies, self.instances.count, hull_meshes(assets.objects))
        self._pos, self._quat = wp.to_torch(self.scene.body_pos), wp.to_torch(self.scene.body_quat)
        self._housing = assets.robot.frames["camera"].link
        self._renderers: dict[tuple[int, int, float], Renderer] = {}

    def _draw(self, scene: Any, env: int, pos: Any, quat: Any, width: int, height: int, fov_deg: float) -> np.ndarray:
        return self._renderer(width, height, fov_deg).draw(scene, env, pos, quat)

    def _draw_own(
        self, scene: Any, env: int, pos: Any, quat: Any, width: int, height: int, fov_deg: float
    ) -> np.ndarray:
        return self._renderer(width, height, fov_deg).draw(scene, env, pos, quat, self._housing)

    def _renderer(self, width: int, height: int, fov_deg: float) -> Renderer:
        key = (width, height, fov_deg)
        if key not in self._renderers:
            self._renderers[key] = Renderer(width, height, fov_deg, supersample=1, light_samples=3)
        return self._renderers[key]

    def _place(self, trajectory: Trajectory, step: int) -> tuple[np.ndarray, np.ndarray]:
        """Put robot and objects where they were at one step; returns the pose of the robot's camera."""
        self.links.update(torch.as_tensor(trajectory.q[step : step + 1], dtype=torch.float32))
        first = self.instances.first_body
        self._pos[:, :first], self._quat[:, :first] = self.links.pos, self.links.quat
        pose = torch.as_tensor(trajectory.pose[step], dtype=torch.float32)
        self._pos[0, first:], self._quat[0, first:] = pose[:, :3], pose[:, 3:]
        pos, quat = self.links.frames(["camera"])
        return pos[0, 0].numpy(), quat[0, 0].numpy()

    def frame(self, trajectory: Trajectory, step: int) -> np.ndarray:
        """Outer view with the robot's own view set in, at one step."""
        camera = self._place(trajectory, step)
        # The outer camera stands still: it looks at where base and target began.
        base, target = trajectory.q[0, :3], trajectory.pose[0, 0, :3]
        return film_frame(
            self._draw, self.scene, 0, base, target, camera, self.size, CAMERA_FOV, render_own=self._draw_own
        )[0]

    def film(self, scene_row: int, trajectory: Trajectory, path: Path, period: float, fps: float) -> None:
        """Write an MP4 of the episode."""
        self.scene.update_envs([0], self.instances.of_scene(scene_row))
        stride = max(1, round(1.0 / (fps * period)))
        steps = range(0, len(trajectory.q), stride)
        write_mp4(path, (self.frame(trajectory, t) for t in steps), fps)

    def strip(self, scene_row: int, trajectory: Trajectory, stem: Path, period: float) -> list[dict[str, Any]]:
        """Write the stills of the paper's Figure 3 and return them as the report's `filmstrip`."""
        self.scene.update_envs([0], self.instances.of_scene(scene_row))
        rise = trajectory.pose[:, 0, 2] - trajectory.pose[0, 0, 2]
        # Nearer than a film's camera, between where the robot came from and where it ends.
        between = 0.4 * trajectory.q[0, :3] + 0.6 * trajectory.q[-1, :3]
        eye = follow_camera(between, trajectory.pose[0, 0, :3], distance=1.9, height=1.55)
        frames = []
        for phase, step in key_steps(trajectory.phase == 0, trajectory.held > 0, rise > 0.02).items():
            camera = self._place(trajectory, step)
            outer = self._draw(self.scene, 0, *eye, *self.size, OUTER_FOV)
            own = self._draw_own(self.scene, 0, *camera, *self.size, CAMERA_FOV)
            names = [f"{stem.name}-{phase}{suffix}.jpg" for suffix in ("", "-camera")]
            for name, picture in zip(names, (outer, own), strict=True):
                (stem.parent / name).write_bytes(jpeg_bytes(picture))
            relative = [f"{stem.parent.name}/{name}" for name in names]
            frames.append({"phase": phase, "outer": relative[0], "camera": relative[1], "time_s": step * period})
        return frames


def choose_films(records: Sequence[dict[str, Any]], count: int) -> list[int]:
    """Places of the records to film: one of every reason of failure and successes in turn."""
    groups: dict[str, list[int]] = {}
    for place, record in enumerate(records):
        groups.setdefault("" if record["success"] else record["reason"], []).append(place)
    chosen: list[int] = []
    while len(chosen) < min(count, len(records)):
        for group in groups.values():
            if group and len(chosen) < count:
                chosen.append(group.pop(0))
    return sorted(chosen)


def choose_strips(records: Sequence[dict[str, Any]], count: int) -> list[int]:
    """Places of the records to show as strips: successes, and where there are too few, what came nearest to one."""

    def merit(place: int) -> tuple[bool, bool, int]:
        record = records[place]
        return not record["success"], record.get("time_to_grasp_s") is None, place

    return sorted(sorted(range(len(records)), key=merit)[:count])

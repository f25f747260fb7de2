"""A web viewer on this machine: robot, spheres, scene, point clouds and target mask of an episode, with a time line."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser

from wbm.artifacts.mcap_io import BOX, CAPSULE, CYLINDER, MESH, SPHERE, EpisodeTracks
from wbm.report.tracks import mats_to_quats
from wbm.robot.model import RobotModel, load_robot
from wbm.robot.spheres import batched_kinematics, robot_spheres

_TARGET_RGB = np.array([255, 70, 20], dtype=np.uint8)
_LIDAR_RGB = np.array([60, 130, 220], dtype=np.uint8)


@dataclass(frozen=True)
class Shown:
    """Something to open.

    Attributes:
        name: entry in the list of episodes.
        load: gives its tracks, called when it is chosen.
        target_mask: [T,P] flags of the camera's points, if there are any.
        ee_target: [T,3] target of the grasp frame, if there is one.
    """

    name: str
    load: Callable[[], EpisodeTracks]
    target_mask: np.ndarray | None = None
    ee_target: np.ndarray | None = None


class Viewer:
    """Serves episodes on 127.0.0.1 until `close`.

    Args:
        items: what can be chosen; the first is opened.
        port: TCP port, 0 for any free one.
        robot: the robot; the standard one by default.
    """

    def __init__(self, items: list[Shown], port: int = 8080, robot: RobotModel | None = None) -> None:
        if not items:
            raise ValueError("nothing to view: the artifact holds no episode")
        self.items = {item.name: item for item in items}
        self.robot = robot or load_robot()
        self.step = 0
        self.playing = False
        self._lock = threading.RLock()
        self._stop = threading.Event()
        self.server = viser.ViserServer(host="127.0.0.1", port=port, label="wbm", verbose=False)
        self.server.initial_camera.position = (-1.6, -2.6, 1.9)
        self.server.initial_camera.look_at = (0.3, 0.0, 0.6)
        self.server.scene.set_up_direction("+z")
        self.server.scene.add_grid("/floor", width=12, height=12, cell_size=0.5, section_size=1.0, position=(0, 0, 0))
        self._links, self._spheres = self._add_robot()
        self._add_controls()
        self._parts: dict[str, Any] = {}
        self._select(items[0].name)
        self._thread = threading.Thread(target=self._run, name="viewer-clock", daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """Where to point a browser."""
        return f"http://127.0.0.1:{self.server.get_port()}"

    def close(self) -> None:
        """Stop serving."""
        self._stop.set()
        self._thread.join(timeout=5)
        self.server.stop()

    def show(self, step: int) -> None:
        """Draw one step of the chosen episode."""
        with self._lock, self.server.atomic():
            self.step = int(np.clip(step, 0, len(self.tracks.times) - 1))
            k = self.step
            for i, handle in self._links.items():
                handle.position, handle.wxyz = self._link_pos[k, i], self._link_quat[k, i]
            for handle, solid in self._moving:
                handle.position, handle.wxyz = solid.pos[k], solid.quat[k]
            self._show_clouds(k)
            if (item := self._item).ee_target is not None:
                self._parts["ee_target"].position = item.ee_target[k]
            self._clock.content = (
                f"**{self.tracks.times[k]:.2f} s**, step {k} of {len(self.tracks.times) - 1}\n\n{self._remark(k)}"
            )
            if self._scrub.value != k:
                self._scrub.value = k
        self._follow()

    def _add_robot(self) -> tuple[dict[int, Any], list[Any]]:
        scene, links, spheres = self.server.scene, {}, []
        for i, name in enumerate(self.robot.link_names):
            links[i] = scene.add_frame(f"/robot/{name}", show_axes=False)
        for geom in self.robot.geoms:
            path = f"/robot/{geom.link}/{geom.name}"
            _add_solid(scene, path, geom.type, geom.size, geom.rgb, geom.pos, geom.quat)
        ball = robot_spheres(self.robot)
        for k in range(len(ball)):
            handle = scene.add_icosphere(
                f"/robot/{self.robot.link_names[ball.link[k]]}/sphere_{k}",
                radius=float(ball.radius[k]),
                color=(240, 170, 40),
                opacity=0.35,
                subdivisions=2,
                position=tuple(ball.pos[k]),
                visible=False,
            )
            spheres.append(handle)
        return links, spheres

    def _add_controls(self) -> None:
        gui = self.server.gui
        self._choice = gui.add_dropdown("Show", tuple(self.items), initial_value=next(iter(self.items)))
        self._play = gui.add_button("Play")
        self._scrub = gui.add_slider("Step", 0, 1, 1, 0)
        self._speed = gui.add_dropdown("Speed", ("0.25", "0.5", "1", "2", "4"), initial_value="1")
        self._follows = gui.add_checkbox("Camera follows the robot", False)
        self._clock = gui.add_markdown("")
        with gui.add_folder("Layers"):
            layers = {
                "Robot spheres": lambda on: [setattr(h, "visible", on) for h in self._spheres],
                "Camera points": lambda on: self._set_visible("camera", on),
                "LiDAR points": lambda on: self._set_visible("lidar", on),
                "Scene": lambda on: self._set_visible("solids", on),
            }
            self._layers = {}
            for name, apply in layers.items():
                box = gui.add_checkbox(name, name != "Robot spheres")
                box.on_update(lambda event, apply=apply: apply(event.target.value))
                self._layers[name] = box
            self._mask = gui.add_checkbox("Target mask", True)
        self._choice.on_update(lambda _: self._select(self._choice.value))
        self._play.on_click(lambda _: self._toggle())
        self._scrub.on_update(lambda _: None if self._scrub.value == self.step else self.show(self._scrub.value))
        self._mask.on_update(lambda _: self.show(self.step))

    def _set_visible(self, kind: str, on: bool) -> None:
        for handle in self._groups.get(kind, []):
            handle.visible = on

    def _toggle(self) -> None:
        if not self.playing and self.step == len(self.tracks.times) - 1:
            self.show(0)
        self.playing = not self.playing
        self._play.label = "Pause" if self.playing else "Play"

    def _select(self, name: str) -> None:
        """Open an episode: remove what belonged to the last one, draw its scene, go to its start."""
        tracks = self.items[name].load()
        if tracks.q is None:
            raise ValueError(f"{name} has no joint positions to show")
        rot, pos = batched_kinematics(self.robot, tracks.q)
        quats = np.stack([mats_to_quats(rot[:, i]) for i in range(rot.shape[1])], axis=1)
        with self._lock:
            self.playing, self._play.label = False, "Play"
            for handle in self._parts.values():
                handle.remove()
            self._item, self.tracks, self._link_pos, self._link_quat = self.items[name], tracks, pos, quats
            self._parts, self._moving, self._groups = {}, [], {"solids": [], "camera": [], "lidar": []}
            for i, solid in enumerate(tracks.solids):
                first = (solid.pos[0], solid.quat[0]) if np.ndim(solid.pos) == 2 else (solid.pos, solid.quat)
                handle = _add_solid(
                    self.server.scene,
                    f"/scene/{i}",
                    solid.type,
                    solid.size,
                    solid.rgba[:3],
                    *first,
                    solid.vertices,
                    solid.faces,
                )
                self._parts[f"solid {i}"] = handle
                self._groups["solids"].append(handle)
                if np.ndim(solid.pos) == 2:
                    self._moving.append((handle, solid))
            if self._item.ee_target is not None:
                self._parts["ee_target"] = self.server.scene.add_frame(
                    "/target/ee", axes_length=0.08, axes_radius=0.004
                )
            self._scrub.max = max(1, len(tracks.times) - 1)
        self.show(0)

    def _show_clouds(self, k: int) -> None:
        """Clouds are stored in the base frame: they hang below the base's frame and move with it."""
        base = self.robot.link_names[self.robot.frames["base"].link]
        if self.tracks.camera is not None:
            xyz, rgb, valid = (a[k] for a in self.tracks.camera)
            keep = valid != 0
            colours = np.array(rgb[keep], dtype=np.uint8)
            if self._mask.value and self._item.target_mask is not None:
                colours[self._item.target_mask[k][keep] != 0] = _TARGET_RGB
            self._put_cloud("camera", f"/robot/{base}/camera_points", xyz[keep], colours, 0.012)
        if self.tracks.lidar is not None:
            xyz, valid = (a[k] for a in self.tracks.lidar)
            points = xyz[valid != 0]
            self._put_cloud("lidar", f"/robot/{base}/lidar_points", points, np.tile(_LIDAR_RGB, (len(points), 1)), 0.02)

    def _put_cloud(self, key: str, path: str, points: np.ndarray, colours: np.ndarray, size: float) -> None:
        layer = {"camera": "Camera points", "lidar": "LiDAR points"}[key]
        if key not in self._parts:
            self._parts[key] = self.server.scene.add_point_cloud(
                path,
                points,
                colours,
                point_size=size,
                point_shape="circle",
                precision="float32",
                visible=self._layers[layer].value,
            )
            self._groups[key] = [self._parts[key]]
        else:
            self._parts[key].points, self._parts[key].colors = points.astype(np.float32), colours

    def _remark(self, k: int) -> str:
        said = [text for seconds, text in self.tracks.log if seconds <= self.tracks.times[k] + 1e-9]
        return said[-1] if said else ""

    def _follow(self) -> None:
        if not self._follows.value:
            return
        base = self._link_pos[self.step, self.robot.frames["base"].link]
        focus = base + np.array([0.3, 0.0, 0.6])
        for client in self.server.get_clients().values():
            offset = np.asarray(client.camera.position) - np.asarray(client.camera.look_at)
            with client.atomic():
                client.camera.look_at = focus
                client.camera.position = focus + offset

    def _run(self) -> None:
        """The clock: real time times the chosen speed, skipping steps when drawing is slow."""
        begun, origin, drawn, speed = None, 0.0, -1, self._speed.value
        while not self._stop.wait(0.02):
            if not self.playing:
                begun = None
                continue
            now = time.monotonic()
            if begun is None or self.step != drawn or speed != self._speed.value:  # started, scrubbed or sped up
                begun, origin, drawn, speed = now, float(self.tracks.times[self.step]), self.step, self._speed.value
            seconds = origin + (now - begun) * float(speed)
            step = int(np.searchsorted(self.tracks.times, seconds, side="right")) - 1
            if step > self.step:
                self.show(step)
                drawn = step
            if self.step >= len(self.tracks.times) - 1:
                self._toggle()


def _add_solid(
    scene: Any,
    path: str,
    kind: int,
    size: Any,
    rgb: Any,
    pos: Any,
    quat: Any,
    vertices: np.ndarray | None = None,
    faces: np.ndarray | None = None,
) -> Any:
    """Draw a primitive (MuJoCo's numbers and half sizes) or a mesh; returns the handle that carries its pose."""
    colour = tuple(round(255 * float(c)) for c in rgb[:3])
    pose = {"position": tuple(float(v) for v in pos), "wxyz": tuple(float(v) for v in quat)}
    if kind == BOX:
        return scene.add_box(path, color=colour, dimensions=tuple(2 * float(s) for s in size), **pose)
    if kind == SPHERE:
        return scene.add_icosphere(path, radius=float(size[0]), color=colour, **pose)
    if kind in (CYLINDER, CAPSULE):
        radius, half = float(size[0]), float(size[1])
        if kind == CYLINDER:
            return scene.add_cylinder(path, radius=radius, height=2 * half, color=colour, **pose)
        root = scene.add_frame(path, show_axes=False, **pose)
        scene.add_cylinder(f"{path}/tube", radius=radius, height=2 * half, color=colour)
        for name, z in (("top", half), ("bottom", -half)):
            scene.add_icosphere(f"{path}/{name}", radius=radius, color=colour, position=(0.0, 0.0, z))
        return root
    if kind == MESH and vertices is not None and faces is not None:
        return scene.add_mesh_simple(
            path, np.float32(vertices), np.uint32(faces), color=colour, flat_shading=True, **pose
        )
    raise ValueError(f"geometry type {kind} of {path} cannot be drawn")

"""A web viewer on this machine: robot, spheres, commands, scene, clouds and target mask; episodes and live policies."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import viser

from wbm.artifacts.mcap_io import EpisodeTracks
from wbm.report.drawing import add_robot, add_solid
from wbm.report.sight import sight_image
from wbm.report.tracks import mats_to_quats
from wbm.robot.model import RobotModel, load_robot
from wbm.robot.proprio import quat_to_mat
from wbm.robot.schema import ActionSpec, to_target
from wbm.robot.spheres import batched_kinematics

_TARGET_RGB = np.array([255, 70, 20], dtype=np.uint8)
_LIDAR_RGB = np.array([60, 130, 220], dtype=np.uint8)


@dataclass(frozen=True)
class Shown:
    """Something to open.

    Attributes:
        name: entry in the list of episodes.
        load: gives its tracks, called when it is chosen.
        target_mask: [T,P] flags of the camera's points, if there are any.
        live: where to ask for a policy that runs, instead of `load`.
    """

    name: str
    load: Callable[[], EpisodeTracks] = lambda: EpisodeTracks(times=np.zeros(0))
    target_mask: np.ndarray | None = None
    live: Live | None = None


class Live(Protocol):
    """A policy that runs while it is watched."""

    def poll(self) -> tuple[int, EpisodeTracks, np.ndarray] | None:
        """Episode number, its tracks so far and the target mask [T,P]; None before its start.

        Raises:
            ValueError: the policy has failed.
        """
        ...

    def set_pace(self, paused: bool, speed: float) -> None:
        """Hold or go on, at `speed` times real time."""
        ...


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
        self._links, self._spheres = add_robot(self.server.scene, self.robot)
        self._add_controls()
        self._parts: dict[str, Any] = {}
        self._item = items[0]
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
            for handle, i in self._moving:
                solid = self.tracks.solids[i]
                handle.position, handle.wxyz = solid.pos[k], solid.quat[k]
            self._show_clouds(k)
            self._show_command(k)
            self._clock.content = (
                f"**{self.tracks.times[k]:.2f} s**, step {k} of {len(self.tracks.times) - 1}\n\n{self._remark(k)}"
            )
            self._scrub.max = max(1, len(self.tracks.times) - 1)
            if self._scrub.value != k:
                self._scrub.value = k
        self._follow()

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
                "Controller's target": lambda on: self._set_visible("command", on),
            }
            self._layers = {}
            for name, apply in layers.items():
                box = gui.add_checkbox(name, name != "Robot spheres")
                box.on_update(lambda event, apply=apply: apply(event.target.value))
                self._layers[name] = box
            self._mask = gui.add_checkbox("Target mask", True)
        self._sight = gui.add_image(np.zeros((2, 2, 3), np.uint8), label="What the student sees", visible=False)
        self._choice.on_update(lambda _: self._select(self._choice.value))
        self._play.on_click(lambda _: self._toggle())
        self._scrub.on_update(lambda _: self._scrubbed())
        self._mask.on_update(lambda _: self.show(self.step))

    def _set_visible(self, kind: str, on: bool) -> None:
        for handle in self._groups.get(kind, []):
            handle.visible = on

    def _scrubbed(self) -> None:
        """A person moved the time line; a live policy waits until Play is pressed again."""
        if self._scrub.value == self.step:
            return
        if self._item.live and self.playing:
            self._toggle()
        self.show(self._scrub.value)

    def _toggle(self) -> None:
        if not self._item.live and not self.playing and self.step == len(self.tracks.times) - 1:
            self.show(0)
        self._play_or_pause(not self.playing)

    def _play_or_pause(self, playing: bool) -> None:
        self.playing, self._play.label = playing, "Pause" if playing else "Play"
        if self._item.live:
            self._item.live.set_pace(not playing, float(self._speed.value))

    def _select(self, name: str) -> None:
        """Open an episode at its start, or follow a live policy; one that was followed before waits."""
        item = self.items[name]
        tracks, mask, number = (item.load(), item.target_mask, -1) if item.live is None else _first_steps(item.live)
        if tracks.q is None:
            raise ValueError(f"{name} has no joint positions to show")
        with self._lock:
            if self._item.live:
                self._play_or_pause(False)
            self._item = item
            self._open(tracks, mask, number)
        self._play_or_pause(item.live is not None)

    def _open(self, tracks: EpisodeTracks, mask: np.ndarray | None, number: int) -> None:
        """Remove what belonged to the last episode, draw this one's scene, go to its start."""
        assert tracks.q is not None
        for handle in self._parts.values():
            handle.remove()
        self.tracks, self._target_mask, self._number = tracks, mask, number
        links = len(self.robot.link_names)
        self._link_pos, self._link_quat = np.zeros((0, links, 3)), np.zeros((0, links, 4))
        self._command = (np.zeros((0, 3)), np.zeros((0, 4)))
        self._grow(tracks, mask)
        self._parts, self._moving = {}, []
        self._groups: dict[str, list[Any]] = {"solids": [], "camera": [], "lidar": [], "command": []}
        for i, solid in enumerate(tracks.solids):
            moves = np.ndim(solid.pos) == 2
            first = (solid.pos[0], solid.quat[0]) if moves else (solid.pos, solid.quat)
            path, shape = f"/scene/{i}", (solid.type, solid.size, solid.rgba[:3])
            handle = add_solid(self.server.scene, path, *shape, *first, solid.vertices, solid.faces)
            handle.visible = self._layers["Scene"].value
            self._parts[f"solid {i}"] = handle
            self._groups["solids"].append(handle)
            if moves:
                self._moving.append((handle, i))
        if tracks.action is not None:
            self._parts["command"] = self.server.scene.add_frame(
                "/command", axes_length=0.1, axes_radius=0.005, visible=self._layers["Controller's target"].value
            )
            self._groups["command"].append(self._parts["command"])
        self._sight.visible = tracks.camera is not None
        self.show(0)

    def _grow(self, tracks: EpisodeTracks, mask: np.ndarray | None) -> None:
        """Take over the tracks of the same episode with more steps."""
        assert tracks.q is not None
        self.tracks, self._target_mask, known = tracks, mask, len(self._link_pos)
        pos, quat = self._kinematics(tracks.q[known:])
        self._link_pos, self._link_quat = np.concatenate([self._link_pos, pos]), np.concatenate([self._link_quat, quat])
        if tracks.action is not None:
            pos, quat = self._kinematics(to_target(np, tracks.q[known:], tracks.action[known:], ActionSpec()))
            frame = self.robot.frames["ee"]
            rot = quat_to_mat(np, quat[:, frame.link])
            tip = pos[:, frame.link] + rot @ frame.pos
            turned = mats_to_quats(rot @ quat_to_mat(np, frame.quat))
            self._command = tuple(np.concatenate(pair) for pair in zip(self._command, (tip, turned), strict=True))

    def _kinematics(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World positions [T,L,3] and quaternions [T,L,4] of the links at `q` [T,32]."""
        rot, pos = batched_kinematics(self.robot, q)
        return pos, np.stack([mats_to_quats(rot[:, i]) for i in range(rot.shape[1])], axis=1)

    def _show_command(self, k: int) -> None:
        """The pose of the grasp frame that the step's joint targets mean."""
        if "command" in self._parts:
            self._parts["command"].position, self._parts["command"].wxyz = (a[k] for a in self._command)

    def _show_clouds(self, k: int) -> None:
        """Clouds are stored in the base frame: they hang below the base's frame and move with it."""
        base = self.robot.link_names[self.robot.frames["base"].link]
        if self.tracks.camera is not None:
            xyz, rgb, valid = (a[k] for a in self.tracks.camera)
            keep = valid != 0
            colours = np.array(rgb[keep], dtype=np.uint8)
            if self._mask.value and self._target_mask is not None:
                colours[self._target_mask[k][keep] != 0] = _TARGET_RGB
            self._put_cloud("camera", f"/robot/{base}/camera_points", xyz[keep], colours, 0.012)
            self._sight.image = self._picture(k, xyz[keep], colours)
        if self.tracks.lidar is not None:
            xyz, valid = (a[k] for a in self.tracks.lidar)
            points = xyz[valid != 0]
            self._put_cloud("lidar", f"/robot/{base}/lidar_points", points, np.tile(_LIDAR_RGB, (len(points), 1)), 0.02)

    def _picture(self, k: int, points: np.ndarray, colours: np.ndarray) -> np.ndarray:
        """Points of the base frame from where the camera stands."""
        camera, base = self.robot.frames["camera"], self.robot.frames["base"].link
        rot_b, rot_l = (quat_to_mat(np, self._link_quat[k, i]) for i in (base, camera.link))
        pos = self._link_pos[k, camera.link] + rot_l @ camera.pos - self._link_pos[k, base]
        return sight_image(points, colours, rot_b.T @ rot_l @ quat_to_mat(np, camera.quat), rot_b.T @ pos)

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

    def _follow_policy(self, live: Live) -> None:
        """Draw the newest step of a policy that runs."""
        try:
            live.set_pace(paused=False, speed=float(self._speed.value))
            news = live.poll()
        except ValueError as error:
            self._play_or_pause(False)
            self._clock.content = f"**The policy stopped:** {error}"
            return
        if news is None:
            return
        number, tracks, mask = news
        with self._lock:
            if number != self._number:
                self._open(tracks, mask, number)
            elif len(tracks.times) > len(self.tracks.times):
                self._grow(tracks, mask)
            else:
                return
            self.show(len(tracks.times) - 1)

    def _run(self) -> None:
        """The clock: real time times the chosen speed, skipping steps when drawing is slow."""
        begun, origin, drawn, speed = None, 0.0, -1, self._speed.value
        while not self._stop.wait(0.02):
            if not self.playing:
                begun = None
                continue
            if self._item.live:
                self._follow_policy(self._item.live)
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


def _first_steps(live: Live) -> tuple[EpisodeTracks, np.ndarray, int]:
    """Tracks, target mask and number of a live policy's episode, waiting for its first step."""
    live.set_pace(paused=False, speed=1.0)
    while (news := live.poll()) is None:
        time.sleep(0.05)
    number, tracks, mask = news
    return tracks, mask, number

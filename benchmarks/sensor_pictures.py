"""Draw what the sensors see into `docs/images/sensors.png` (run from the repository root; no display is needed)."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap

from wbm.robot.model import load_robot
from wbm.sensors.bench_scene import TABLE_X, robot_bodies, sample_meshes, sensor_pose, tabletop
from wbm.sensors.cloud import PointCloud
from wbm.sensors.config import CloudConfig, DepthConfig, DepthNoise, LidarConfig, LidarNoise
from wbm.sensors.depth import DepthCamera
from wbm.sensors.lidar import Lidar
from wbm.sensors.poses import look_at
from wbm.sensors.render import render_rgb
from wbm.sensors.scene import RayScene, Semantic

OUT = Path("docs/images/sensors.png")
WIDTH, HEIGHT = 160, 120
LIDAR_STEPS = 40
CLASSES = ("none", "floor", "target", "robot", "support", "distractor")
PALETTE = ("#ffffff", "#c8c8c8", "#d62728", "#4c78a8", "#b58b5a", "#59a14f")


def classes(ids: np.ndarray) -> np.ndarray:
    """Semantic ids with all distractors made one class, 0 being no return."""
    return np.minimum(ids, Semantic.DISTRACTOR) + 1


def build_scene() -> tuple[RayScene, np.ndarray, float]:
    """A table top before the robot at its home pose; the scene, the joints and the table's height (m)."""
    robot, meshes = load_robot(), sample_meshes(4)
    rng = np.random.default_rng(4)
    row, height = tabletop(rng, 56, 4, len(meshes))
    scene = RayScene(1, len(robot.link_names), 56, meshes)
    scene.update_envs([0], row)
    scene.body_pos.numpy()[0], scene.body_quat.numpy()[0] = robot_bodies(robot.q_home)
    return scene, robot.q_home, height


def scatter(axes: Axes, points: np.ndarray, colors: np.ndarray, size: float, title: str) -> None:
    """Points in the base frame."""
    axes.scatter(*points.T, c=colors, s=size, linewidths=0, depthshade=False)
    axes.set_title(title, fontsize=9)
    axes.set_box_aspect(np.ptp(points, axis=0) + 0.2)
    axes.view_init(elev=24, azim=-150)
    axes.tick_params(labelsize=6)


def main() -> None:
    scene, q, height = build_scene()
    robot = load_robot()
    eye = np.array([TABLE_X - 0.62, 0.15, height + 0.5])
    cameras = []
    for noise in (None, DepthNoise()):
        config = DepthConfig(width=WIDTH, height=HEIGHT, noise=noise)
        camera = DepthCamera(config, scene, exclude_body=robot.frames["camera"].link)
        camera.pos.assign(eye[None].astype(np.float32))
        camera.quat.assign(look_at(eye, np.array([TABLE_X, 0.0, height]))[None].astype(np.float32))
        camera.render()
        cameras.append(camera)
    exact, noisy = cameras

    fig = plt.figure(figsize=(13, 7.4), dpi=90)
    picture = fig.add_subplot(2, 3, 1)
    stand = np.array([-0.9, -1.7, 1.5])
    picture.imshow(render_rgb(scene, 0, stand, look_at(stand, [0.55, 0.0, 0.5]), 640, 480))
    picture.set_title("scene (software renderer)", fontsize=9)

    for place, camera, title in ((2, exact, "depth, exact (m)"), (4, noisy, "depth with noise (m)")):
        axes = fig.add_subplot(2, 3, place)
        depth = camera.depth.numpy()[0].reshape(HEIGHT, WIDTH)
        image = axes.imshow(np.where(depth > 0, depth, np.nan), cmap="viridis_r", vmin=0.3, vmax=2.0)
        axes.set_title(title, fontsize=9)
        fig.colorbar(image, ax=axes, fraction=0.035)

    axes = fig.add_subplot(2, 3, 3)
    axes.imshow(classes(exact.id.numpy()[0]).reshape(HEIGHT, WIDTH), cmap=ListedColormap(PALETTE), vmin=0, vmax=5)
    axes.set_title("semantic id", fontsize=9)
    marks = [
        plt.Line2D([], [], marker="s", ls="", color=c, label=n) for n, c in zip(CLASSES[1:], PALETTE[1:], strict=True)
    ]
    axes.legend(handles=marks, fontsize=6, loc="lower right")

    cloud = PointCloud(CloudConfig(num_points=1024, crop_min=(0.2, -0.8, -0.1), crop_max=(1.9, 0.8, 1.5)), noisy)
    cloud.assemble()
    valid = cloud.valid.numpy()[0]
    rgb = np.where(cloud.target.numpy()[0][:, None], (0.84, 0.15, 0.16), cloud.rgb.numpy()[0] * 0.9)
    title = f"cloud of {valid.sum()} points, base frame; target in red"
    scatter(fig.add_subplot(2, 3, 5, projection="3d"), cloud.xyz.numpy()[0][valid], rgb[valid], 6, title)

    lidar = Lidar(LidarConfig(noise=LidarNoise()), scene, exclude_body=robot.frames["lidar"].link)
    pos, quat = sensor_pose("lidar", q)
    lidar.pos.assign(pos[None].astype(np.float32))
    lidar.quat.assign(quat[None].astype(np.float32))
    points, ids = [], []
    for step in range(LIDAR_STEPS):
        lidar.step.fill_(step)
        lidar.render()
        keep = lidar.valid.numpy()[0] & (lidar.range.numpy()[0] < 2.0)
        points.append(lidar.point_w.numpy()[0][keep])
        ids.append(lidar.id.numpy()[0][keep])
    colors = np.array(PALETTE)[classes(np.concatenate(ids))]
    title = f"LiDAR, {LIDAR_STEPS} steps of 1,024 rays, up to 2 m"
    scatter(fig.add_subplot(2, 3, 6, projection="3d"), np.concatenate(points), colors, 2, title)

    for axes in fig.axes:
        if axes.images:
            axes.set_xticks([])
            axes.set_yticks([])
    fig.tight_layout()
    OUT.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(OUT, metadata={"Software": None})


if __name__ == "__main__":
    main()

"""What can be looked at: episodes, scenes and the robot, as tracks over time for the viewer and for MCAP."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from wbm.artifacts.mcap_io import BOX, MESH, EpisodeTracks, Solid, write_mcap
from wbm.robot import joints
from wbm.robot.model import RobotModel, load_robot
from wbm.robot.proprio import quat_to_mat
from wbm.robot.schema import PROPRIO_LABELS, PolicySchema
from wbm.robot.spheres import batched_kinematics

_IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
_BODY = joints.NUM_JOINTS - joints.BASE.stop
_QD = slice(_BODY, _BODY + joints.NUM_JOINTS)  # base twist in the base frame, then the body's velocities
_STEP_FIELDS = ("base_pose", "p_obj_w", "stamp", "action", "executed", "phase", "ee_distance", "p_obj_b")


def joint_tracks(proprio: np.ndarray, base_pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joint positions and velocities [T,32] from proprioception [T,D] and the base's pose in the world [T,3]."""
    if proprio.shape[1] != len(PROPRIO_LABELS):
        raise ValueError(f"proprio has {proprio.shape[1]} values, expected {len(PROPRIO_LABELS)}")
    q = np.concatenate([base_pose, proprio[:, :_BODY]], axis=1).astype(np.float64)
    qd = proprio[:, _QD].astype(np.float64)
    c, s = np.cos(q[:, 2]), np.sin(q[:, 2])
    qd[:, 0], qd[:, 1] = c * qd[:, 0] - s * qd[:, 1], s * qd[:, 0] + c * qd[:, 1]
    return q, qd


def frame_tracks(robot: RobotModel, q: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """World positions [T,3] and quaternions [T,4] (w x y z) of the robot's frames at `q` [T,32]."""
    rot, pos = batched_kinematics(robot, q)
    frames = {}
    for name, frame in robot.frames.items():
        r = rot[:, frame.link] @ quat_to_mat(np, frame.quat)
        frames[name] = (pos[:, frame.link] + rot[:, frame.link] @ frame.pos, mats_to_quats(r))
    return frames


def mats_to_quats(rot: np.ndarray) -> np.ndarray:
    """Unit quaternions [T,4] (w x y z) of rotation matrices [T,3,3]; the sign keeps neighbours close."""
    m = rot
    # The eigenvector of the largest eigenvalue of Bar-Itzhack's symmetric matrix (2000): no branches, no cancellation.
    k = np.empty((len(m), 4, 4))
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    k[:, 0, 0], k[:, 1, 1], k[:, 2, 2], k[:, 3, 3] = xx + yy + zz, xx - yy - zz, yy - xx - zz, zz - xx - yy
    k[:, 0, 1] = k[:, 1, 0] = m[:, 2, 1] - m[:, 1, 2]
    k[:, 0, 2] = k[:, 2, 0] = m[:, 0, 2] - m[:, 2, 0]
    k[:, 0, 3] = k[:, 3, 0] = m[:, 1, 0] - m[:, 0, 1]
    k[:, 1, 2] = k[:, 2, 1] = m[:, 1, 0] + m[:, 0, 1]
    k[:, 1, 3] = k[:, 3, 1] = m[:, 0, 2] + m[:, 2, 0]
    k[:, 2, 3] = k[:, 3, 2] = m[:, 2, 1] + m[:, 1, 2]
    quat = np.linalg.eigh(k)[1][:, :, -1]
    flips = np.cumprod(np.concatenate([[1.0], np.where(np.sum(quat[1:] * quat[:-1], axis=1) < 0, -1.0, 1.0)]))
    quat *= flips[:, None]
    return quat if quat[0, 0] >= 0 else -quat


def episode_tracks(
    episode: dict[str, Any], solids: tuple[Solid, ...] = (), robot: RobotModel | None = None
) -> EpisodeTracks:
    """Tracks of a stored episode.

    Args:
        episode: step fields [T, ...] of the dataset and the facts of the episode (`instructions`, `success`).
        solids: supports and objects, from `scene_solids`.
        robot: the robot; the standard one by default.
    """
    robot = robot or load_robot()
    q, qd = joint_tracks(np.asarray(episode["proprio"]), np.asarray(episode["base_pose"], dtype=np.float64))
    times = np.asarray(episode["stamp"], dtype=np.float64)
    log = [(float(times[0]), f"instruction: {(list(episode.get('instructions', [])) or ['none'])[0]}")]
    changes = np.flatnonzero(np.diff(np.asarray(episode["phase"]).astype(int))) + 1
    log += [(float(times[k]), "contact phase" if episode["phase"][k] else "free-space phase") for k in changes]
    log.append((float(times[-1]), "success" if episode.get("success") else "no success"))
    return EpisodeTracks(
        times=times,
        joint_names=joints.JOINT_NAMES,
        q=q,
        qd=qd,
        action=np.asarray(episode["action"]),
        frames=frame_tracks(robot, q),
        camera=(np.asarray(episode["depth_xyz"], np.float32), episode["depth_rgb"], episode["depth_valid"]),
        lidar=(np.asarray(episode["lidar_xyz"], np.float32), episode["lidar_valid"]),
        solids=solids,
        log=tuple(log),
    )


def scene_solids(assets: Any, scene: int, target_pos: np.ndarray | None = None) -> tuple[Solid, ...]:
    """Supports, target and distractors of a scene of an assets artifact.

    Args:
        assets: `wbm.scenes.assets.Assets`.
        scene: index into its bank.
        target_pos: positions [T,3] of the target in the world, when it moves; its settled orientation is kept.
    """
    bank, objects = assets.scenes, assets.objects
    rgb = (*np.asarray(bank.support_rgb[scene], dtype=float), 1.0)
    solids = [
        Solid(
            f"support {i}",
            BOX,
            bank.support_size[scene, i],
            rgb,
            bank.support_pos[scene, i],
            bank.support_quat[scene, i],
        )
        for i in range(int(bank.support_count[scene]))
    ]
    for column, index in enumerate(bank.object[scene]):
        if index < 0:
            continue
        pos, quat = bank.object_pos[scene, column], bank.object_quat[scene, column]
        if column == 0 and target_pos is not None:
            pos, quat = target_pos, np.tile(quat, (len(target_pos), 1))
        name = f"target: {objects.name[index]}" if column == 0 else f"distractor {column}: {objects.name[index]}"
        colour = (*np.asarray(objects.rgb[index], dtype=float), 1.0)
        solids.append(Solid(name, MESH, (0.0, 0.0, 0.0), colour, pos, quat, *objects.mesh(int(index))))
    return tuple(solids)


def target_marker(p_obj_w: np.ndarray) -> Solid:
    """A small ball at the target's recorded position [T,3], for episodes whose scene is not at hand."""
    return Solid("target", 2, (0.03, 0.0, 0.0), (0.9, 0.35, 0.1, 0.8), p_obj_w, np.tile(_IDENTITY, (len(p_obj_w), 1)))


def robot_tracks(robot: RobotModel | None = None, seconds: float = 16.0, rate_hz: float = 25.0) -> EpisodeTracks:
    """The robot alone: from its home pose each joint in turn visits part of its range."""
    robot = robot or load_robot()
    times = np.arange(int(seconds * rate_hz)) / rate_hz
    q = np.tile(robot.q_home, (len(times), 1))
    turn = seconds / joints.NUM_JOINTS
    for j in range(joints.NUM_JOINTS):
        phase = np.clip((times - j * turn) / turn, 0.0, 1.0)
        room = robot.q_max[j] - robot.q_home[j], robot.q_home[j] - robot.q_min[j]
        side = 1.0 if room[0] >= room[1] else -1.0
        q[:, j] += side * min(0.5, 0.6 * max(room)) * np.sin(np.pi * phase) ** 2
    return EpisodeTracks(times=times, joint_names=joints.JOINT_NAMES, q=q, frames=frame_tracks(robot, q))


def scene_tracks(assets: Any, scene: int) -> EpisodeTracks:
    """A scene of the bank with the robot at its start."""
    q = np.asarray(assets.scenes.q_start[scene], dtype=np.float64)[None]
    tracks = EpisodeTracks(times=np.zeros(1), joint_names=joints.JOINT_NAMES, q=q, frames=frame_tracks(assets.robot, q))
    return EpisodeTracks(**{**tracks.__dict__, "solids": scene_solids(assets, scene)})


def write_episode_mcap(
    path: str | Path, episode: dict[str, Any], schema: PolicySchema, solids: tuple[Solid, ...] = ()
) -> int:
    """A stored episode as MCAP: Foxglove topics and every numeric array; returns the number of messages."""
    names = [f.name for f in schema.observation if f.name != "text"]
    arrays = {n: np.asarray(episode[n]) for n in (*names, *_STEP_FIELDS) if n in episode}
    solids = solids or (target_marker(np.asarray(episode["p_obj_w"], dtype=np.float64)),)
    facts: dict[str, Any] = {k: v for k, v in episode.items() if isinstance(v, (str, bool, int, float))}
    facts["instructions"] = [str(s) for s in episode.get("instructions", [])]
    return write_mcap(path, episode_tracks(episode, solids), arrays, facts)

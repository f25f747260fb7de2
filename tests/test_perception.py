"""Link poses and perception against float64 kinematics and geometry."""

import numpy as np
import pytest
import torch
import warp as wp

from wbm.control.links import LinkPoses
from wbm.robot.model import forward_kinematics, frame_poses, load_robot
from wbm.robot.rotations import quat_to_mat
from wbm.robot.spheres import sample_configurations

TOLERANCE_M = 2e-6  # float32 over a chain of 20 links of at most 10 m


def test_link_poses_agree_with_float64():
    robot = load_robot()
    q = sample_configurations(robot, 16, seed=3)
    q[:, :3] = np.random.default_rng(0).uniform(-1.5, 1.5, (16, 3))
    links = LinkPoses(robot, 16)
    links._pos.fill_(wp.vec3(np.inf, np.inf, np.inf))
    links.update(torch.tensor(q, dtype=torch.float32))
    for e in range(16):
        rot, pos = forward_kinematics(robot, q[e].astype(np.float32).astype(float))
        assert np.abs(links.pos[e].numpy() - pos).max() < TOLERANCE_M
        assert np.abs(quat_to_mat(links.quat[e].numpy()) - rot).max() < 5e-6


@pytest.mark.parametrize("name", ["ee", "camera", "lidar", "tip_thumb"])
def test_frames_agree_with_float64(name):
    robot = load_robot()
    q = sample_configurations(robot, 4, seed=5)
    links = LinkPoses(robot, 4)
    links.update(torch.tensor(q, dtype=torch.float32))
    pos, quat = links.frames([name])
    for e in range(4):
        rot, at = frame_poses(robot, q[e])[name]
        assert np.abs(pos[e, 0].numpy() - at).max() < TOLERANCE_M
        assert np.abs(quat_to_mat(quat[e, 0].numpy()) - rot).max() < 5e-6

"""The simulator's driver: the runtime sees what the environment saw, and a refusal holds the last command."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from deploy_synthetic import SCHEMA, forward, make_bundle, weights

from wbm.deploy.bundle import Bundle
from wbm.report.tracks import frame_tracks
from wbm.robot.model import load_robot
from wbm.robot.proprio import FRAMES, proprioception
from wbm.robot.schema import to_target

N, STEPS = 3, 6


def world(step: int, q: np.ndarray, previous: np.ndarray) -> dict[str, np.ndarray]:
    """Observations of N environments as the simulator assembles them, clouds in the base frame."""
    rng, qd = np.random.default_rng(step), np.zeros((N, 32))
    frames = frame_tracks(load_robot(), q)
    pos, quat = (np.stack([frames[n][i] for n in FRAMES], axis=1) for i in (0, 1))
    p, m = SCHEMA.num_depth_points, SCHEMA.num_lidar_points
    depth, lidar = rng.normal(size=(N, p, 3)) + np.array([1, 0, 0.5]), rng.normal(size=(N, m, 3)) + np.array([2, 0, 0])
    valid = rng.integers(0, 2, (N, p), dtype=np.uint8)
    return {
        "depth_xyz": np.where(valid[..., None] != 0, depth, 0).astype(np.float32),
        "depth_rgb": rng.integers(0, 256, (N, p, 3), dtype=np.uint8),
        "depth_valid": valid,
        "depth_target": rng.integers(0, 2, (N, p), dtype=np.uint8),
        "lidar_xyz": lidar.astype(np.float32),
        "lidar_valid": np.ones((N, m), np.uint8),
        "proprio": proprioception(np, q, qd, pos, quat).astype(np.float32),
        "prev_action": previous,
        "text": np.tile(rng.normal(size=8), (N, 1)).astype(np.float32),
    }


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return Bundle.open(make_bundle(tmp_path_factory.mktemp("driver") / "p.wbm"))


def test_runtime_sees_what_the_environment_saw(bundle):
    torch = pytest.importorskip("torch")
    from wbm.learning.runtime_driver import RuntimeDriver

    driver, robot = RuntimeDriver(bundle, N), load_robot()
    q = np.tile(robot.q_home, (N, 1))
    q[:, :3] = [[0.1, 0.2, 0.3], [-0.5, 0.4, 2.0], [0.0, 0.0, 0.0]]
    obs = world(0, q, np.zeros((N, 32), np.float32))
    sent = []
    env = SimpleNamespace(
        state=SimpleNamespace(q=torch.from_numpy(q), qd=torch.zeros(N, 32)),
        episode=torch.arange(N),
        elapsed=torch.zeros(N, dtype=torch.int64),
        device="cpu",
        step_targets=lambda ctrl: sent.append(ctrl) or "done",
    )
    sight = SimpleNamespace(obs={k: torch.from_numpy(v) for k, v in obs.items()})
    assert driver.step(env, sight) == "done"
    for i, runtime in enumerate(driver._runtimes):
        for name, values in runtime.observation.items():
            np.testing.assert_allclose(values, obs[name][i], atol=2e-6, err_msg=name)  # float32 clouds there and back
    action = forward(obs, weights())
    wished = to_target(np, q, action, SCHEMA.action)
    c = bundle.contract
    # From rest the filter allows qdd_max dt^2 in the first step; where less is wished, nothing is changed.
    room = np.minimum(c.qdd_max * c.dt**2, c.qd_max * c.dt)
    expected = np.clip(wished, q - room, q + room)
    np.testing.assert_allclose(sent[0].numpy(), np.clip(expected, c.q_min, c.q_max), atol=2e-5)


def test_a_refusal_holds_and_a_new_episode_starts_anew(bundle):
    pytest.importorskip("torch")
    from wbm.learning.runtime_driver import RuntimeDriver

    driver, q = RuntimeDriver(bundle, N), np.tile(load_robot().q_home, (N, 1))
    qd, previous = np.zeros((N, 32)), np.zeros((N, 32), np.float32)
    episode = np.arange(N)
    for step in range(STEPS):
        before = driver._target.copy()
        obs = world(step, q, previous)
        if step == 3:
            obs["depth_xyz"][1, 0] = np.nan
            obs["depth_valid"][1, 0] = 1
        targets = driver.targets(q, qd, obs, episode, np.full(N, step)).copy()
        if step == 3:
            np.testing.assert_array_equal(targets[1], before[1])
            assert (targets[0] != before[0]).any()
    assert driver.refusals == {1: {"not-finite": 1}}
    driver.targets(q, qd, world(0, q, previous), episode + N, np.zeros(N))
    for runtime in driver._runtimes:
        assert not runtime.observation["prev_action"].any()
    assert driver.refusals == {1: {"not-finite": 1}}

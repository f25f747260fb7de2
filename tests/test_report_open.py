"""What `wbm view` finds in artifacts."""

from __future__ import annotations

import numpy as np
import pytest
from test_deploy_export import SCHEMA, STEPS, record

from stages.view import items_of, robot_items
from wbm.artifacts.mcap_io import read_mcap
from wbm.report.tracks import write_episode_mcap


def test_episodes_are_found_and_become_mcap(tmp_path):
    from wbm.artifacts.episode_reader import EpisodeReader, shard_paths

    pytest.importorskip("viser")
    record(tmp_path / "shards")
    items = items_of(tmp_path, "rollouts")
    assert len(items) == 1 and "mug, success" in items[0].name
    tracks = items[0].load()
    assert tracks.q.shape == (STEPS, 32) and items[0].target_mask.shape == (STEPS, SCHEMA.num_depth_points)
    assert tracks.solids[0].id == "target" and tracks.log[0][1] == "instruction: pick up the mug"
    episode = EpisodeReader(shard_paths(tmp_path / "shards")[0], SCHEMA).read_episode(0)
    write_episode_mcap(tmp_path / "a.mcap", episode, SCHEMA)
    arrays, facts = read_mcap(tmp_path / "a.mcap")
    assert facts["object"] == "mug" and facts["instructions"] == ["pick up the mug", "take the mug"]
    for name in ("depth_xyz", "proprio", "action", "phase"):
        np.testing.assert_array_equal(arrays[name], episode[name])


def test_nothing_to_view_says_what_to_do(tmp_path):
    pytest.importorskip("viser")
    with pytest.raises(ValueError, match="try rollouts"):
        items_of(tmp_path, "student")
    assert len(robot_items()) == 1

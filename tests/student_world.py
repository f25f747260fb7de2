"""A synthetic world for the student's tests: coloured blobs on a table; actions point from grasp frame to target.

The target is marked by the mask and named by an instruction ("pick up the red thing"), whose embedding is a fixed
random vector per sentence. Everything that the student must output is a simple function of the target's position.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from wbm.artifacts.episodes import EpisodeWriter
from wbm.robot.schema import PROPRIO_LABELS, PolicySchema

SCHEMA = PolicySchema().with_points(64, 32)
COLOURS = {"red": (220, 30, 30), "green": (30, 200, 40), "blue": (40, 60, 220), "yellow": (220, 210, 40)}
_EE = PROPRIO_LABELS.index("ee_pos_b/x")
_ROT = PROPRIO_LABELS.index("ee_rot6d_b/0")


def embed(sentence: str, dim: int = SCHEMA.text_dim) -> np.ndarray:
    """Unit vector [dim], a function of the sentence alone."""
    vector = np.random.default_rng(list(sentence.encode())).standard_normal(dim)
    return (vector / np.linalg.norm(vector)).astype(np.float32)


def make_episode(seed: int, length: int = 20, schema: PolicySchema = SCHEMA) -> dict:
    """A whole episode in `EpisodeWriter.add`'s form, with three blobs, one of them the target."""
    rng = np.random.default_rng(seed)
    p, m = schema.num_depth_points, schema.num_lidar_points
    names = rng.permutation(list(COLOURS))[:3]
    centres = np.stack([rng.uniform(0.4, 0.9, 3), rng.permutation([-0.25, 0.0, 0.25]) + rng.uniform(-0.05, 0.05, 3)], 1)
    centres = np.column_stack([centres, np.full(3, 0.45)])
    goal = centres[0]
    rng.shuffle(order := np.arange(3))
    per = p // 4
    kind = np.concatenate([np.repeat(order, per), np.full(p - 3 * per, 3)])
    colours = np.array([*(COLOURS[n] for n in names), (128, 128, 128)])
    ee = rng.uniform([0.2, -0.4, 0.4], [0.6, 0.4, 0.9])
    out: dict = {k: [] for k in ("depth_xyz", "depth_rgb", "depth_valid", "depth_target", "lidar_xyz", "lidar_valid")}
    out |= {k: [] for k in ("proprio", "prev_action", "action", "ee_distance")}
    for _ in range(length):
        xyz = np.where(
            (kind < 3)[:, None],
            centres[np.minimum(kind, 2)] + rng.normal(0.0, 0.015, (p, 3)),
            np.column_stack([rng.uniform(0.3, 1.0, p), rng.uniform(-0.4, 0.4, p), np.full(p, 0.42)]),
        )
        valid = rng.random(p) > 0.05
        proprio = np.zeros(schema.field_named("proprio").shape[0])
        proprio[_EE : _EE + 3] = ee
        proprio[_ROT], proprio[_ROT + 4] = 1.0, 1.0
        delta = goal - ee
        action = np.zeros(32)
        action[0:3] = 2.0 * delta
        action[3:6] = 3.0 * delta
        action[10:26] = 1.0 if np.linalg.norm(delta) < 0.15 else -0.5
        out["depth_xyz"].append(xyz * valid[:, None])
        out["depth_rgb"].append(colours[kind] + rng.integers(-10, 10, (p, 3)))
        out["depth_valid"].append(valid)
        out["depth_target"].append((kind == 0) & valid)
        out["lidar_xyz"].append(rng.uniform(-2.0, 2.0, (m, 3)))
        out["lidar_valid"].append(np.ones(m))
        out["proprio"].append(proprio)
        out["prev_action"].append(rng.standard_normal(32))  # tells nothing of the target, nor does the state
        out["action"].append(action)
        out["ee_distance"].append(np.linalg.norm(delta))
        ee = goal + rng.uniform(-0.2, 0.2, 3) if rng.random() < 0.3 else rng.uniform([0.2, -0.4, 0.4], [0.6, 0.4, 0.9])
    episode = {k: np.asarray(v) for k, v in out.items()}
    episode["depth_rgb"] = np.clip(episode["depth_rgb"], 0, 255).astype(np.uint8)
    sentences = [f"pick up the {names[0]} thing", f"grasp {names[0]}"]
    return episode | {
        "executed": episode["action"] + 0.1,
        "p_obj_b": np.tile(goal, (length, 1)),
        "p_obj_w": np.tile(goal, (length, 1)),
        "base_pose": np.zeros((length, 3)),
        "stamp": 0.04 * np.arange(length),
        "phase": (episode["ee_distance"] < 0.15).astype(np.uint8),
        "instructions": sentences,
        "text": np.stack([embed(s, schema.text_dim) for s in sentences]),
        "scene": f"table-{seed}",
        "object": names[0],
        "teacher": "top_down",
        "noise": float(seed % 2),
        "start": "pregrasp" if seed % 3 == 0 else "full",
        "success": True,
        "seed": seed,
    }


def write_shards(
    folder: Path, episodes: int, shards: int = 2, length: int = 20, schema: PolicySchema = SCHEMA, first_seed: int = 0
) -> list[Path]:
    """Shards of synthetic episodes; their indices."""
    paths = []
    for shard in range(shards):
        writer = EpisodeWriter(folder, schema, shard)
        for seed in range(shard, episodes, shards):
            writer.add(make_episode(first_seed + seed, length, schema))
        paths.append(writer.close())
    return paths

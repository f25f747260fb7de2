"""Golden vectors and parity of an export, from the evaluation's recorded episodes where it has any."""

# torch types registered buffers as Tensor | Module.
# pyright: reportCallIssue=false

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from wbm.deploy.policy import OnnxPolicy
    from wbm.learning.student import StudentPolicy
    from wbm.robot.schema import PolicySchema

EPISODES = "episodes"
"""Folder of an evaluation that holds its recorded episodes, as shards."""


def recorded_episode(schema: PolicySchema, evaluation: Path) -> dict[str, np.ndarray] | None:
    """Observations [T, ...] of the first recorded episode of an evaluation; None when it recorded none."""
    from wbm.artifacts.episode_reader import EpisodeReader

    indices = sorted((evaluation / EPISODES).glob("shard-*.json"))
    if not indices:
        return None
    reader = EpisodeReader(indices[0], schema)
    if not reader.episodes:
        return None
    episode: dict[str, Any] = reader.read_episode(0)
    steps = len(episode["proprio"])
    text = np.asarray(episode["text"], np.float32)
    episode["text"] = np.tile(text[0] if len(text) else np.zeros(schema.text_dim, np.float32), (steps, 1))
    return {f.name: np.asarray(episode[f.name]).astype(f.dtype) for f in schema.observation}


def golden_observations(schema: PolicySchema, evaluation: Path, count: int) -> dict[str, np.ndarray]:
    """`count` observations: steps spread over a recorded episode, and one random one with empty clouds at the end."""
    from wbm.learning.export import random_observation

    golden = random_observation(schema, count, seed=0)
    episode = recorded_episode(schema, evaluation)
    if episode is not None and count > 1:
        steps = np.linspace(0, len(episode["proprio"]) - 1, count - 1).round().astype(int)
        for name, values in episode.items():
            golden[name][:-1] = values[steps]
    return golden


def rollout_parity(policy: StudentPolicy, onnx: OnnxPolicy, evaluation: Path) -> np.ndarray | None:
    """Largest difference between torch and ONNX in each step [T] of a recorded episode; None without one."""
    episode = recorded_episode(policy.schema, evaluation)
    if episode is None:
        return None
    steps = [{name: values[k : k + 1] for name, values in episode.items()} for k in range(len(episode["proprio"]))]
    return np.array([np.abs(onnx(step) - policy.act(step).cpu().numpy()).max() for step in steps])


def normalisers(policy: StudentPolicy) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Mean and standard deviation of the fields that the network normalises, for the contract."""
    tokenizer = policy.network.tokenizer
    proprio = tokenizer.proprio_mean.cpu().numpy(), tokenizer.proprio_std.cpu().numpy()
    spread = tokenizer.prev_action_std.cpu().numpy()
    return {"proprio": proprio, "prev_action": (np.zeros_like(spread), spread)}

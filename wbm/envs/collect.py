"""Records episodes into a shard of the dataset: what the student will learn from (equation (7))."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from wbm.artifacts.episodes import EpisodeWriter
from wbm.envs.episodes import Frame, Record
from wbm.envs.rollout_config import NoiseConfig
from wbm.robot import joints

_OBSERVED = (
    "depth_xyz",
    "depth_rgb",
    "depth_valid",
    "depth_target",
    "lidar_xyz",
    "lidar_valid",
    "proprio",
    "prev_action",
)


def injected_noise(cfg: NoiseConfig, seed: int) -> Callable[[np.ndarray, int], np.ndarray]:
    """A function (episodes [K], steps T) -> noise [K,T,32] on joint targets; an episode's depends on it and seed alone.

    It depends on `steps` too: what is drawn for the spells follows what is drawn for the steps.
    """
    scale = np.zeros(joints.NUM_JOINTS)
    for value, group in zip(cfg.scale, (joints.BASE, joints.ARM, joints.HAND, joints.NECK), strict=True):
        scale[group] = value

    def draw(episodes: np.ndarray, steps: int) -> np.ndarray:
        out = np.zeros((len(episodes), steps, joints.NUM_JOINTS), dtype=np.float32)
        for row, episode in zip(out, episodes, strict=True):
            rng = _generator(seed, int(episode))
            level = _draw_level(cfg, rng)
            if level == 0.0:
                continue
            drive = rng.standard_normal(row.shape) * (cfg.innovation * level * scale)
            if cfg.spell:  # noise comes and goes
                switches = rng.random(steps) < 1.0 / cfg.spell
                drive[(np.cumsum(switches) + rng.integers(2)) % 2 == 1] = 0.0
            state = np.zeros(joints.NUM_JOINTS)
            for t in range(steps):
                state = cfg.correlation * state + drive[t]
                row[t] = state
        return out

    return draw


def noise_level(cfg: NoiseConfig, seed: int, episode: int) -> float:
    """Factor of the noise that `injected_noise` gives an episode."""
    return _draw_level(cfg, _generator(seed, episode))


def _generator(seed: int, episode: int) -> np.random.Generator:
    return np.random.default_rng([seed, episode, 0x4015E])


def _draw_level(cfg: NoiseConfig, rng: np.random.Generator) -> float:
    return float(cfg.levels[int(rng.integers(len(cfg.levels)))])


class Recorder:
    """Collects the frames of running episodes and writes those that are kept.

    Args:
        writer: the shard.
        describe: fields that a record's episode carries besides its steps: scene, object, teacher, start, noise, seed,
            instructions and their embeddings.
        keep: whether a record is kept.

    Attributes:
        reasons: outcomes counted by reason, kept or not.
    """

    def __init__(
        self,
        writer: EpisodeWriter,
        describe: Callable[[Record], dict[str, Any]],
        keep: Callable[[Record], bool],
        period: float,
    ) -> None:
        self.writer, self.describe, self.keep, self.period = writer, describe, keep, period
        self.reasons: Counter[str] = Counter()
        self.kept = 0
        self._frames: list[dict[str, np.ndarray]] = []
        self._first = 0
        self._begun: dict[int, int] = {}

    def on_frame(self, frame: Frame) -> None:
        """Remember one step of all environments."""
        assert frame.sight is not None
        for e in (frame.elapsed == 0).nonzero().squeeze(1).tolist():
            self._begun[e] = self._first + len(self._frames)
        rows = {name: _host(frame.sight.obs[name]) for name in _OBSERVED}
        rows |= {
            "action": _host(frame.action),
            "executed": _host(frame.executed),
            "p_obj_b": _host(frame.sight.target_pos_b.float()),
            "p_obj_w": _host(frame.object_pose[:, 0, :3]),
            "base_pose": _host(frame.q[:, :3]),
            "ee_distance": _host(frame.ee_distance.float()),
            "stamp": _host(frame.elapsed.float() * self.period),
            "phase": _host(frame.phase.to(torch.uint8)),
        }
        self._frames.append(rows)

    def on_end(self, env: int, record: Record) -> None:
        """Write the episode that just ended in an environment, if it is kept."""
        self.reasons[record.reason] += 1
        start = self._begun[env] - self._first
        if self.keep(record):
            steps = {name: np.stack([f[name][env] for f in self._frames[start:]]) for name in self._frames[0]}
            self.writer.add(steps | self.describe(record))
            self.kept += 1
        self._forget(env)

    def _forget(self, env: int) -> None:
        """Drop the frames that no running episode needs."""
        self._begun[env] = self._first + len(self._frames)
        oldest = min(self._begun.values()) - self._first
        del self._frames[:oldest]
        self._first += oldest


def _host(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy().copy()

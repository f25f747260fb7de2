"""Random windows of episodes, streamed from disk (bigger than memory).

A batch is a pure function of (seed, epoch, index), so it does not depend on how many processes load batches or on where
a run was interrupted. Memory is that of the index (about 40 bytes an episode and its names) and a few open files.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from wbm.artifacts.episode_reader import EpisodeReader
from wbm.learning.augment import augment, rng_of
from wbm.learning.student_config import AugmentConfig
from wbm.robot.schema import PolicySchema

_PER_STEP = ("p_obj_b", "ee_distance", "phase")


class EpisodeDataset(Dataset):
    """Batches of random windows.

    Item `(epoch, index)` is a dictionary of arrays: the schema's observation fields [B, ...], "action" [B, chunk, 32],
    "action_valid" [B, chunk] (0 after the episode's end), "p_obj_b" [B,3], "ee_distance" [B], "phase" [B], and
    "target_label" [B, P], the target mask as stored, before `augment` corrupted it.

    Args:
        paths: shard indices, see `wbm.artifacts.episode_reader.shard_paths`; their order matters.
        schema: that the shards must have been written with.
        batch_size: windows a batch.
        seed: of windows and augmentation.
        chunk: actions a window.
        pregrasp_share: share of a batch from episodes that start at the pre-grasp, when there are any.
        val_share: share of episodes that are held out.
        data_share: share of the episodes that are used at all.
        max_noise: episodes with more noise injected than this are left out.
        held_out: take the held-out episodes in place of the others.
        augmentation: what is done to observations; None for nothing but the choice of a phrasing.

    Raises:
        FileNotFoundError: a shard or a file of it does not exist.
        ValueError: a shard is damaged or was written with another schema, or no episode is left.
    """

    def __init__(
        self,
        paths: Sequence[str | Path],
        schema: PolicySchema,
        *,
        batch_size: int = 192,
        seed: int = 0,
        chunk: int = 1,
        pregrasp_share: float = 0.3,
        val_share: float = 0.0,
        data_share: float = 1.0,
        max_noise: float = float("inf"),
        held_out: bool = False,
        augmentation: AugmentConfig | None = None,
    ) -> None:
        self.schema = schema
        self.batch_size = batch_size
        self.seed = seed
        self.chunk = chunk
        self.augmentation = augmentation
        self._readers = [EpisodeReader(p, schema) for p in paths]
        infos = [(k, info) for k, r in enumerate(self._readers) for info in r.episodes if info.noise <= max_noise]
        # a share is every n-th episode, wherever shard boundaries lie
        infos = [e for i, e in enumerate(infos) if _falls_in(i, data_share)]
        chosen = [e for i, e in enumerate(infos) if _falls_in(i, val_share) == held_out]
        if not chosen:
            raise ValueError(f"no {'held-out ' if held_out else ''}episodes in {len(self._readers)} shards")
        self.num_left_out = len(infos) - len(chosen)
        table = [(k, info.first, info.length, info.start == "pregrasp") for k, info in chosen]
        self._phrasings = [info.instructions for _, info in chosen]
        self._episodes = np.asarray(table, np.int64)
        self._groups = [np.arange(len(table)), np.flatnonzero(self._episodes[:, 3])]
        self._ends = [np.cumsum(self._episodes[g, 2]) for g in self._groups]
        self._num_pregrasp = round(pregrasp_share * batch_size) if len(self._groups[1]) else 0
        self._names = (*(f.name for f in schema.observation if f.name != "text"), *_PER_STEP)

    @property
    def num_windows(self) -> int:
        """Windows (steps) to choose from."""
        return int(self._ends[0][-1])

    @property
    def num_episodes(self) -> int:
        """Episodes to choose from."""
        return len(self._episodes)

    @property
    def batches_per_epoch(self) -> int:
        """Batches that hold as many windows as there are."""
        return -(-self.num_windows // self.batch_size)

    def __len__(self) -> int:
        return self.batches_per_epoch

    def __getitem__(self, key: tuple[int, int]) -> dict[str, np.ndarray]:
        epoch, index = key
        rng = rng_of(self.seed, epoch, index)
        counts = (self.batch_size - self._num_pregrasp, self._num_pregrasp)
        picks = [self._pick(rng, group, count) for group, count in enumerate(counts)]
        episodes = np.concatenate([p[0] for p in picks])
        steps = np.concatenate([p[1] for p in picks])
        phrasing = rng.random(self.batch_size)
        batch = self._gather(episodes, steps, phrasing)
        if self.augmentation is not None:
            augment(batch, self.augmentation, rng)
        return batch

    def batches(self, start: int, stop: int, workers: int = 0) -> Iterator[dict[str, torch.Tensor]]:
        """Batches number `start` to `stop` of the endless sequence of epochs, as tensors.

        Args:
            start: first batch.
            stop: one past the last.
            workers: processes that load; the batches are the same for any number.
        """
        keys = [divmod(i, self.batches_per_epoch) for i in range(start, stop)]
        yield from DataLoader(
            self, batch_size=None, sampler=keys, num_workers=workers, prefetch_factor=4 if workers else None
        )

    def statistics(self, num_batches: int = 8) -> dict[str, np.ndarray]:
        """Mean and standard deviation over random windows: "proprio_mean", ..., also of "prev_action" and "p_obj_b"."""
        sums: dict[str, list[np.ndarray]] = {"proprio": [], "prev_action": [], "p_obj_b": []}
        for i in range(num_batches):
            rng = rng_of(self.seed, 2**31, i)
            episodes, steps = self._pick(rng, 0, self.batch_size)
            batch = self._gather(episodes, steps, rng.random(self.batch_size))
            for name, parts in sums.items():
                parts.append(batch[name].astype(np.float64))
        out = {}
        for name, parts in sums.items():
            data = np.concatenate(parts)
            out[f"{name}_mean"] = data.mean(0).astype(np.float32)
            out[f"{name}_std"] = data.std(0).astype(np.float32)
        return out

    def _pick(self, rng: np.random.Generator, group: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        if not count:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        ends = self._ends[group]
        flat = rng.integers(0, ends[-1], count)
        place = np.searchsorted(ends, flat, side="right")
        episodes = self._groups[group][place]
        return episodes, flat - (ends[place] - self._episodes[episodes, 2])

    def _gather(self, episodes: np.ndarray, steps: np.ndarray, phrasing: np.ndarray) -> dict[str, np.ndarray]:
        size = len(episodes)
        layout = self._readers[0].layout
        rows = np.empty((size, layout.row_bytes), np.uint8)
        action = np.zeros((size, self.chunk, self.schema.action.size), np.float32)
        valid = np.zeros((size, self.chunk), np.float32)
        text = np.empty((size, self.schema.text_dim), np.float32)
        # in the order of the disk, so that neighbours share a chunk's place in the cache of the system
        order = np.lexsort((self._episodes[episodes, 1] + steps, self._episodes[episodes, 0]))
        for i in order:
            shard, first, length, _ = self._episodes[episodes[i]]
            reader = self._readers[shard]
            count = min(self.chunk, int(length - steps[i]))
            window = reader.rows(int(first + steps[i]), int(first + steps[i]) + count)
            rows[i] = window[0]
            action[i, :count] = layout.unpack(window, ("action",))["action"]
            valid[i, :count] = 1.0
            sentences = self._phrasings[episodes[i]]
            text[i] = reader.embeddings[sentences[int(phrasing[i] * len(sentences))]]
        batch = layout.unpack(rows, self._names)
        batch["text"] = text
        batch["action"], batch["action_valid"] = action, valid
        batch["target_label"] = batch["depth_target"] & batch["depth_valid"]
        return batch


def _falls_in(number: int, share: float) -> bool:
    """Whether a number belongs to a share of all, spread evenly."""
    return int((number + 1) * share) > int(number * share)


def to_tensors(batch: dict[str, Any], device: str | torch.device) -> dict[str, torch.Tensor]:
    """A batch of arrays or tensors as tensors on a device."""
    return {k: torch.as_tensor(v).to(device, non_blocking=True) for k, v in batch.items()}

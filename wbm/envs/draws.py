"""Random numbers that belong to an episode, whatever environment runs it and beside whatever others."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def episode_uniforms(seed: int, episodes: np.ndarray, count: int) -> np.ndarray:
    """Uniform numbers in [0, 1) keyed by (seed, episode): [K, count], float32.

    Args:
        seed: of the run.
        episodes: episode numbers [K], not negative.
        count: numbers an episode.
    """
    rows = [np.random.Generator(np.random.Philox(key=[seed, int(e)])).random(count, dtype=np.float32) for e in episodes]
    return np.stack(rows) if rows else np.zeros((0, count), np.float32)


class Columns:
    """Hands out columns of a block of uniforms by name, so that adding a draw at the end leaves the others alone."""

    def __init__(self) -> None:
        self.names: dict[str, slice] = {}
        self.count = 0

    def add(self, name: str, width: int = 1) -> slice:
        """Reserve `width` columns.

        Raises:
            ValueError: the name is taken.
        """
        if name in self.names:
            raise ValueError(f"draw {name!r} is registered twice")
        self.names[name] = slice(self.count, self.count + width)
        self.count += width
        return self.names[name]


class Stream:
    """Endless rows of uniforms [columns.count], each keyed by (seed, its place in the stream).

    Attributes:
        drawn: rows given out so far.
    """

    def __init__(self, seed: int, columns: Columns, device: str) -> None:
        self.seed, self.columns, self.device, self.drawn = seed, columns, device, 0

    def draw(self, count: int) -> Tensor:
        """The next `count` rows."""
        rows = episode_uniforms(self.seed, np.arange(self.drawn, self.drawn + count), self.columns.count)
        self.drawn += count
        return torch.from_numpy(rows).to(self.device)

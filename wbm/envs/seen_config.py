"""Settings of observations that know of the object only what the camera has shown: values only."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SeenConfig:
    """When the target counts as seen, and what is known before it has been.

    Attributes:
        hfov_deg, vfov_deg: field of view of the camera, degrees (RealSense D435).
        min_range, max_range: depth between which the target is seen, m.
        spread: rays go to the centre of the target's bounding box and to two points on each of its axes, at this
            share of the half extents.
        rays: the target is seen when at least this many of the seven rays are free.
        hint_error: an episode starts with a hint of where the target is, off by up to this distance on the support, m.
        memory_s: the age of the last sight is told up to this time, s.
    """

    hfov_deg: float = 87.0
    vfov_deg: float = 58.0
    min_range: float = 0.2
    max_range: float = 3.0
    spread: float = 0.6
    rays: int = 2
    hint_error: float = 0.15
    memory_s: float = 2.0

    def __post_init__(self) -> None:
        if not (0 < self.hfov_deg < 180 and 0 < self.vfov_deg < 180):
            raise ValueError("env.seen: hfov_deg and vfov_deg must lie between 0 and 180")
        if not 0 <= self.min_range < self.max_range:
            raise ValueError("env.seen: need 0 <= min_range < max_range")
        if not 1 <= self.rays <= 7:
            raise ValueError(f"env.seen.rays must be 1 to 7, not {self.rays}")
        if not 0 <= self.spread <= 1 or self.hint_error < 0 or self.memory_s <= 0:
            raise ValueError("env.seen: spread must lie in [0, 1], hint_error be 0 or more, memory_s positive")

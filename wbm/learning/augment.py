"""What sensors and a segmenter do to an observation, applied to stored ones (NumPy, in place, on whole batches)."""

from __future__ import annotations

import numpy as np

from wbm.learning.student_config import AugmentConfig


def rng_of(seed: int, epoch: int, index: int) -> np.random.Generator:
    """The generator of a batch: a function of (seed, epoch, index) alone."""
    return np.random.Generator(np.random.Philox(np.random.SeedSequence((seed, epoch, index))))


def augment(batch: dict[str, np.ndarray], cfg: AugmentConfig, rng: np.random.Generator) -> None:
    """Change a batch's observation in place; labels are left alone.

    Args:
        batch: observation fields [B, ...] as `EpisodeDataset` gathers them.
        cfg: what to do.
        rng: all randomness; the same state gives the same batch.
    """
    _disturb_cloud(batch, "depth", cfg, rng)
    _disturb_cloud(batch, "lidar", cfg, rng)
    size = len(batch["depth_rgb"])
    gain = rng.uniform(1.0 - cfg.brightness, 1.0 + cfg.brightness, (size, 1, 1)).astype(np.float32)
    batch["depth_rgb"] = np.minimum(batch["depth_rgb"] * gain, 255.0).astype(np.uint8)
    _disturb_target(batch, cfg, rng)


def _disturb_cloud(batch: dict[str, np.ndarray], name: str, cfg: AugmentConfig, rng: np.random.Generator) -> None:
    xyz, valid = batch[f"{name}_xyz"], batch[f"{name}_valid"]
    noise = rng.standard_normal(xyz.shape, np.float32)
    if name == "depth":
        # stereo depth: the error grows with the square of the distance; the base's origin stands in for the camera's
        noise *= cfg.depth_noise * np.maximum(np.sum(xyz * xyz, -1, keepdims=True), 0.25)
    else:
        noise *= cfg.lidar_noise
    share = rng.uniform(0.0, cfg.point_dropout, (len(xyz), 1)).astype(np.float32)
    keep = rng.random(valid.shape, np.float32) >= share
    keep &= rng.random((len(xyz), 1)) >= cfg.cloud_dropout
    valid = (valid != 0) & keep
    batch[f"{name}_xyz"] = np.where(valid[..., None], xyz + noise, np.float32(0.0))
    batch[f"{name}_valid"] = valid.astype(np.uint8)


def _disturb_target(batch: dict[str, np.ndarray], cfg: AugmentConfig, rng: np.random.Generator) -> None:
    """The mask as an open-vocabulary segmenter gives it: absent, partly wrong, or on another thing."""
    valid = batch["depth_valid"] != 0
    target = (batch["depth_target"] != 0) & valid
    size = len(target)
    miss = rng.uniform(0.0, cfg.mask_miss, (size, 1)).astype(np.float32)
    given = target & (rng.random(target.shape, np.float32) >= miss)
    no_mask = rng.random(size) < cfg.mask_drop
    no_text = (rng.random(size) < cfg.text_drop) & ~no_mask
    swap = (rng.random(size) < cfg.mask_swap) & ~no_text
    spill = (rng.random(size) < cfg.mask_spill) | swap
    # a patch round a random valid point that is not on the target
    score = rng.random(target.shape, np.float32) + 2.0 * (valid & ~target)
    centre = batch["depth_xyz"][np.arange(size), score.argmax(1)]
    near = np.sum((batch["depth_xyz"] - centre[:, None]) ** 2, -1) < cfg.patch_radius**2
    given = np.where(swap[:, None], False, given) | (near & spill[:, None] & valid)
    batch["depth_target"] = (given & ~no_mask[:, None]).astype(np.uint8)
    batch["text"] = np.where(no_text[:, None], np.float32(0.0), batch["text"])

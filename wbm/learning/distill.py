"""Behaviour cloning of the student from whole-body episodes (paper, section D), exactly repeatable and resumable.

Every batch is a function of (seed, epoch, index) and the network holds no random state, so a run that was killed and
taken up again at its checkpoint gives the bits of an undisturbed one. The number of gradient steps is configuration:
stopping at a time would make the result depend on the machine's load.
"""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from wbm.learning.dataset import EpisodeDataset, to_tensors
from wbm.learning.distill_loss import distill_loss
from wbm.learning.student import Student, StudentPolicy
from wbm.learning.student_config import DistillConfig, StudentConfig
from wbm.robot.schema import PolicySchema

CHECKPOINT = "distill.pt"

Report = Callable[[int, int, dict[str, float]], None]
"""Called after every step with the steps done, their total, and the newest figures."""

Collect = Callable[[StudentPolicy, int], Sequence[str | Path]]
"""DAgger: makes (or finds, if they were made before an interruption) the relabelled episodes of round 1, 2, ... with
the student as it is, and returns their shards."""


@dataclass
class Distilled:
    """What a training gives.

    Attributes:
        network: with the averaged weights.
        curve: points of the learning curve: "step", training and held-out figures.
        num_windows: steps trained on.
        num_episodes: episodes trained on.
    """

    network: Student
    curve: list[dict[str, float]]
    num_windows: int
    num_episodes: int


def distill(
    paths: Sequence[str | Path],
    schema: PolicySchema,
    student_cfg: StudentConfig,
    cfg: DistillConfig,
    scratch: str | Path,
    report: Report | None = None,
    collect: Collect | None = None,
) -> Distilled:
    """Train a student; continue from the checkpoint in `scratch` if there is one.

    Args:
        paths: shard indices of the episodes.
        schema: that the episodes were written with.
        student_cfg: the network.
        cfg: the training.
        scratch: folder of the checkpoint, of this run alone.
        report: progress.
        collect: needed when `cfg.dagger_rounds` is not 0.

    Raises:
        ValueError: the data are damaged or of another schema, or rounds are asked for without `collect`.
    """
    if cfg.dagger_rounds and collect is None:
        raise ValueError("distill.dagger_rounds needs a way to collect episodes; set it to 0")
    with _threads(cfg.threads):
        # Network, its average and the optimiser
        train, val = _datasets(paths, schema, student_cfg, cfg)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(cfg.seed)
            network = Student(schema, student_cfg)
        network.set_normalizers(train.statistics())
        network.to(cfg.device).train()
        average = copy.deepcopy(network).requires_grad_(False).eval()
        optimizer = torch.optim.AdamW(network.parameters(), lr=cfg.lr, weight_decay=cfg.weight_decay)
        curve: list[dict[str, float]] = []
        step = 0

        # Continue where an interrupted run stopped
        checkpoint = Path(scratch) / CHECKPOINT
        if checkpoint.exists():
            state = torch.load(checkpoint, map_location=cfg.device, weights_only=True)
            network.load_state_dict(state["network"])
            average.load_state_dict(state["average"])
            optimizer.load_state_dict(state["optimizer"])
            curve, step = state["curve"], state["step"]

        # Phase 0 clones; each further phase adds a round of on-policy episodes
        ends = [cfg.iterations + cfg.dagger_iterations * r for r in range(cfg.dagger_rounds + 1)]
        grown = list(paths)
        for phase, end in enumerate(ends):
            if phase and collect is not None:
                grown += collect(StudentPolicy(copy.deepcopy(average), cfg.device), phase)
                train, val = _datasets(grown, schema, student_cfg, cfg)
            for batch in train.batches(step, end, cfg.workers):
                batch = to_tensors(batch, cfg.device)
                for group in optimizer.param_groups:
                    group["lr"] = learning_rate(step, cfg)
                loss, figures = distill_loss(network(batch), batch, cfg)
                optimizer.zero_grad(set_to_none=True)
                loss.backward()
                torch.nn.utils.clip_grad_norm_(network.parameters(), cfg.clip)
                optimizer.step()
                _follow(average, network, min(cfg.ema, (1 + step) / (10 + step)))
                step += 1

                if step % cfg.val_every == 0 or step == ends[-1]:
                    point = {"step": float(step), **{f"train_{k}": float(v) for k, v in figures.items()}}
                    if val is not None:
                        point |= validate(average, val, cfg)
                    curve.append(point)
                if step % cfg.checkpoint_every == 0 or step == end:
                    _save_checkpoint(checkpoint, network, average, optimizer, curve, step)
                if report is not None:
                    report(step, ends[-1], {"loss": float(figures["loss"]), "p_obj_m": float(figures["p_obj_m"])})
    return Distilled(average, curve, train.num_windows, train.num_episodes)


def learning_rate(step: int, cfg: DistillConfig) -> float:
    """Linear warm-up, then a cosine down to `lr_final`; each round of DAgger restarts the cosine at `dagger_lr`."""
    if step < cfg.warmup:
        return cfg.lr * (step + 1) / cfg.warmup
    if step < cfg.iterations:
        top, done = cfg.lr, (step - cfg.warmup) / max(cfg.iterations - cfg.warmup, 1)
    else:
        top, done = cfg.lr * cfg.dagger_lr, ((step - cfg.iterations) % cfg.dagger_iterations) / cfg.dagger_iterations
    low = cfg.lr * min(cfg.lr_final, top / cfg.lr)
    return low + (top - low) * 0.5 * (1.0 + math.cos(math.pi * done))


@torch.no_grad()
def validate(network: Student, data: EpisodeDataset, cfg: DistillConfig) -> dict[str, float]:
    """Losses on held-out episodes given mask and instruction ("val_both_loss", ...), the mask alone, the text alone."""
    sums: dict[str, float] = {}
    for batch in data.batches(0, cfg.val_batches):
        both = to_tensors(batch, cfg.device)
        views = {
            "both": both,
            "mask": {**both, "text": torch.zeros_like(both["text"])},
            "text": {**both, "depth_target": torch.zeros_like(both["depth_target"])},
        }
        for view, inputs in views.items():
            _, figures = distill_loss(network(inputs), inputs, cfg)
            for name, value in figures.items():
                key = f"val_{view}_{name}"
                sums[key] = sums.get(key, 0.0) + float(value) / cfg.val_batches
    return sums


def _datasets(
    paths: Sequence[str | Path], schema: PolicySchema, student_cfg: StudentConfig, cfg: DistillConfig
) -> tuple[EpisodeDataset, EpisodeDataset | None]:
    common: dict[str, Any] = {
        "batch_size": cfg.batch_size,
        "chunk": student_cfg.chunk,
        "pregrasp_share": cfg.pregrasp_share,
        "val_share": cfg.val_share,
    }
    train = EpisodeDataset(paths, schema, seed=cfg.seed, augmentation=cfg.augment, **common)
    if not train.num_left_out:
        return train, None
    return train, EpisodeDataset(paths, schema, seed=cfg.seed + 1, held_out=True, **common)


@torch.no_grad()
def _follow(average: Student, network: Student, decay: float) -> None:
    """average <- decay * average + (1 - decay) * network."""
    torch._foreach_lerp_(list(average.parameters()), list(network.parameters()), 1.0 - decay)


def _save_checkpoint(
    path: Path,
    network: Student,
    average: Student,
    optimizer: torch.optim.Optimizer,
    curve: list[dict[str, float]],
    step: int,
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    state = {
        "network": network.state_dict(),
        "average": average.state_dict(),
        "optimizer": optimizer.state_dict(),
        "curve": curve,
        "step": step,
    }
    with open(partial, "wb") as stream:
        torch.save(state, stream)
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(partial, path)


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """A fixed number of threads: it decides the order of sums and so the bits."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)

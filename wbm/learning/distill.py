"""Behaviour cloning of the student from whole-body episodes (paper, section D), exactly repeatable and resumable.

Every batch is a function of (seed, epoch, index) and the network holds no random state, so a run that was killed and
taken up again at its checkpoint gives the bits of an undisturbed one. The number of gradient steps is configuration:
stopping at a time would make the result depend on the machine's load.
"""

from __future__ import annotations

import copy
import json
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
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

        # Continue where an interrupted run stopped
        run = _Run(network, average, optimizer, Path(scratch) / CHECKPOINT, _fingerprint(student_cfg, cfg))
        run.load(cfg.device)

        # Phase 0 clones; each further phase adds a round of on-policy episodes
        ends = [cfg.iterations + cfg.dagger_iterations * r for r in range(cfg.dagger_rounds + 1)]
        grown = list(paths)
        try:
            for phase, end in enumerate(ends):
                if phase and collect is not None:
                    grown += collect(StudentPolicy(copy.deepcopy(average), cfg.device), phase)
                    train, val = _datasets(grown, schema, student_cfg, cfg)
                for batch in train.batches(run.step, end, cfg.workers):
                    figures = run.advance(to_tensors(batch, cfg.device), cfg)
                    if run.step % cfg.val_every == 0 or run.step == ends[-1]:
                        point = {"step": float(run.step), **{f"train_{k}": float(v) for k, v in figures.items()}}
                        run.curve.append(point | (validate(average, val, cfg) if val is not None else {}))
                    run.settled = True
                    if run.step % cfg.checkpoint_every == 0 or run.step == end:
                        run.save()
                    if report is not None:
                        report(run.step, ends[-1], {k: float(figures[k]) for k in ("loss", "p_obj_m")})
        except BaseException:
            if run.settled:
                run.save()  # asked to stop: lose nothing
            raise
    return Distilled(average, run.curve, train.num_windows, train.num_episodes)


@dataclass
class _Run:
    """All that changes while training."""

    network: Student
    average: Student
    optimizer: torch.optim.Optimizer
    path: Path
    fingerprint: str
    curve: list[dict[str, float]] = field(default_factory=list)
    step: int = 0
    settled: bool = False  # whether everything belongs to the same step

    def advance(self, batch: dict[str, torch.Tensor], cfg: DistillConfig) -> dict[str, torch.Tensor]:
        """One gradient step; the loss's figures."""
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(self.step, cfg)
        loss, figures = distill_loss(self.network(batch), batch, cfg)
        self.settled = False
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), cfg.clip)
        self.optimizer.step()
        with torch.no_grad():
            decay = min(cfg.ema, (1 + self.step) / (10 + self.step))  # follows closely at first
            torch._foreach_lerp_(list(self.average.parameters()), list(self.network.parameters()), 1.0 - decay)  # pyright: ignore[reportPrivateImportUsage]
        self.step += 1
        return figures

    def save(self) -> None:
        """Replace the checkpoint in one piece."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        partial = self.path.with_suffix(".partial")
        state = {
            "fingerprint": self.fingerprint,
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "curve": self.curve,
            "step": self.step,
        }
        with open(partial, "wb") as stream:
            torch.save(state, stream)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(partial, self.path)

    def load(self, device: str) -> None:
        """Take up the checkpoint, if there is one.

        Raises:
            ValueError: it belongs to another configuration.
        """
        if not self.path.exists():
            return
        state = torch.load(self.path, map_location=device, weights_only=True)
        if state["fingerprint"] != self.fingerprint:
            raise ValueError(
                f"{self.path} belongs to another student or distill configuration; remove it to start anew"
            )
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.curve, self.step = state["curve"], state["step"]


def _fingerprint(student_cfg: StudentConfig, cfg: DistillConfig) -> str:
    settings = asdict(cfg)
    del settings["workers"]
    return json.dumps([asdict(student_cfg), settings], sort_keys=True)


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
        "data_share": cfg.data_share,
        "max_noise": cfg.max_noise,
    }
    changes = cfg.augment
    if not student_cfg.use_text:  # the mask is all that tells the target
        changes = replace(changes, mask_drop=0.0, mask_swap=0.0, text_drop=0.0)
    if not student_cfg.use_mask:
        changes = replace(changes, text_drop=0.0)
    train = EpisodeDataset(paths, schema, seed=cfg.seed, augmentation=changes, **common)
    if not train.num_left_out:
        return train, None
    return train, EpisodeDataset(paths, schema, seed=cfg.seed + 1, held_out=True, **common)


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """A fixed number of threads: it decides the order of sums and so the bits."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)

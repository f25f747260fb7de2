"""What the data and the student cost: `wbm bench data` and `wbm bench student`.

Times are processor time of the process, so that other work on the machine does not enter.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch

from wbm.artifacts.episodes import EpisodeWriter
from wbm.learning.dataset import EpisodeDataset, to_tensors
from wbm.learning.distill_loss import distill_loss
from wbm.learning.export import check_parity, export_onnx, make_session, random_observation
from wbm.learning.student import Student, StudentPolicy, count_parameters
from wbm.learning.student_config import DistillConfig, StudentConfig
from wbm.robot.schema import PolicySchema

_EPISODE_STEPS = 70


def bench_data(
    episodes: int = 100, batches: int = 30, student: StudentConfig | None = None, cfg: DistillConfig | None = None
) -> dict[str, float]:
    """Windows a second that the dataset delivers, beside what training consumes, and memory over the amount of data.

    Args:
        episodes: written for the "1x" data; "4x" has four times as many.
        batches: read for each figure.
        student: that consumes.
        cfg: batch size and augmentation.

    Returns:
        "windows_per_s" on one core with augmentation, "consumption_per_s" (training samples a second on one core),
        "ratio_vs_consumption", "bytes_per_sample" on disk, "peak_mb_1x" and "peak_mb_4x" (resident memory added by
        reading, measured in a process of its own), "data_mb_1x".
    """
    cfg = cfg or DistillConfig()
    schema = PolicySchema()
    consumption = _training_rate(student or StudentConfig(), cfg, schema, steps=4)
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        paths = [_write_synthetic(Path(folder), schema, k, episodes) for k in range(4)]
        size = sum(p.stat().st_size for p in paths[0].with_suffix(".zarr").rglob("*") if p.is_file())
        answers = []
        for chosen in (paths[:1], paths):
            with ProcessPoolExecutor(1, mp_context=context) as pool:  # raises where a Pool would wait for ever
                answers.append(pool.submit(_read_batches, chosen, cfg, batches).result())
    (rate, peak_1), (_, peak_4) = answers
    return {
        "windows_per_s": rate,
        "consumption_per_s": consumption,
        "ratio_vs_consumption": rate / consumption,
        "bytes_per_sample": size / (episodes * _EPISODE_STEPS),
        "data_mb_1x": size / 1e6,
        "peak_mb_1x": peak_1,
        "peak_mb_4x": peak_4,
    }


def bench_student(
    student: StudentConfig | None = None, cfg: DistillConfig | None = None, steps: int = 300
) -> dict[str, Any]:
    """Cost of a step at batch 1 on one core, and of training.

    Args:
        student: sizes.
        cfg: batch size.
        steps: measured policy steps.

    Returns:
        "torch" and "onnx", each with "p50_ms" and "p99_ms" of a policy step; "p50_ms" and "p99_ms" of ONNX Runtime,
        which the robot runs; "train_samples_per_s" on one core; "parameters"; "parity", the largest
        difference between both.
    """
    schema = PolicySchema()
    student = student or StudentConfig()
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        policy = _fresh_policy(student, schema)
        obs = random_observation(schema, 2, seed=0)
        obs = {k: v[:1] for k, v in obs.items()}
        model = export_onnx(policy)
        session = make_session(model)
        slow = _percentiles(lambda: policy.act(obs), steps)
        fast = _percentiles(lambda: session.run(["action"], obs), steps)
    finally:
        torch.set_num_threads(before)
    return {
        **fast,
        "torch": slow,
        "onnx": fast,
        "train_samples_per_s": _training_rate(student, cfg or DistillConfig(), schema, steps=4),
        "parameters": count_parameters(policy.network),
        "parity": check_parity(policy, model),
    }


def _fresh_policy(student: StudentConfig, schema: PolicySchema) -> StudentPolicy:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return StudentPolicy(Student(schema, student))


def _percentiles(call: Any, steps: int) -> dict[str, float]:
    for _ in range(20):
        call()
    times = np.empty(steps)
    for i in range(steps):
        start = time.process_time_ns()
        call()
        times[i] = 1e-6 * (time.process_time_ns() - start)
    return {"p50_ms": float(np.percentile(times, 50)), "p99_ms": float(np.percentile(times, 99))}


def _training_rate(student: StudentConfig, cfg: DistillConfig, schema: PolicySchema, steps: int) -> float:
    """Training samples a second on one core; the fastest of `steps`."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        network = _fresh_policy(student, schema).network.train()
        size = cfg.batch_size
        rng = np.random.default_rng(0)
        arrays = random_observation(schema, size, seed=0) | {
            "action": rng.standard_normal((size, student.chunk, schema.action.size)).astype(np.float32),
            "action_valid": np.ones((size, student.chunk), np.float32),
            "p_obj_b": rng.standard_normal((size, 3)).astype(np.float32),
            "ee_distance": rng.random(size, np.float32),
        }
        batch = to_tensors(arrays, "cpu")
        batch["target_label"] = batch["depth_target"]
        optimizer = torch.optim.AdamW(network.parameters(), lr=cfg.lr)
        times = []
        for _ in range(steps + 1):
            start = time.process_time()
            loss, _ = distill_loss(network(batch), batch, cfg)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), cfg.clip)
            optimizer.step()
            times.append(time.process_time() - start)
        return size / min(times[1:])
    finally:
        torch.set_num_threads(before)


def _write_synthetic(folder: Path, schema: PolicySchema, shard: int, episodes: int) -> Path:
    """Episodes whose bytes compress about as those of rollouts do: noisy clouds, few colours, smooth states."""
    writer = EpisodeWriter(folder, schema, shard)
    rng = np.random.default_rng(shard)
    t, p, m = _EPISODE_STEPS, schema.num_depth_points, schema.num_lidar_points
    palette = rng.integers(0, 256, (8, 3))
    text = rng.standard_normal((4, schema.text_dim)).astype(np.float32)
    for k in range(episodes):
        walk = lambda *shape: np.cumsum(0.02 * rng.standard_normal((t, *shape), np.float32), axis=0)
        action = walk(schema.action.size)
        writer.add(
            {
                "depth_xyz": rng.random((t, p, 3), np.float32),
                "depth_rgb": palette[rng.integers(0, 8, (t, p))].astype(np.uint8),
                "depth_valid": rng.random((t, p)) > 0.1,
                "depth_target": rng.random((t, p)) > 0.8,
                "lidar_xyz": 4.0 * rng.random((t, m, 3), np.float32),
                "lidar_valid": rng.random((t, m)) > 0.1,
                "proprio": walk(*schema.field_named("proprio").shape),
                "prev_action": np.roll(action, 1, axis=0),
                "action": action,
                "executed": action + walk(schema.action.size),
                "p_obj_b": walk(3),
                "p_obj_w": np.ones((t, 3)),
                "base_pose": walk(3),
                "ee_distance": np.linspace(0.6, 0.0, t),
                "stamp": np.arange(t) / schema.rate_hz,
                "phase": np.zeros(t, np.uint8),
                "instructions": [f"sentence {i}" for i in range(4)],
                "text": text,
                "scene": f"scene-{k % 16}",
                "object": f"object-{k % 32}",
                "teacher": "top_down",
                "noise": 0.5 * (k % 4),
                "start": "pregrasp" if k % 4 == 0 else "full",
                "success": True,
                "seed": k,
            }
        )
    return writer.close()


def _read_batches(paths: list[Path], cfg: DistillConfig, batches: int) -> tuple[float, float]:
    """Windows a second, and megabytes of resident memory at most above what the process held before."""
    torch.set_num_threads(1)
    base = _resident_mb()
    data = EpisodeDataset(
        paths, PolicySchema(), batch_size=cfg.batch_size, pregrasp_share=cfg.pregrasp_share, augmentation=cfg.augment
    )
    peak = 0.0
    start = time.process_time()
    for batch in data.batches(0, batches):
        peak = max(peak, _resident_mb() - base)
        del batch
    return batches * cfg.batch_size / (time.process_time() - start), peak


def _resident_mb() -> float:
    with open("/proc/self/statm", encoding="ascii") as stream:
        return int(stream.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

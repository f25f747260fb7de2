"""Stage evaluate: closed-loop success on held-out objects and scenes, with intervals, reasons, films and a page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

KIND = "evaluation"
SECTIONS = ("seed", "robot", "sim", "wbc", "sensors", "env", "evaluation")
INPUTS = ("assets", "policy:student")
BLOCK = 32


def name(cfg: Any) -> str:
    """Named after where episodes start and what the policy is told of its target."""
    e = cfg.evaluation
    return "main" if (e.start, e.condition) == ("whole_body", "both") else f"{e.start}_{e.condition}"


def run(cfg: Any, inputs: dict[str, Any], draft: Any, progress: Any) -> None:
    """Play the episodes in blocks, then write numbers, films, recorded episodes and `report.html`.

    Args:
        cfg: reads the sections named in `SECTIONS`.
        inputs: `assets` and `policy`: a student, a teacher or a bundle.
        draft: the artifact being written.
        progress: offers `task` and `track`.
    """
    from wbm.report.page import write_page
    from wbm.report.stats import summarise

    policy = inputs["policy"].manifest
    _check_kind(policy)
    records = _play(cfg, inputs, draft, progress)
    _film(cfg, inputs, draft, progress, records)
    summary = summarise(records)
    if policy.kind == "bundle":
        summary["refusals"] = _refusals(records)
    plain = [{k: v for k, v in r.items() if k not in ("video", "filmstrip")} for r in records]
    _write(draft.path / "summary.json", summary)
    _write(draft.path / "records.json", plain)
    result = {
        **summary,
        "records": records,
        "config": {"evaluation": _plain(cfg.evaluation), "seed": cfg.seed},
        "provenance": {"policy": policy.ref, "assets": inputs["assets"].manifest.ref, "code": policy.code_digest[:12]},
    }
    if (curve := inputs["policy"].path / "curve.json").is_file():
        result["curves"] = _curves(json.loads(curve.read_text()), policy.kind)
    write_page(draft.path / "report.html", result, embed_mb=cfg.evaluation.embed_mb)
    draft.metrics |= summary


def uses_gpu(cfg: Any) -> bool:
    """The physics engine decides."""
    return cfg.sim.engine == "mujoco_warp"


def _check_kind(policy: Any) -> None:
    from wbm.learning.evaluation import POLICY_KINDS

    if policy.kind not in POLICY_KINDS:
        raise ValueError(f"policy={policy.ref} holds no policy; name a {', '.join(POLICY_KINDS[:-1])} or bundle")


def _refusals(records: list[dict[str, Any]]) -> dict[str, int]:
    """What a bundle's runtime refused over all episodes, by name."""
    from collections import Counter

    return dict(sorted(sum((Counter(r["refusals"]) for r in records), Counter()).items()))


def _play(cfg: Any, inputs: dict[str, Any], draft: Any, progress: Any) -> list[dict[str, Any]]:
    """Play what is missing; a finished block is a file in the scratch folder, from which an interrupted run goes on."""
    import shutil

    from wbm.artifacts.files import fsync_tree, write_atomic
    from wbm.envs.world import WorldConfig
    from wbm.learning.evaluation import BlockJob
    from wbm.learning.workers import run_jobs
    from wbm.sim.simulation import default_device

    e, policy = cfg.evaluation, inputs["policy"]
    world = WorldConfig(cfg.robot, cfg.sim, cfg.wbc, cfg.env)
    split = e.split
    if split == "test" and _strange(inputs["assets"].manifest, policy.manifest, draft.store):
        split = "all"
        progress.message("nobody trained on these objects: evaluating on all of them")
    blocks = draft.scratch / "blocks"
    blocks.mkdir(parents=True, exist_ok=True)
    jobs = [
        BlockJob(
            first, min(BLOCK, e.episodes - first), blocks, inputs["assets"].path, policy.path,
            policy.manifest.kind, world,
            cfg.sensors, split, e.start, e.condition, min(e.num_envs, e.episodes), e.record_episodes,
            cfg.seed + e.seed, default_device(cfg.sim),
        )
        for first in range(0, e.episodes, BLOCK)
    ]  # fmt: skip
    waiting = [job for job in jobs if not _block(blocks, job.first).is_file()]
    if any(job.first < e.record_episodes for job in waiting):
        shutil.rmtree(blocks / "episodes", ignore_errors=True)  # of a block that did not finish
    with progress.task("episodes", total=e.episodes) as task:
        task.update(e.episodes - sum(job.count for job in waiting))
        for result in run_jobs("wbm.learning.evaluation", waiting, e.workers):
            fsync_tree(blocks)  # its trajectories and episodes, before the file that says that they are there
            write_atomic(_block(blocks, result.first), _json(result.records))
            won = sum(r["success"] for r in result.records)
            task.update(len(result.records), success=won / len(result.records))
            progress.safe_point()
    return [r for job in jobs for r in json.loads(_block(blocks, job.first).read_text())]


def _strange(assets: Any, policy: Any, store: Any) -> bool:
    """Whether the assets hold imported objects and the policy was trained on other assets."""
    from wbm.artifacts.errors import ArtifactError

    if assets.config.get("objects", {}).get("source") not in ("meshes", "pybullet"):
        return False
    waiting, known = list(policy.inputs.values()), False
    while waiting:
        ref = waiting.pop()
        if ref.ref.startswith("assets/"):
            if ref.content_digest == assets.content_digest:
                return False
            known = True
            continue
        try:
            waiting += store.manifest(ref.ref).inputs.values()
        except ArtifactError:
            return False  # what it was trained on is no longer known
    return known


def _film(cfg: Any, inputs: dict[str, Any], draft: Any, progress: Any, records: list[dict[str, Any]]) -> None:
    """Film chosen episodes, draw strips of successes, and publish the recorded episodes, as Zarr and as MCAP."""
    import shutil

    import numpy as np

    from wbm.artifacts.episode_reader import EpisodeReader, shard_paths
    from wbm.report.films import FilmStudio, Trajectory, choose_films, choose_strips
    from wbm.report.tracks import scene_solids, write_episode_mcap
    from wbm.robot.schema import PolicySchema
    from wbm.scenes.assets import load_assets

    e, blocks = cfg.evaluation, draft.scratch / "blocks"
    assets, period = load_assets(inputs["assets"].path), 1.0 / PolicySchema().rate_hz
    chosen = choose_films(records, e.videos)
    strips = choose_strips(records, e.filmstrips)
    if chosen or strips:
        studio = FilmStudio(assets, (e.video_width, e.video_height))
        folder = draft.path / "videos"
        folder.mkdir(exist_ok=True)
        for i in progress.track(sorted({*chosen, *strips}), "films"):
            record = records[i]
            number, row = record["episode"], record["scene_row"]
            with np.load(blocks / f"block-{number // BLOCK * BLOCK:05d}.npz") as data:
                names = ("q", "pose", "phase", "held")
                trajectory = Trajectory(*(data[f"{name}_{number}"] for name in names))
            stem = folder / f"episode-{number:04d}"
            if i in chosen:
                studio.film(row, trajectory, stem.with_suffix(".mp4"), period, e.video_fps)
                record["video"] = f"videos/{stem.name}.mp4"
            if i in strips:
                record["filmstrip"] = studio.strip(row, trajectory, stem, period)
    if (blocks / "episodes").is_dir():
        shutil.copytree(blocks / "episodes", draft.path / "episodes", dirs_exist_ok=True)
        for path in shard_paths(draft.path / "episodes"):
            schema = PolicySchema.from_dict(EpisodeReader(path).schema)
            reader = EpisodeReader(path, schema)
            for i, info in enumerate(reader.episodes):
                target = draft.path / "mcap" / f"episode-{info.seed:04d}.mcap"
                target.parent.mkdir(exist_ok=True)
                episode = reader.read_episode(i)
                solids = scene_solids(assets, int(info.scene), np.asarray(episode["p_obj_w"], dtype=np.float64))
                write_episode_mcap(target, episode, schema, solids)


def _curves(curve: Any, kind: str) -> dict[str, Any]:
    """The policy's learning curve as the page draws it: one panel a quantity."""
    rows = curve if isinstance(curve, list) else curve.get("rows", [])
    steps_of = lambda row: row.get("step", row.get("iteration", row.get("env_steps", 0)))
    panels = {}
    for key in ("train_loss", "reward", "success", "evaluation"):
        kept = [(steps_of(r), r[key]) for r in rows if isinstance(r, dict) and r.get(key) is not None]
        if len(kept) > 1:
            steps, values = zip(*kept, strict=True)
            panels[f"{kind} {key}"] = {kind: {"steps": list(steps), "values": [list(values)]}}
    return panels


def _block(folder: Path, first: int) -> Path:
    return folder / f"block-{first:05d}.json"


def _plain(settings: Any) -> dict[str, Any]:
    """Settings that a result depends on; the number of processes is none."""
    from wbm.artifacts.digest import plain

    return plain(settings, key_only=True)


def _write(path: Path, value: Any) -> None:
    path.write_bytes(_json(value))


def _json(value: Any) -> bytes:
    return (json.dumps(value, indent=1, sort_keys=True) + "\n").encode()

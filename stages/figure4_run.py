"""Stage figure4-run: one arm of the ablation with one seed, trained on the whole-body episode and evaluated."""

from __future__ import annotations

import json
from typing import Any

KIND = "teacher"
SECTIONS = ("seed", "robot", "sim", "wbc", "env", "ppo", "figure4")
INPUTS = ("assets",)


def name(cfg: Any) -> str:
    """Named after arm and seed."""
    return f"figure4_{cfg.figure4.arm}_{cfg.figure4.seed}"


def run(cfg: Any, inputs: dict[str, Any], draft: Any, progress: Any) -> None:
    """Write the policy, its curve and the records of its evaluation.

    Args:
        cfg: reads the sections in `SECTIONS`; `env` makes the arm.
        inputs: `assets`.
        draft: the artifact being written; its scratch holds the checkpoint and `progress.json`.
        progress: offers `task` and `message`.
    """
    import torch

    from wbm.envs.world import WorldConfig
    from wbm.learning.figure4 import run_settings, run_world, train_run
    from wbm.report.stats import summarise
    from wbm.scenes.assets import load_assets

    f = cfg.figure4
    device = "cuda" if cfg.sim.engine == "mujoco_warp" and torch.cuda.is_available() else "cpu"
    torch.set_num_threads(max(1, cfg.sim.threads))
    assets = load_assets(inputs["assets"].path)
    world = run_world(WorldConfig(cfg.robot, cfg.sim, cfg.wbc, cfg.env), f)
    seed, iterations = cfg.seed + f.seed, run_settings(f, cfg.ppo).iterations
    every = max(1, iterations // 20)
    with progress.task(f"{f.arm}, seed {seed}", total=iterations) as task:
        shown = 0

        def report(p: Any) -> None:
            nonlocal shown
            task.update(p.iteration - shown, reward=p.reward, success=p.success)
            shown = p.iteration
            state = {"iteration": p.iteration, "iterations": p.iterations, "success": p.success}
            (draft.scratch / "progress.json").write_text(json.dumps(state))
            if p.iteration % every == 0:
                progress.message(
                    f"  {f.arm} {f.seed}, iteration {p.iteration}/{p.iterations}: reward {p.reward:.4f}, success "
                    f"{p.success:.2f}, {p.steps_per_s:.0f} steps/s, {p.time_left_s / 60:.0f} min left"
                )

        records, trained = train_run(assets, world, f, cfg.ppo, draft.path, draft.scratch, seed, report, device)
    draft.seeds["figure4"] = seed
    draft.metrics |= summarise(records) | {k: trained[k] for k in ("env_steps", "iterations", "train_seconds")}

"""Stage train-teacher: one local grasping policy, learned with PPO on top of the whole-body controller."""

from __future__ import annotations

from typing import Any

KIND = "teacher"
SECTIONS = ("seed", "robot", "sim", "wbc", "env", "teacher", "ppo")
INPUTS = ("assets",)
EACH = ("teacher", "teachers")
RANKED = True


def name(cfg: Any) -> str:
    """Artifacts are named after the teacher."""
    return cfg.teacher.name


def uses_gpu(cfg: Any) -> bool:
    """The physics engine decides."""
    return cfg.sim.engine == "mujoco_warp"


def run(cfg: Any, inputs: dict[str, Any], draft: Any, progress: Any) -> None:
    """Write the policy (`policy.safetensors`, `policy.json`), its curve and its TensorBoard log.

    Args:
        cfg: reads the sections in `SECTIONS`.
        inputs: `assets`.
        draft: the artifact being written; its scratch holds the checkpoint from which an interrupted run goes on.
        progress: offers `task` and `message`.
    """
    from dataclasses import replace

    import torch

    from wbm.envs.world import WorldConfig, make_env, scene_rows, with_start
    from wbm.learning.teacher import Progress, train_teacher
    from wbm.learning.team import Team
    from wbm.scenes.assets import load_assets
    from wbm.sim.config import evaluation_physics
    from wbm.sim.simulation import default_device

    teacher, device = cfg.teacher, default_device(cfg.sim)
    torch.set_num_threads(max(1, cfg.sim.threads))
    assets = load_assets(inputs["assets"].path)
    world = with_start(WorldConfig(cfg.robot, cfg.sim, cfg.wbc, cfg.env), "local")
    judge = replace(world, sim=evaluation_physics(cfg.sim))

    rows = scene_rows(assets.scenes, teacher.split, teacher.supports, (teacher.grasp,))
    try:
        held_out = scene_rows(assets.scenes, teacher.eval_split, teacher.supports, (teacher.grasp,))
    except ValueError:
        progress.message(f"no {teacher.eval_split} scene for {teacher.name}: evaluating on {teacher.split} scenes")
        held_out = rows
    progress.message(f"{teacher.name}: {len(rows)} scenes to learn on, {len(held_out)} to evaluate on")
    team = Team.join(device)
    env = make_env(assets, world, rows, team.share(teacher.num_envs), cfg.seed, device)
    eval_env = make_env(assets, judge, held_out, teacher.eval_envs, cfg.seed + 1, device)

    with progress.task(f"teacher {teacher.name}", total=teacher.iterations) as task:
        shown = 0

        def report(p: Progress) -> None:
            nonlocal shown
            if shown == 0 and p.iteration > 1:
                progress.message(f"  going on after iteration {p.iteration - 1}")
            task.update(p.iteration - shown, reward=p.reward, success=p.success, evaluation=p.evaluation)
            shown = p.iteration
            if p.iteration % teacher.eval_every == 0:
                progress.message(
                    f"  iteration {p.iteration}/{p.iterations}: success {p.success:.2f}, "
                    f"deterministic {p.evaluation:.2f}, "
                    f"{p.steps_per_s:.0f} steps/s, {p.time_left_s / 60:.0f} min left"
                )
            if p.stopping:
                progress.stop()

        metrics = train_teacher(
            env, eval_env, teacher, cfg.ppo, draft.path, draft.scratch, cfg.seed, report, team, progress.stopping
        )
    team.leave()
    draft.seeds["teacher"] = cfg.seed
    draft.metrics |= metrics

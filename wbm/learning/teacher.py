"""Trains a teacher with PPO (rsl_rl) on a grasping environment."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from wbm.envs import rewards
from wbm.envs.grasp_env import GraspEnv
from wbm.envs.outcome import REASONS, RUNNING
from wbm.learning.config import PpoConfig, TeacherConfig
from wbm.learning.curriculum import Curriculum
from wbm.learning.curve import save_curve
from wbm.learning.teacher_checkpoint import load_checkpoint, save_checkpoint
from wbm.learning.teacher_evaluation import evaluate_teacher
from wbm.learning.teacher_policy import TeacherSpec, load_teacher, save_teacher
from wbm.learning.team import Team
from wbm.learning.team_ppo import TeamGaussian, TeamPPO


@dataclass
class Progress:
    """What a training reports after an iteration.

    Attributes:
        iteration, iterations: how far it is.
        reward: mean reward a step.
        success: share of the iteration's finished episodes that succeeded, NaN where none finished.
        evaluation: success of the last deterministic evaluation, NaN before the first.
        steps_per_s: environment steps a second.
        time_left_s: at this pace, to the last iteration.
        stopping: it was asked to stop; everything is in the checkpoint.
    """

    iteration: int
    iterations: int
    reward: float
    success: float
    evaluation: float
    steps_per_s: float
    time_left_s: float
    stopping: bool = False


def train_teacher(
    env: GraspEnv,
    eval_env: GraspEnv,
    cfg: TeacherConfig,
    ppo: PpoConfig,
    directory: Path,
    scratch: Path,
    seed: int = 0,
    report: Callable[[Progress], None] | None = None,
    team: Team | None = None,
    stopping: Callable[[], bool] = lambda: False,
) -> dict[str, float]:
    """Train to the last iteration, a plateau or the target, and keep the best policy under `directory`.

    Call it again with the same arguments after an interruption: it continues from the last checkpoint and ends with the
    weights of an undisturbed run (same threads, same machine type).

    Args:
        env: training environments.
        eval_env: environments of the periodic deterministic evaluation.
        directory: receives `policy.safetensors`, `policy.json`, `curve.json`, `curve.png` and TensorBoard's `logs`.
        scratch: holds the checkpoint and the newest policy.
        seed: of network and exploration; the environments have their own.
        report: called after each iteration.
        team: the processes that train together, each with its share of the environments; None is this one alone.
            All but the leader give a `directory` of their own, which is of no further use.
        stopping: whether to write a checkpoint after this iteration in any case, and tell `report`.

    Returns:
        `success` of the best evaluation, `iterations` and `env_steps` trained, `train_seconds` of this call.

    Raises:
        FloatingPointError: a reward, an observation or a weight became NaN; the state is dumped to `nan_dump.npz`.
    """
    from torch.utils.tensorboard import SummaryWriter

    for folder in (directory, scratch):
        folder.mkdir(parents=True, exist_ok=True)
    team = team or Team()
    num_envs = env.num_envs * team.size
    torch.manual_seed(seed)
    env.claim = team.numbers
    env.reset()
    alg = make_ppo(env, ppo, team)
    spec = teacher_spec(env, cfg, ppo)
    curriculum = Curriculum(env, cfg.curriculum)
    curve: dict[str, list[float]] = {}
    start, best, stale = load_checkpoint(scratch / "checkpoint.pt", alg, env, curriculum, curve, team)
    obs = env.obs
    writer = SummaryWriter(str(directory / "logs"), purge_step=start)
    began = time.monotonic()
    evaluation = curve["evaluation"][-1] if curve.get("evaluation") else float("nan")

    for iteration in range(start, cfg.iterations):
        if best >= cfg.target or (cfg.patience and stale >= cfg.patience):
            break
        remaining = 1 - iteration / cfg.iterations
        alg.entropy_coef = ppo.entropy * remaining
        if ppo.schedule == "linear":
            _set_learning_rate(alg, ppo.lr * (ppo.lr_final + (1 - ppo.lr_final) * remaining))

        # Collect
        rewards_sum, terms, outcomes = 0.0, torch.zeros(len(rewards.TERMS)), torch.zeros(len(REASONS))
        with torch.no_grad():
            for _ in range(ppo.steps):
                action = alg.act(as_observation(obs))
                obs, reward, done, info = env.step(action)
                _watch(env, iteration, scratch, reward=reward, obs=obs)
                alg.process_env_step(as_observation(obs), reward, done, {"time_outs": info["time_outs"]})
                rewards_sum += reward.mean().item()
                terms += info["terms"].mean(0).cpu()
                outcomes += torch.bincount(info["outcome"].long(), minlength=len(REASONS)).cpu()
                curriculum.count(info["scene"][done], info["outcome"][done])
            curriculum.update(team.sum)
            alg.compute_returns(as_observation(obs))

        # Learn
        losses = alg.update()
        _watch(env, iteration, scratch, weights=torch.cat([p.flatten() for p in alg.actor.parameters()]))

        # Log
        figures = team.sum(torch.cat([torch.tensor([rewards_sum]), terms, outcomes]))
        rewards_sum, terms = float(figures[0]) / team.size, figures[1 : 1 + len(terms)] / team.size
        outcomes = figures[-len(outcomes) :]
        finished = float(outcomes[RUNNING + 1 :].sum())
        row = {
            "reward": rewards_sum / ppo.steps,
            "success": float(outcomes[1]) / finished if finished else float("nan"),
        }
        row |= {f"term/{name}": float(value) / ppo.steps for name, value in zip(rewards.TERMS, terms, strict=True)}
        row |= {f"outcome/{name}": float(k) for name, k in zip(REASONS[1:], outcomes[1:], strict=True)}
        row |= {f"loss/{name}": value for name, value in losses.items()}
        row |= {"lr": alg.learning_rate, "std": float(alg.actor.output_std.detach().mean())}

        # Evaluate, keep the best
        last = iteration + 1 == cfg.iterations
        due = (iteration + 1) % cfg.eval_every == 0 or last
        if due and team.leads:
            save_teacher(scratch / "latest", spec, alg.actor.state_dict())
            result = evaluate_teacher(eval_env, load_teacher(scratch / "latest", env.device), cfg.eval_episodes)
            evaluation = result["success"]
            row |= {f"eval/{name}": value for name, value in result.items()}
            stale = 0 if evaluation > best else stale + 1
            if evaluation > best:
                best = evaluation
                save_teacher(directory, spec, alg.actor.state_dict())
        if due:
            evaluation, best, stale = team.tell([evaluation, best, float(stale)])
            team.same_random()
        row["evaluation"] = evaluation
        for name, value in row.items():
            curve.setdefault(name, [float("nan")] * iteration).append(value)
            writer.add_scalar(name, value, iteration)
        for values in curve.values():
            values.extend([float("nan")] * (iteration + 1 - len(values)))

        halt = team.any(stopping())
        if (iteration + 1) % cfg.checkpoint_every == 0 or last or halt:
            path = scratch / "checkpoint.pt"
            save_checkpoint(path, alg, env, curriculum, curve, iteration + 1, best, stale, team)
        if report is not None:
            done_now, elapsed = iteration + 1 - start, time.monotonic() - began
            pace = done_now * ppo.steps * num_envs / max(elapsed, 1e-9)
            left = elapsed / done_now * (cfg.iterations - iteration - 1)
            report(Progress(iteration + 1, cfg.iterations, row["reward"], row["success"], evaluation, pace, left, halt))

    writer.close()
    trained = len(curve["reward"])
    save_curve(directory, curve, ppo.steps * num_envs, cfg.name)
    return {
        "success": best,
        "iterations": float(trained),
        "env_steps": float(trained * ppo.steps * num_envs),
        "train_seconds": time.monotonic() - began,
    }


def make_ppo(env: GraspEnv, ppo: PpoConfig, team: Team | None = None) -> PPO:
    """rsl_rl's PPO with actor, critic and storage for `env`, or its counterpart for a team of several."""
    obs = as_observation(env.obs)
    groups = {"actor": ["teacher"], "critic": ["teacher"]}
    sizes = {"hidden_dims": list(ppo.hidden), "activation": ppo.activation}
    kind = "GaussianDistribution" if team is None or team.size == 1 else TeamGaussian
    noise = {"class_name": kind, "init_std": ppo.init_std, "std_type": "log"}
    actor = MLPModel(obs, groups, "actor", env.num_actions, distribution_cfg=noise, **sizes)
    critic = MLPModel(obs, groups, "critic", 1, **sizes)
    storage = RolloutStorage("rl", env.num_envs, ppo.steps, obs, [env.num_actions], env.device)
    make = PPO if team is None or team.size == 1 else partial(TeamPPO, team=team)
    alg = make(
        actor,
        critic,
        storage,
        num_learning_epochs=ppo.epochs,
        num_mini_batches=ppo.minibatches,
        clip_param=ppo.clip,
        gamma=ppo.gamma,
        lam=ppo.lam,
        value_loss_coef=ppo.value_coef,
        entropy_coef=ppo.entropy,
        learning_rate=ppo.lr,
        max_grad_norm=ppo.max_grad_norm,
        use_clipped_value_loss=ppo.clip_value,
        schedule="adaptive" if ppo.schedule == "adaptive" else "fixed",
        desired_kl=ppo.desired_kl,
        device=env.device,
    )
    alg.train_mode()
    return alg


def teacher_spec(env: GraspEnv, cfg: TeacherConfig, ppo: PpoConfig) -> TeacherSpec:
    """The specification that goes beside the weights."""
    return TeacherSpec(
        cfg.name,
        cfg.grasp,
        env.observe.labels,
        env.action.labels,
        asdict(env.cfg.action),
        ppo.hidden,
        ppo.activation,
        env.period,
    )


def _set_learning_rate(alg: PPO, rate: float) -> None:
    alg.learning_rate = rate
    for group in alg.optimizer.param_groups:
        group["lr"] = rate


def as_observation(obs: torch.Tensor) -> TensorDict:
    """Observations [N,O] as rsl_rl takes them."""
    return TensorDict({"teacher": obs}, batch_size=[len(obs)])


def _watch(env: GraspEnv, iteration: int, directory: Path, **values: torch.Tensor) -> None:
    """Stop at the first value that is not finite, leaving the state behind."""
    for name, value in values.items():
        if not bool(torch.isfinite(value).all()):
            path = directory / "nan_dump.npz"
            bad = (~torch.isfinite(value.reshape(len(value), -1)).all(1)).nonzero().flatten().cpu().numpy()
            np.savez(
                path, qpos=env.sim.qpos.cpu().numpy(), qvel=env.sim.qvel.cpu().numpy(), ctrl=env.ctrl.cpu().numpy(),
                episode=env.episode.cpu().numpy(), rows=bad,
            )  # fmt: skip
            raise FloatingPointError(f"{name} is not finite in iteration {iteration}; state dumped to {path}")

"""What an environment step costs, and which part of it: `wbm bench env`."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch

from wbm.control.config import WbcConfig
from wbm.envs import grasp_env, rewards
from wbm.envs.binding import SceneBinding
from wbm.envs.config import EnvConfig
from wbm.envs.grasp_env import GraspEnv
from wbm.envs.pregrasp import StartBank, solve_starts
from wbm.learning.config import PpoConfig
from wbm.learning.teacher import as_observation, make_ppo
from wbm.robot.model import load_robot
from wbm.scenes.config import ObjectsConfig, ScenesConfig
from wbm.scenes.generate import generate_scenes
from wbm.scenes.model import SceneModel, SceneModelConfig
from wbm.scenes.objects import stack_objects
from wbm.scenes.procedural import draw_objects
from wbm.sim.config import TRAIN

PARTS = ("physics", "wbc", "observe", "reward", "reset", "policy", "update")


def bench_env(num_envs: int = 128, iterations: int = 3, seed: int = 0) -> dict[str, Any]:
    """Environment steps a second with a fresh PPO policy on table and bin scenes, and where the time goes.

    The parts are measured inside the same run; `other` is what lies between them. Physics alone is the same engine
    stepping the same states under the same commands, which were kept while collecting.

    Args:
        num_envs: environments side by side.
        iterations: PPO iterations measured after one that warms up.
        seed: of objects, scenes and exploration.

    Returns:
        For one and for two engine threads ("cores_1", "cores_2"): "steps_per_s" of collecting, "train_steps_per_s"
        with the updates, "share" of the time of an iteration by part, "overhead" (share of collecting that is not
        physics), "physics_steps_per_s" of physics alone and "fraction_of_physics" that collecting reaches of it.
        The figures of one thread are repeated at the top level.
    """
    binding, starts = _world(seed)
    by_cores = {f"cores_{n}": _measure(binding, starts, num_envs, iterations, seed, threads=n) for n in (1, 2)}
    return {"num_envs": num_envs, **by_cores["cores_1"], **by_cores}


def _world(seed: int) -> tuple[SceneBinding, StartBank]:
    objects = stack_objects(draw_objects(ObjectsConfig(count=24, held_out=(), test_share=0.0, val_share=0.0), seed))
    model = SceneModel(objects, SceneModelConfig())
    bank = generate_scenes(model, ScenesConfig(count=12, test_count=0, kinds=("table", "bin")), seed)
    rows = bank.where("train")
    binding = SceneBinding(model, bank, rows)
    starts = solve_starts(binding.table, load_robot(), WbcConfig(), EnvConfig(), "top_down", seed, batch=64)
    usable = starts.usable
    kept = StartBank(starts.q[usable], starts.count[usable])
    return SceneBinding(model, bank, rows[usable.numpy()]), kept


def _measure(
    binding: SceneBinding, starts: StartBank, num_envs: int, iterations: int, seed: int, threads: int
) -> dict[str, Any]:
    sim = replace(TRAIN, threads=threads)
    torch.set_num_threads(threads)
    env = GraspEnv(binding, starts, load_robot(), EnvConfig(), sim, WbcConfig(), num_envs, seed)
    ppo = PpoConfig()
    torch.manual_seed(seed)
    env.reset()
    alg = make_ppo(env, ppo)
    watch = _Watch(env)
    _iterate(env, alg, ppo, watch)  # warms up
    watch.clear()
    began = time.perf_counter()
    for _ in range(iterations):
        _iterate(env, alg, ppo, watch)
    total = time.perf_counter() - began - watch.kept_s
    watch.close()
    steps, spent = iterations * ppo.steps * num_envs, watch.seconds
    collecting = total - spent["update"]
    share = {part: spent[part] / total for part in PARTS}
    alone = steps / watch.replay()
    return {
        "steps_per_s": steps / collecting,
        "train_steps_per_s": steps / total,
        "share": share | {"other": 1.0 - sum(share.values())},
        "overhead": 1.0 - spent["physics"] / collecting,
        "physics_steps_per_s": alone,
        "fraction_of_physics": steps / collecting / alone,
    }


def _iterate(env: GraspEnv, alg: Any, ppo: PpoConfig, watch: _Watch) -> None:
    """One PPO iteration, as `train_teacher` runs it, without its log."""
    with torch.no_grad():
        for _ in range(ppo.steps):
            with watch("policy"):
                action = alg.act(as_observation(env.obs))
            obs, reward, done, info = env.step(action)
            with watch("policy"):
                alg.process_env_step(as_observation(obs), reward, done, {"time_outs": info["time_outs"]})
    with watch("update"):
        with torch.no_grad():
            alg.compute_returns(as_observation(env.obs))
        alg.update()


class _Watch:
    """Adds up wall time by part; a part inside another is charged to the inner one alone.

    Attributes:
        seconds: time by part.
        kept_s: time that keeping states for the replay took.
    """

    def __init__(self, env: GraspEnv) -> None:
        self.env = env
        self.seconds: Counter[str] = Counter()
        self.kept_s = 0.0
        self._stack: list[list[Any]] = []
        self._kept: list[tuple[dict[str, torch.Tensor], torch.Tensor]] = []
        self._total = rewards.total
        self._step = env.sim.step
        env.sim.step = self._physics
        for owner, name, part in (
            (env.controller, "step", "wbc"),
            (env.action, "apply", "wbc"),
            (env, "_refresh", "observe"),
            (env.outcome, "update", "reward"),
            (env, "_begin", "reset"),
        ):
            setattr(owner, name, self._timed(getattr(owner, name), part))
        grasp_env.rewards.total = self._timed(self._total, "reward")

    def __call__(self, part: str) -> _Watch:
        self._next = part
        return self

    def __enter__(self) -> None:
        now = time.perf_counter()
        if self._stack:
            outer = self._stack[-1]
            self.seconds[outer[0]] += now - outer[1]
        self._stack.append([self._next, now])

    def __exit__(self, *error: object) -> None:
        now = time.perf_counter()
        part, since = self._stack.pop()
        self.seconds[part] += now - since
        if self._stack:
            self._stack[-1][1] = now

    def clear(self) -> None:
        """Forget what was measured so far."""
        self.seconds.clear()
        self._kept.clear()
        self.kept_s = 0.0

    def close(self) -> None:
        """Stop watching."""
        grasp_env.rewards.total = self._total
        self.env.sim.step = self._step

    def replay(self) -> float:
        """Seconds that physics alone takes over the kept states, commands written and nothing read."""
        sim, spent = self.env.sim, 0.0
        for state, ctrl in self._kept:
            sim.load_state(state)
            began = time.perf_counter()
            sim.ctrl.copy_(ctrl)
            sim.step(self.env.decimation)
            spent += time.perf_counter() - began
        return spent

    def _physics(self, count: int = 1) -> None:
        began = time.perf_counter()
        self._kept.append((self.env.sim.save_state(), self.env.sim.ctrl.clone()))
        self.kept_s += time.perf_counter() - began
        with self("physics"):
            self._step(count)

    def _timed(self, function: Callable, part: str) -> Callable:
        def timed(*args: Any, **kwargs: Any) -> Any:
            with self(part):
                return function(*args, **kwargs)

        return timed

"""Runs whole episodes of an environment under a driver, with or without perception, and judges each of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from wbm.envs.actions import joint_limits
from wbm.envs.grasp_env import STARTS, GraspEnv
from wbm.envs.outcome import REASONS, SUCCESS
from wbm.envs.perception import MIN_TARGET_PIXELS, Perception, Sight
from wbm.robot import joints
from wbm.robot.schema import PolicySchema, to_increment, to_target

SETTLING_S = 1.0
"""Visibility of the target is counted after this time."""

WRONG_LIFT = 0.05
"""A distractor that is lifted this far (m) counts as the wrong object."""


@dataclass
class Frame:
    """All environments just before and just after one policy step. Arrays lead with N.

    Attributes:
        episode: episode number; elapsed: policy steps since its start.
        q: joint positions before the step; object_pose: [N,1+D,7] poses of target and distractors before it.
        sight: what the student sees, None without perception.
        action: clean command in the units of the action schema; executed: what was carried out.
        phase: 0 free space, 1 contact.
        ee_distance: grasp frame to the target, m.
        held: whether the hand has hold of the target after the step.
        done: whether the episode ended with this step.
        scene: index of its scene in the environment's binding.
    """

    episode: Tensor
    elapsed: Tensor
    q: Tensor
    object_pose: Tensor
    sight: Sight | None
    action: Tensor
    executed: Tensor
    phase: Tensor
    ee_distance: Tensor
    held: Tensor
    done: Tensor
    scene: Tensor


@dataclass
class Record:
    """How one episode went; see `docs/teachers.md` for the reasons."""

    episode: int
    scene_index: int
    object_index: int
    kind: int
    success: bool
    reason: str
    steps: int
    collision: bool
    wrong_object: bool
    target_visible: float | None
    time_to_grasp_s: float | None
    max_force: float
    start: str

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)


class Driver(Protocol):
    """Carries out one policy step of the environment; returns what `GraspEnv.step` returns."""

    needs_sight: bool

    def step(self, env: GraspEnv, sight: Sight | None) -> tuple[Tensor, Tensor, Tensor, dict]:
        """Act once in all environments."""
        ...


class TeacherDriver:
    """The environment's own controller and a teacher: `policy` maps the privileged observation to an action."""

    needs_sight = False

    def __init__(self, policy: Callable[[Tensor], Tensor]) -> None:
        self.policy = policy

    def step(self, env: GraspEnv, sight: Sight | None) -> tuple[Tensor, Tensor, Tensor, dict]:
        """Act on the privileged observation."""
        return env.step(self.policy(env.obs))


class StudentDriver:
    """A student: `policy` maps the schema's observation to 32 actions, which become joint targets."""

    needs_sight = True

    def __init__(self, policy: Callable[[dict[str, Tensor]], Tensor], env: GraspEnv, schema: PolicySchema) -> None:
        self.policy, self.schema = policy, schema
        self.low, self.high = joint_limits(env.robot, env.device)

    def target(self, env: GraspEnv, sight: Sight) -> Tensor:
        """Joint targets [N,32], within their limits, for what is seen."""
        action = torch.as_tensor(self.policy(sight.obs), dtype=torch.float32, device=env.device)
        return to_target(torch, env.state.q.float(), action, self.schema.action).clamp(self.low, self.high)

    def step(self, env: GraspEnv, sight: Sight | None) -> tuple[Tensor, Tensor, Tensor, dict]:
        """Act on what is seen."""
        assert sight is not None
        return env.step_targets(self.target(env, sight))


class EpisodeRunner:
    """Runs numbered episodes; an episode is determined by the environment's seed and its number alone.

    Args:
        env: a grasping environment.
        perception: what the student sees; None where nobody looks.
        kinds: scene kind [K] of each scene of the environment's bank; objects: target's index [K].
        text: embedding of each scene's instruction [K,D]; needed with perception.
        noise: what is added to the executed targets, given episodes [K] and steps T: [K,T,32].
        free_noise: factor of the noise in free space.
    """

    def __init__(
        self,
        env: GraspEnv,
        schema: PolicySchema,
        kinds: np.ndarray,
        objects: np.ndarray,
        perception: Perception | None = None,
        text: Tensor | None = None,
        noise: Callable[[np.ndarray, int], np.ndarray] | None = None,
        free_noise: float = 1.0,
    ) -> None:
        self.env, self.schema, self.perception, self.text = env, schema, perception, text
        self.kinds, self.objects = kinds, objects
        self.noise, self.free_noise = noise, free_noise
        n, device = env.num_envs, env.device
        self._previous = torch.zeros(n, joints.NUM_JOINTS, device=device)
        self._noise = torch.zeros(0, n, joints.NUM_JOINTS, device=device)
        self._tally = {
            name: torch.zeros(n, device=device) for name in ("seen", "looked", "grasp_step", "force", "wrong", "hit")
        }
        self._rest_height = torch.zeros(n, 1 + env.binding.num_distractors, device=device)

    def run(
        self,
        driver: Driver,
        first: int,
        count: int,
        on_frame: Callable[[Frame], None] | None = None,
        on_end: Callable[[int, Record], None] | None = None,
    ) -> list[Record]:
        """Run the episodes `first` to `first + count - 1`.

        Args:
            driver: who acts.
            on_frame: called with every step of all environments.
            on_end: called with (environment, record) when an episode of the range has ended, after its last frame.

        Returns:
            One record an episode, in the order of their numbers.
        """
        env = self.env
        env.reset(first)
        records: dict[int, Record] = {}
        last = torch.full_like(env.episode, -1)
        while len(records) < count:
            fresh = (env.episode != last).nonzero().squeeze(1)
            if len(fresh):
                self._start(fresh)
                last = env.episode.clone()
            frame = self._step(driver)
            if on_frame:
                on_frame(frame)
            for e in frame.done.nonzero().squeeze(1).tolist():
                number = int(frame.episode[e])
                if number < first + count:
                    records[number] = self._record(e, frame)
                    if on_end:
                        on_end(e, records[number])
        return [records[i] for i in sorted(records)]

    def _start(self, ids: Tensor) -> None:
        env = self.env
        self._previous[ids] = 0.0
        for value in self._tally.values():
            value[ids] = 0.0
        self._tally["grasp_step"][ids] = -1.0
        self._rest_height[ids] = env.object_poses()[ids, :, 2].float()
        if self.noise:
            rows = self.noise(env.episode[ids].cpu().numpy(), env.limit_steps + 1)
            if len(self._noise) == 0:
                self._noise = torch.zeros(rows.shape[1], env.num_envs, joints.NUM_JOINTS, device=env.device)
            self._noise[:, ids] = torch.from_numpy(rows).to(self._noise).transpose(0, 1)
        if self.perception and self.text is not None:
            scenes = env.scene[ids]
            self.perception.begin(ids, scenes, env.episode[ids], self.text[scenes])

    def _step(self, driver: Driver) -> Frame:
        env, s = self.env, self.env.state
        q, poses = s.q.float().clone(), env.object_poses().float().clone()
        episode, elapsed, phase = env.episode.clone(), env.elapsed.clone(), env.phase.clone()
        distance, scene, started = s.centre_gap.clone(), env.scene.clone(), env.started.clone()
        sight = None
        if self.perception:
            sight = self.perception.observe(q, s.qd.float(), poses, self._previous, elapsed)
        env.noise = None
        if self.noise:
            rows = torch.arange(env.num_envs, device=env.device)
            noise = self._noise[elapsed.clamp(max=len(self._noise) - 1), rows]
            env.noise = noise * torch.where(phase == 0, self.free_noise, 1.0).unsqueeze(1)
        _, _, done, info = driver.step(env, sight)
        command = info["ctrl"].float()
        action = to_increment(torch, q, command, self.schema.action)
        executed = to_increment(torch, q, info["executed"].float(), self.schema.action)
        self._previous.copy_(executed)
        ended = info["ended"]
        self._count(sight, elapsed, ended)
        self._scene_of_done, self._started = scene, started
        self._code = info["outcome"]
        return Frame(episode, elapsed, q, poses, sight, action, executed, phase, distance, ended["held"], done, scene)

    def _count(self, sight: Sight | None, elapsed: Tensor, ended: dict[str, Tensor]) -> None:
        t = self._tally
        if sight is not None:
            late = (elapsed * self.env.period >= SETTLING_S).float()
            t["looked"] += late
            t["seen"] += late * (sight.target_pixels >= MIN_TARGET_PIXELS).float()
        first = (t["grasp_step"] < 0) & (ended["held"] > 0) & (ended["height"] > 0.02)
        t["grasp_step"][first] = (elapsed[first] + 1).float()
        torch.maximum(t["force"], ended["force"].float(), out=t["force"])
        t["hit"] = torch.maximum(t["hit"], ended["forbidden"].float())
        if self._rest_height.shape[1] > 1:
            lifted = (ended["object_z"][:, 1:].float() - self._rest_height[:, 1:] > WRONG_LIFT).any(1)
            t["wrong"] = torch.maximum(t["wrong"], lifted.float())

    def _record(self, e: int, frame: Frame) -> Record:
        t, code, scene = self._tally, int(self._code[e]), int(self._scene_of_done[e])
        looked, step = float(t["looked"][e]), float(t["grasp_step"][e])
        steps = int(frame.elapsed[e]) + 1
        return Record(
            episode=int(frame.episode[e]),
            scene_index=scene,
            object_index=int(self.objects[scene]),
            kind=int(self.kinds[scene]),
            success=code == SUCCESS,
            reason=REASONS[code],
            steps=steps,
            collision=bool(t["hit"][e] > 0),
            wrong_object=bool(t["wrong"][e] > 0),
            target_visible=float(t["seen"][e]) / looked if looked > 0 else None,
            time_to_grasp_s=step * self.env.period if step >= 0 else None,
            max_force=float(t["force"][e]),
            start=STARTS[int(self._started[e])],
        )

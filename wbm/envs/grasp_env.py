"""The grasping environment: whole-body controller, physics, observation, reward and outcome for N environments."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
import warp as wp
from torch import Tensor

from wbm.artifacts.episode_layout import STARTS
from wbm.control.config import WbcConfig
from wbm.control.wbc import WholeBodyController
from wbm.envs import rewards
from wbm.envs.actions import make_action
from wbm.envs.binding import SceneBinding
from wbm.envs.config import EnvConfig
from wbm.envs.draws import Columns, episode_uniforms
from wbm.envs.observations import TeacherObservation
from wbm.envs.outcome import RUNNING, SUCCESS, UNSTABLE, Outcome
from wbm.envs.pregrasp import StartBank
from wbm.envs.randomization import Randomizer
from wbm.envs.sensing import StateReader
from wbm.envs.state import GraspState
from wbm.robot import joints
from wbm.robot.model import RobotModel
from wbm.sim.config import SimConfig
from wbm.sim.simulation import make_simulation

FULL, AT_PREGRASP, SCATTERED = range(len(STARTS))

_LIVE = ("episode", "scene", "scene_weight", "elapsed", "ctrl", "previous", "posture")


class GraspEnv:
    """N episodes of grasping the target of a scene.

    `step` takes a teacher's action [N,A]; `step_targets` takes 32 joint targets, as a student gives them. An episode is
    determined by (seed, episode number) alone, not by its environment (a curriculum adds `scene_weight`).

    Attributes:
        obs: the teacher's observation [N,O] of the present state; its labels are `observe.labels`.
        state: the present `GraspState`; known: what policy and gaze know of it, the same unless a subclass hides some.
        ctrl: joint targets that the last step commanded [N,32], before `noise`.
        noise: optional [N,32] added to what is executed (the command recorded in `ctrl` stays clean).
        override: optional [N,32] executed in place of `ctrl`: another policy acts and this one is only asked.
        phase: 0 free space, 1 contact-rich [N].
        started: how each episode started [N], an index into `STARTS`.
        episode: episode number [N]; `scene`: scene index [N]; `elapsed`: steps since its start [N].
        claim: given how many episodes start here, how many start before them in other processes and how many in all.
        scene_weight: relative chance of every scene [S] to be drawn; equal until a curriculum changes it.
    """

    def __init__(
        self,
        binding: SceneBinding,
        starts: StartBank,
        robot: RobotModel,
        cfg: EnvConfig,
        sim_cfg: SimConfig,
        wbc_cfg: WbcConfig,
        num_envs: int,
        seed: int = 0,
        device: str = "cpu",
    ) -> None:
        self.cfg, self.robot, self.binding, self.starts = cfg, robot, binding, starts
        self.num_envs, self.seed, self.device = num_envs, seed, device
        self.period, self.decimation = sim_cfg.period, sim_cfg.decimation
        self.max_steps = round(cfg.episode_s / self.period)
        self.sim = make_simulation(binding.model, num_envs, sim_cfg, device)
        self.controller = WholeBodyController(robot, num_envs, binding.table.obstacle_type.shape[1], wbc_cfg, device)
        self._wire_controller()
        self.columns = Columns()
        self.randomizer = Randomizer(cfg.randomization, self.sim, binding, self.columns)
        self._pick = self.columns.add("scene")
        self._start = self.columns.add("start")
        self._hand = self.columns.add("start_hand", 16)
        self.action = make_action(cfg.action, robot, num_envs, self.period, device)
        self.observe = TeacherObservation(robot, self.action.offset_labels, self.action.labels, device)
        self.reader = StateReader(robot, self.sim, self.controller, binding, cfg, self.period)
        self.outcome = Outcome(cfg, self.period, num_envs, device)
        self.episode = torch.full((num_envs,), -1, dtype=torch.int64, device=device)
        self.scene = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self.elapsed = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self.scene_weight = torch.ones(binding.table.count, dtype=torch.float64, device=device)
        self.ctrl = self.sim.ctrl.clone()
        self.noise: Tensor | None = None
        self.override: Tensor | None = None
        self.previous = torch.zeros(num_envs, self.num_actions, device=device)
        self.next_episode = 0
        self.claim: Callable[[int], tuple[int, int]] = lambda count: (0, count)
        self.phase = torch.ones(num_envs, dtype=torch.uint8, device=device)
        self.started = torch.full((num_envs,), AT_PREGRASP, dtype=torch.int64, device=device)

    @property
    def limit_steps(self) -> int:
        """Policy steps after which an episode ends in any case."""
        return self.max_steps

    def object_poses(self) -> Tensor:
        """World poses of target and distractors [N,1+D,7], position and quaternion (w x y z)."""
        first, count = self.binding.target_qpos.start, 1 + self.binding.num_distractors
        return self.sim.qpos[:, first : first + 7 * count].view(self.num_envs, count, 7)

    @property
    def num_actions(self) -> int:
        """A."""
        return len(self.action.labels)

    # Episodes

    def reset(self, first_episode: int = 0) -> Tensor:
        """Start every environment anew with the episodes from `first_episode` on; returns the observation."""
        self.next_episode = first_episode
        self._begin(torch.arange(self.num_envs, device=self.device), self._claim(self.num_envs))
        self._refresh()
        return self.obs

    def state_dict(self) -> dict:
        """Everything that the next step depends on: `load_state_dict` in a like environment continues exactly."""
        live = {name: tensor.clone() for name, tensor in self._live().items()}
        return {"sim": self.sim.save_state(), "live": live, "next_episode": self.next_episode}

    def load_state_dict(self, state: dict) -> None:
        """Restore `state_dict`'s answer."""
        ids = torch.arange(self.num_envs, device=self.device)
        episodes = state["live"]["episode"].cpu().numpy()
        self._load_physics(ids, self._uniforms(episodes), state["live"]["scene"])
        self.reader.begin(ids, state["live"]["scene"])
        self._obstacles(ids, state["live"]["scene"])
        self.sim.load_state(state["sim"])
        for name, tensor in self._live().items():
            tensor.copy_(state["live"][name])
        self.next_episode = state["next_episode"]
        self._refresh()

    def _live(self) -> dict[str, Tensor]:
        """The environment's own state tensors by name."""
        own = {name: getattr(self, name) for name in _LIVE}
        parts = {"action": self.action, "hand": self.action.hand, "outcome": self.outcome, "reader": self.reader}
        for part, item in parts.items():
            own |= {f"{part}.{name}": value for name, value in vars(item).items() if name in item.STATE}
        return own | {f"controller.{name}": tensor for name, tensor in self._controller_state.items()}

    def _uniforms(self, episodes: np.ndarray) -> Tensor:
        return torch.from_numpy(episode_uniforms(self.seed, episodes, self.columns.count)).to(self.device)

    def _load_physics(self, ids: Tensor, u: Tensor, scenes: Tensor) -> None:
        """Write scenes and randomised physics of environments `ids`, with fresh simulation state."""
        self.sim.reset(ids)
        self.randomizer.load(ids, scenes, u)

    def _claim(self, count: int) -> np.ndarray:
        """The next `count` episode numbers for this process; every process calls at every step."""
        before, total = self.claim(count)
        first = self.next_episode + before
        self.next_episode += total
        return np.arange(first, first + count)

    def _begin(self, ids: Tensor, episodes: np.ndarray) -> None:
        """Start `episodes` in environments `ids` (sorted)."""
        u = self._uniforms(episodes)
        table = self.binding.table
        if self.cfg.randomization.scene:
            edges = self.scene_weight.cumsum(0)
            scenes = torch.searchsorted(edges, u[:, self._pick].squeeze(1).double() * edges[-1], right=True)
            scenes.clamp_(max=table.count - 1)
        else:
            scenes = torch.from_numpy(episodes % table.count).to(self.device)
        q = self._start_joints(ids, scenes, u)
        hand = self.cfg.randomization.start_hand
        if hand.on:
            q[:, joints.HAND] += hand.low + (hand.high - hand.low) * u[:, self._hand]
            q[:, joints.HAND] = torch.maximum(
                torch.minimum(q[:, joints.HAND], self.action.hand.high), self.action.hand.low
            )
        self.episode[ids] = torch.from_numpy(episodes).to(self.device)
        self.scene[ids], self.elapsed[ids] = scenes, 0
        self._load_physics(ids, u, scenes)
        self.sim.qpos[ids, : joints.NUM_JOINTS] = q
        self.sim.qvel[ids] = 0.0
        self.sim.ctrl[ids] = q
        self.ctrl[ids] = q
        self.sim.forward(ids)
        self.reader.begin(ids, scenes)
        self._obstacles(ids, scenes)
        self.posture[ids] = q[:, self._body]
        self.controller.reset(ids)  # pyright: ignore[reportArgumentType]
        self.min_distance[ids] = 1.0  # the last episode's must not be observed
        self.outcome.reset(ids)
        self.previous[ids] = 0.0
        self.q_in.copy_(self.sim.qpos[:, : joints.NUM_JOINTS])
        self.controller.forward_kinematics()
        ee = self.reader.ee
        self.action.reset(ids, q, self.frame_pos[ids, ee], self.frame_quat[ids, ee])

    def _start_joints(self, ids: Tensor, scenes: Tensor, u: Tensor) -> Tensor:
        """Joint positions [K,32] in which the episodes of environments `ids` start."""
        return self._fixed_neck(self.starts.draw(scenes, u[:, self._start].squeeze(1)))

    def _fixed_neck(self, q: Tensor) -> Tensor:
        """Joint positions [K,32] with the neck at its home pose where there is no active vision."""
        if self.cfg.action.neck == "fixed":
            q[:, joints.NECK] = self._neck_home
        return q

    def _time_up(self) -> Tensor:
        """Episodes [N] whose time has run out."""
        return self.elapsed >= self.max_steps

    # Steps

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, dict]:
        """One policy step with a teacher's action [N,A].

        Returns:
            The observation [N,O] (of the next episode where one ended), rewards [N], done flags [N] and a dictionary:
            `time_outs` [N] (ended by time alone), `outcome` [N] (see `outcome.REASONS`, `RUNNING` where it goes on),
            `terms` [N,8] weighted reward terms in the order of `rewards.TERMS`, `episode` and `scene` [N] that the step
            belonged to,
            `ctrl` and `executed` [N,32] joint targets, clean and as carried out, and `ended`, what the step led to
            before any restart: `held`, `height`, `force` (largest of a finger), `forbidden` [N], `object_z` [N,1+D].
        """
        action = action.clamp(-self.cfg.action.limit, self.cfg.action.limit)
        s = self.state
        self.action.apply(action, s.q, s.ee_pos_w, s.ee_quat)
        self._command()
        return self._advance(action)

    def step_targets(self, ctrl: Tensor) -> tuple[Tensor, Tensor, Tensor, dict]:
        """One policy step with joint targets [N,32] in place of the controller's; returns what `step` does."""
        self.ctrl.copy_(ctrl)
        self._fix_neck()
        return self._advance(torch.zeros_like(self.previous))

    def _fix_neck(self) -> None:
        """Without active vision the neck is told to stay at its home pose, whoever commands the other joints."""
        if self.cfg.action.neck == "fixed":
            self.ctrl[:, joints.NECK] = self._neck_home

    def _known(self, s: GraspState) -> GraspState:
        """What policy and gaze know of the state: all of it."""
        return s

    def _command(self) -> None:
        """Fill `ctrl` from the action term, through the controller unless the term is in joint space."""
        term = self.action
        self.ctrl[:, joints.HAND] = term.hand.target
        if self.cfg.action.term == "joint":
            self.ctrl[:, self._body] = term.target
            return
        contact = (self.phase == 1).unsqueeze(1)
        self.margin.copy_(torch.where(contact, self._contact_margin, 0.0))
        self.base_weight.copy_(torch.where(contact[:, 0], self.cfg.contact_base, self._free_base))
        self.ee_velocity.copy_(term.velocity)
        self.ee_target.copy_(term.pos)
        self.ee_target_quat.copy_(term.quat)
        self.gaze.copy_(self.known.obj_pos_w)
        self.controller.step()
        self.ctrl[:, self._body] = self.body_ctrl
        self._fix_neck()

    def _advance(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, dict]:
        if self.override is not None:
            executed = self.override
        else:
            executed = self.ctrl.clone() if self.noise is None else self.ctrl + self.noise
        self.sim.ctrl.copy_(executed)
        self.sim.step(self.decimation)
        self.elapsed += 1
        before = self.previous.clone()
        self.previous.copy_(action)
        self._refresh()
        reward, terms = rewards.total(self.state, action, before, self.cfg.reward)
        time_up = self._time_up()
        code = self.outcome.update(self.state, self.reader.start_pos, time_up)
        done = code != RUNNING
        timed = done & time_up
        reward = reward - self.cfg.reward.scale * self.cfg.reward.drop * (done & ~timed & (code != SUCCESS))
        reward[code == UNSTABLE] = 0.0
        info = {"time_outs": timed.float(), "outcome": code, "terms": terms, "episode": self.episode.clone()}
        info |= {"scene": self.scene.clone(), "ctrl": self.ctrl.clone(), "executed": executed, "ended": self._ended()}
        ids = done.nonzero().squeeze(1)
        episodes = self._claim(len(ids))
        if len(ids):
            self._begin(ids, episodes)
            self._refresh()
        return self.obs, reward, done, info

    def _ended(self) -> dict[str, Tensor]:
        s = self.state
        force = s.finger_force.amax(1)
        z = self.object_poses()[:, :, 2].clone()
        return {"held": s.held, "height": s.height, "force": force, "forbidden": s.forbidden, "object_z": z}

    def _refresh(self) -> None:
        """Recompute frames, state and observation from the simulation."""
        self.q_in.copy_(self.sim.qpos[:, : joints.NUM_JOINTS])
        self.controller.forward_kinematics()
        self.state = self.reader.read(self.frame_pos, self.frame_quat)
        self.known = s = self._known(self.state)
        offset = self.action.offset(s.q, s.ee_pos_w, s.ee_quat)
        self.obs = self.observe(
            s, self.ctrl[:, joints.HAND], self.reader.support, self.min_distance, offset, self.previous
        )

    # The controller's live arrays as tensors

    def _wire_controller(self) -> None:
        c = self.controller
        self.q_in, self.body_ctrl = wp.to_torch(c.q), wp.to_torch(c.ctrl)
        self.ee_velocity = wp.to_torch(c.ee_lin_vel)
        self.ee_target, self.ee_target_quat = wp.to_torch(c.ee_pos), wp.to_torch(c.ee_quat)
        self.gaze, self.posture = wp.to_torch(c.gaze_point), wp.to_torch(c.q_posture)
        self.frame_pos, self.frame_quat = wp.to_torch(c.frame_pos), wp.to_torch(c.frame_quat)
        self.min_distance = wp.to_torch(c.min_distance)
        # In contact the fingers work beside the support, and a base that creeps would meet it.
        self.margin = wp.to_torch(c.sphere_margin)
        hand = torch.tensor([n.startswith("hand_") for n in c.spheres.names], device=self.device)
        self._contact_margin, self._free_base = hand * self.cfg.hand_margin, c.cfg.weights.base
        self.base_weight = wp.to_torch(c.weights)[:, list(c.weight_names).index("base")]
        self.obstacles = tuple(
            wp.to_torch(a) for a in (c.obstacle_type, c.obstacle_size, c.obstacle_pos, c.obstacle_quat)
        )
        wp.to_torch(c.gaze_weight).fill_(0.0 if self.cfg.action.neck == "fixed" else 1.0)
        self._controller_state = {
            name: wp.to_torch(getattr(c, name)) for name in ("qd", "q_target", "min_distance", "_fresh")
        }
        self._body = torch.as_tensor(joints.WBC, device=self.device)
        self._neck_home = torch.tensor(self.robot.q_home[joints.NECK], dtype=torch.float32, device=self.device)

    def _obstacles(self, ids: Tensor, scenes: Tensor) -> None:
        t = self.binding.table
        for live, values in zip(
            self.obstacles, (t.obstacle_type, t.obstacle_size, t.obstacle_pos, t.obstacle_quat), strict=True
        ):
            live[ids] = values[scenes]

"""The torch-free runtime: from a robot's reading to a joint target, 25 times a second."""

from __future__ import annotations

from collections import deque

import numpy as np

from wbm.deploy.bundle import Bundle
from wbm.deploy.driver import Command, Reading
from wbm.deploy.faults import Fault, Refused
from wbm.deploy.kinematics import Kinematics
from wbm.deploy.safety import SafetyFilter
from wbm.robot import joints
from wbm.robot.schema import to_increment, to_target

_HISTORY_S = 1.0


class PolicyRuntime:
    """Steps a bundle's policy; holds the previous action, the instruction and a short history of joint readings.

    Latency: each cloud is moved from the sensor's pose at the cloud's own stamp into the base frame at the joints'
    stamp, so that a camera that moves while its frame is under way does not smear the target.

    Args:
        bundle: an opened bundle.
        instruction: what to pick up; must be cached unless the cache has an encoder.
        threads: threads for onnxruntime.
        max_skip: a step that comes more than this many periods after the one before starts anew (previous action 0).
    """

    def __init__(self, bundle: Bundle, instruction: str = "", threads: int = 1, max_skip: float = 5.0) -> None:
        self.bundle = bundle
        self.contract = bundle.contract
        self.safety = SafetyFilter(bundle.contract)
        self._policy = bundle.policy(threads)
        self._kinematics = Kinematics(bundle.contract)
        self._max_gap = max_skip * bundle.contract.dt
        self.observation: dict[str, np.ndarray] = {}
        self.set_instruction(instruction)
        self.reset()
        # The first run of a network plans its memory: do it here, not in the first step.
        self._policy({f.name: np.zeros((1, *f.shape), f.dtype) for f in self.contract.schema.observation})

    def reset(self) -> None:
        """Start a new episode."""
        self.safety.reset()
        self._previous = np.zeros(joints.NUM_JOINTS, dtype=np.float32)
        self._history: deque[tuple[float, np.ndarray]] = deque()

    def set_instruction(self, sentence: str) -> None:
        """Choose what to pick up.

        Raises:
            Refused: `UNKNOWN_INSTRUCTION`.
        """
        self.set_embedding(self.bundle.instructions.embed(sentence))
        self.instruction = sentence

    def set_embedding(self, embedding: np.ndarray) -> None:
        """Choose what to pick up by a sentence embedding [text_dim] of one's own encoder.

        Raises:
            Refused: `WRONG_SHAPE` or `NOT_FINITE`.
        """
        embedding = np.asarray(embedding, dtype=np.float32)
        if embedding.shape != (self.contract.schema.text_dim,):
            raise Refused(
                Fault.WRONG_SHAPE, f"embedding has shape {embedding.shape}, expected ({self.contract.schema.text_dim},)"
            )
        if not np.isfinite(embedding).all():
            raise Refused(Fault.NOT_FINITE, "the embedding holds values that are not finite")
        self._text, self.instruction = embedding, ""

    def step(self, reading: Reading, now: float) -> Command:
        """One policy step.

        Args:
            reading: the newest measurement.
            now: time on the clock of its stamps, s.

        Returns:
            A command inside every limit.

        Raises:
            Refused: nothing may be sent; tell the driver to hold and call `recover()`.
        """
        self.safety.check(reading, now)
        q = np.asarray(reading.q, dtype=np.float64)
        stamp = reading.stamps["joints"]
        if self._history and stamp - self._history[-1][0] > self._max_gap:
            self._previous = np.zeros_like(self._previous)
            self._history.clear()
        self._history.append((stamp, q))
        while self._history[0][0] < stamp - _HISTORY_S:
            self._history.popleft()
        self.observation = self._observe(reading, q)
        action = self._policy({k: v[None] for k, v in self.observation.items()})[0]
        spec = self.contract.schema.action
        action = np.clip(action, -spec.limit, spec.limit)
        target, velocity = self.safety.limit(to_target(np, q, action.astype(np.float64), spec))
        self._check_workspace(target)
        # As in training, the action of the step before is what was commanded, after every limit.
        self._previous = to_increment(np, q, target, spec).astype(np.float32)
        return Command(now, target, velocity, action.astype(np.float32))

    def recover(self) -> None:
        """After a refusal, once the driver holds: the next command starts from rest at the measured pose."""
        self.safety.rest()
        self._previous = np.zeros_like(self._previous)

    def pose_at(self, stamp: float) -> np.ndarray:
        """Joint positions [32] at a past time, interpolated between readings; the oldest known before that."""
        older = self._history[0]
        for newer in self._history:
            if newer[0] >= stamp:
                span = newer[0] - older[0]
                share = 0.0 if span <= 0 else min(max((stamp - older[0]) / span, 0.0), 1.0)
                return older[1] + share * (newer[1] - older[1])
            older = newer
        return self._history[-1][1]

    def _observe(self, reading: Reading, q: np.ndarray) -> dict[str, np.ndarray]:
        frames = self._kinematics.frames(q)
        rot_wb, pos_wb = frames["base"]

        def to_base(sensor: str, frame: str, xyz: np.ndarray, valid: np.ndarray) -> np.ndarray:
            stamp = reading.stamps[sensor]
            then = frames if stamp >= reading.stamps["joints"] else self._kinematics.frames(self.pose_at(stamp))
            rot_ws, pos_ws = then[frame]
            points = xyz @ (rot_wb.T @ rot_ws).T + rot_wb.T @ (pos_ws - pos_wb)
            return np.where(valid[:, None] != 0, points, 0.0).astype(np.float32)

        return {
            "depth_xyz": to_base("depth", "camera", reading.depth_xyz, reading.depth_valid),
            "depth_rgb": reading.depth_rgb.astype(np.uint8),
            "depth_valid": reading.depth_valid.astype(np.uint8),
            "depth_target": reading.depth_target.astype(np.uint8),
            "lidar_xyz": to_base("lidar", "lidar", reading.lidar_xyz, reading.lidar_valid),
            "lidar_valid": reading.lidar_valid.astype(np.uint8),
            "proprio": self._kinematics.proprio(q, np.asarray(reading.qd, dtype=np.float64), frames),
            "prev_action": self._previous,
            "text": self._text,
        }

    def _check_workspace(self, target: np.ndarray) -> None:
        limits = self.contract.data["workspace"]
        frames = self._kinematics.frames(target)
        for name in ("ee", "camera", *(f"tip_{f}" for f in joints.FINGERS)):
            if frames[name][1][2] < limits["floor_clearance_m"]:
                raise Refused(Fault.WORKSPACE, f"the target puts {name} at height {frames[name][1][2]:.3f} m")
        reach = float(np.linalg.norm((frames["ee"][1] - frames["base"][1])[:2]))
        if reach > limits["reach_m"]:
            raise Refused(
                Fault.WORKSPACE,
                f"the target puts the grasp centre {reach:.2f} m from the base, allowed {limits['reach_m']:.2f} m",
            )

"""A policy in closed loop in its environment, one step after the other, for somebody who watches."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from wbm.envs.episodes import Frame, Record
from wbm.learning.evaluation import BlockJob, EvaluationWorld

_ENDLESS = 1_000_000_000
_OBSERVED = ("depth_xyz", "depth_rgb", "depth_valid", "depth_target", "lidar_xyz", "lidar_valid")


@dataclass
class LiveEpisode:
    """An episode so far; `steps` holds lists of T rows.

    Attributes:
        number: episode number, which with the seed says all about it.
        scene_row: row of the assets' scene bank.
        instruction: what the policy is told.
        steps: `q` [32], `command` [32] (clean action in schema units), `poses` [1+D,7], `phase`, and the observation's
            clouds.
        outcome: how it ended; empty while it runs.
    """

    number: int
    scene_row: int
    instruction: str
    steps: dict[str, list[Any]] = field(default_factory=dict)
    outcome: str = ""

    def __len__(self) -> int:
        return len(self.steps.get("q", ()))


class _Closed(Exception):
    """Unwinds the episode runner."""


class LivePolicy:
    """Runs episodes of a policy in a thread of its own, at `speed` times real time at most, until `close`.

    Attributes:
        paused: set to hold the simulation before its next step.
        speed: of the simulated clock.
        error: what ended the thread, if anything did.
    """

    def __init__(self, job: BlockJob) -> None:
        """Build environment, sensors and policy; `job` as for an evaluation, with one environment.

        Raises:
            ValueError: the job has more than one environment, or the policy does not fit.
        """
        if job.num_envs != 1:
            raise ValueError("a live policy runs in one environment")
        self.world = EvaluationWorld(job, watch=True)
        self.paused, self.speed, self.error = False, 1.0, ""
        self._first = job.first
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._due = 0.0
        self._now: LiveEpisode | None = None
        self._thread = threading.Thread(target=self._run, name="live-policy", daemon=True)

    @property
    def period(self) -> float:
        """Seconds of a policy step."""
        return self.world.env.period

    def start(self) -> None:
        """Begin the first episode."""
        self._thread.start()

    def close(self) -> None:
        """End the thread after its present step."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=30)

    def episode(self, number: int = -1, known: int = 0) -> LiveEpisode | None:
        """The present episode, without its first `known` steps if it is episode `number`; None before the first step.

        The rows are shared and never written again; the lists are copies.
        """
        with self._lock:
            now = self._now
            if now is None:
                return None
            first = known if now.number == number else 0
            steps = {name: rows[first:] for name, rows in now.steps.items()}
            return LiveEpisode(now.number, now.scene_row, now.instruction, steps, now.outcome)

    def _run(self) -> None:
        try:
            self.world.runner.run(self.world.driver, self._first, _ENDLESS, self._on_frame, self._on_end)
        except _Closed:
            return
        except Exception as error:  # the watcher is told; there is nobody else to tell
            self.error = f"{type(error).__name__}: {error}"

    def _on_frame(self, frame: Frame) -> None:
        assert frame.sight is not None
        self._wait()
        rows = {name: frame.sight.obs[name][0].cpu().numpy().copy() for name in _OBSERVED}
        rows |= {
            "q": frame.q[0].cpu().numpy().copy(),
            "command": frame.action[0].cpu().numpy().copy(),
            "poses": frame.object_pose[0].cpu().numpy().copy(),
            "phase": int(frame.phase[0]),
        }
        number = int(frame.episode[0])
        with self._lock:
            if self._now is None or self._now.number != number:
                scene = int(frame.scene[0])
                row = int(self.world.env.binding.scenes[scene])
                text = str(self.world.assets.texts.sentence[self.world.sentence[scene]])
                self._now = LiveEpisode(number, row, text, {name: [] for name in rows})
            for name, value in rows.items():
                self._now.steps[name].append(np.asarray(value))

    def _on_end(self, env: int, record: Record) -> None:
        with self._lock:
            assert self._now is not None
            self._now.outcome = "success" if record.success else record.reason
        # The end stays on show for a moment.
        self._due = time.monotonic() + 1.0

    def _wait(self) -> None:
        """Hold while paused, and until the step is due."""
        while True:
            if self._stop.is_set():
                raise _Closed
            left = self._due - time.monotonic()
            if not self.paused and left <= 0:
                break
            time.sleep(0.02 if self.paused else min(left, 0.1))
        self._due = time.monotonic() + self.period / self.speed

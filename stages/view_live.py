"""Live policies for `wbm view`: a student, a teacher or a bundle in closed loop, as the viewer follows it."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from stages.config import Config
    from wbm.artifacts.mcap_io import EpisodeTracks, Solid
    from wbm.artifacts.store import Artifact, Store
    from wbm.learning.live import LiveEpisode, LivePolicy


def start_policy(artifact: Artifact, store: Store, cfg: Config) -> LivePolicy:
    """Run the policy of an artifact as `wbm evaluate` would, one episode after the other.

    Args:
        artifact: a student, a teacher or a bundle.
        store: where its assets are.
        cfg: the environment, the sensors and the protocol (`evaluation.split`, `start`, `condition`, `seed`).

    Raises:
        ValueError: its assets are not there, or the policy does not fit the configuration.
    """
    from wbm.envs.world import WorldConfig
    from wbm.learning.evaluation import BlockJob
    from wbm.learning.live import LivePolicy

    e = cfg.evaluation
    job = BlockJob(
        first=0,
        count=1,
        folder=Path(tempfile.gettempdir()),
        assets=_assets_of(artifact, store).path,
        policy=artifact.path,
        kind=artifact.manifest.kind,
        world=WorldConfig(cfg.robot, cfg.sim, cfg.wbc, cfg.env),
        sensors=cfg.sensors,
        split=e.split,
        start=e.start,
        condition=e.condition,
        num_envs=1,
        record=0,
        seed=cfg.seed + e.seed,
    )
    live = LivePolicy(job)
    live.start()
    return live


def _assets_of(artifact: Artifact, store: Store) -> Artifact:
    """The assets that a policy or what it was learnt from was made with, else the newest."""
    waiting = [artifact]
    while waiting:
        for given in waiting.pop(0).manifest.inputs.values():
            found = store.resolve(given.ref)
            if found.manifest.kind == "assets":
                return found
            waiting.append(found)
    return store.resolve("assets/main")


class WatchedPolicy:
    """A live policy's episodes as tracks; what is known of an episode is kept, so that a poll costs its new steps."""

    def __init__(self, policy: LivePolicy) -> None:
        self.policy = policy
        self._known: LiveEpisode | None = None
        self._fixed: tuple[Solid, ...] = ()

    def set_pace(self, paused: bool, speed: float) -> None:
        """Hold or go on, at `speed` times real time."""
        self.policy.paused, self.policy.speed = paused, speed

    def poll(self) -> tuple[int, EpisodeTracks, np.ndarray] | None:
        """Number, tracks so far and target mask of the present episode.

        Raises:
            ValueError: the policy has failed.
        """
        if self.policy.error:
            raise ValueError(self.policy.error)
        known = self._known
        news = self.policy.episode(known.number, len(known)) if known else self.policy.episode()
        if news is None:
            return None
        if known is None or known.number != news.number:
            self._known, self._fixed = news, self._solids(news.scene_row)
        else:
            for name, rows in news.steps.items():
                known.steps[name] += rows
            known.outcome = news.outcome
        assert self._known is not None
        return self._known.number, self._tracks(self._known), np.stack(self._known.steps["depth_target"])

    def _solids(self, row: int) -> tuple[Solid, ...]:
        from wbm.report.tracks import scene_solids

        return scene_solids(self.policy.world.assets, row)

    def _tracks(self, episode: LiveEpisode) -> EpisodeTracks:
        from wbm.artifacts.mcap_io import EpisodeTracks

        rows: dict[str, Any] = {name: np.stack(values) for name, values in episode.steps.items()}
        times = np.arange(len(episode)) * self.policy.period
        objects = [c for c, index in enumerate(self.policy.world.assets.scenes.object[episode.scene_row]) if index >= 0]
        fixed = len(self._fixed) - len(objects)
        moving = [
            replace(solid, pos=rows["poses"][:, c, :3], quat=rows["poses"][:, c, 3:])
            for c, solid in zip(objects, self._fixed[fixed:], strict=True)
        ]
        log = [(0.0, f"episode {episode.number}: {episode.instruction}")]
        changes = np.flatnonzero(np.diff(rows["phase"])) + 1
        log += [
            (times[k], f"{episode.instruction}: {'contact' if rows['phase'][k] else 'free space'}") for k in changes
        ]
        if episode.outcome:
            log.append((float(times[-1]), f"{episode.instruction}: {episode.outcome}"))
        return EpisodeTracks(
            times=times,
            q=rows["q"].astype(np.float64),
            action=rows["command"].astype(np.float64),
            camera=(rows["depth_xyz"], rows["depth_rgb"], rows["depth_valid"]),
            lidar=(rows["lidar_xyz"], rows["lidar_valid"]),
            solids=(*self._fixed[:fixed], *moving),
            log=tuple(log),
        )

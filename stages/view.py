"""`wbm view`: rollouts, an evaluation's episodes, a live policy, the scenes of assets, or the robot in a browser."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wbm.artifacts.errors import Missing

if TYPE_CHECKING:
    from wbm.artifacts.manifest import Artifact, Manifest
    from wbm.artifacts.store import Store
    from wbm.report.viewer import Shown
    from wbm.robot.model import RobotModel

ROBOT = "robot"
_EPISODE_FOLDERS = ("shards", "episodes")
_POLICIES = ("student", "teacher", "bundle")
_VIEWABLE = ("evaluation", "student", "rollouts", "assets")  # what `wbm view reference` looks for, in this order
_MAX_SHOWN = 200


def view(items: Sequence[str], port: int = 8080) -> None:
    """Serve what `items` names (an artifact or `robot`, and overrides) until interrupted.

    Raises:
        ArtifactError: no such artifact.
        ValueError: it holds nothing that can be looked at.
    """
    from stages.commands import composer
    from stages.commands_artifacts import split
    from wbm.report.viewer import Shown, Viewer
    from wbm.robot.model import load_robot
    from wbm.scenes.assets import robot_of

    store, names = split(items, count=1)
    policy = None
    if names[0] == ROBOT:
        robot = load_robot(composer([item for item in items if "=" in item]).robot.facts)
        shown = robot_items(robot)
    else:
        artifact = store.resolve(names[0], _VIEWABLE)
        world = _assets_of(artifact.manifest, store)
        made_for = artifact if artifact.manifest.kind == "assets" else world
        robot = robot_of(made_for.path) if made_for else load_robot()
        if artifact.manifest.kind in _POLICIES:
            from stages.view_live import WatchedPolicy, start_policy

            sys.stderr.write(f"{names[0]}: building its environment and sensors\n")
            policy = start_policy(artifact, store, composer([item for item in items if "=" in item]))
            shown = [Shown(artifact.manifest.ref, live=WatchedPolicy(policy))]
        else:
            shown = items_of(artifact.path, artifact.manifest.kind, world.path if world else None)
    viewer = Viewer(shown, port, robot)
    sys.stderr.write(f"{viewer.address} shows {names[0]} ({len(shown)} to choose from); Ctrl+C ends\n")
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        return
    finally:
        viewer.close()
        if policy:
            policy.close()


def _assets_of(manifest: Manifest, store: Store) -> Artifact | None:
    """The assets that an artifact was made with; None when they are gone."""
    for ref in (r.ref for r in manifest.inputs.values() if r.ref.startswith("assets/")):
        try:
            return store.resolve(ref)
        except Missing:
            sys.stderr.write(f"{ref} is not here any more: supports and other objects are not drawn\n")
    return None


def robot_items(robot: RobotModel | None = None) -> list[Shown]:
    """The robot alone."""
    from wbm.report.tracks import robot_tracks
    from wbm.report.viewer import Shown

    return [Shown(ROBOT, lambda: robot_tracks(robot))]


def items_of(path: Path, kind: str, assets: Path | None = None) -> list[Shown]:
    """What an artifact has to show.

    Args:
        path: its folder.
        kind: its kind.
        assets: folder of the assets that it was made with, to draw supports and objects.

    Raises:
        ValueError: nothing.
    """
    if kind == "assets":
        shown = _scene_items(path)
    else:
        folder = next((path / f for f in _EPISODE_FOLDERS if list((path / f).glob("shard-*.json"))), None)
        shown = _episode_items(folder, assets) if folder else []
    if not shown:
        raise ValueError(
            f"{kind} at {path} holds no episodes and no scenes to view; try rollouts, evaluation, assets or robot"
        )
    return shown


def _scene_items(path: Path) -> list[Shown]:
    from wbm.report.gallery import gallery_tracks
    from wbm.report.tracks import scene_tracks
    from wbm.report.viewer import Shown
    from wbm.scenes.assets import load_assets

    assets = load_assets(path)

    def shown(k: int) -> Shown:
        target = assets.objects.name[assets.scenes.object[k, 0]]
        return Shown(f"scene {k}: {target}", lambda: scene_tracks(assets, k))

    gallery = Shown(f"objects ({len(assets.objects)})", lambda: gallery_tracks(assets))
    return [*(shown(k) for k in range(min(len(assets.scenes), _MAX_SHOWN))), gallery]


def _episode_items(folder: Path, assets_path: Path | None) -> list[Shown]:
    import numpy as np

    from wbm.artifacts.episode_reader import EpisodeReader, shard_paths
    from wbm.artifacts.mcap_io import EpisodeTracks, Solid
    from wbm.report.tracks import episode_tracks, scene_solids, target_marker
    from wbm.report.viewer import Shown
    from wbm.scenes.assets import load_assets

    assets = load_assets(assets_path) if assets_path else None

    def solids(episode: dict[str, Any]) -> tuple[Solid, ...]:
        target = np.asarray(episode["p_obj_w"], dtype=np.float64)
        scene = str(episode["scene"]).rpartition("/")[2]  # rollouts write the kind of support before the row
        if assets is None or not scene.isdigit() or int(scene) >= len(assets.scenes):
            return (target_marker(target),)
        return scene_solids(assets, int(scene), target)

    def shown(reader: EpisodeReader, number: int, label: str) -> Shown:
        def load() -> EpisodeTracks:
            episode = reader.read_episode(number)
            return episode_tracks(episode, solids(episode))

        info = reader.episodes[number]
        mask = reader.read(info.first, info.first + info.length, ("depth_target",))["depth_target"]
        return Shown(label, load, target_mask=mask)

    result: list[Shown] = []
    for path in shard_paths(folder):
        reader = EpisodeReader(path)
        for number, info in enumerate(reader.episodes[: _MAX_SHOWN - len(result)]):
            outcome = "success" if info.success else "failure"
            result.append(shown(reader, number, f"{len(result)}: {info.object}, {outcome}, seed {info.seed}"))
    return result

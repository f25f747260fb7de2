"""Stage prepare-assets: objects, scenes and instructions, drawn, settled, embedded and pictured."""

from __future__ import annotations

from typing import Any

KIND = "assets"
SECTIONS = ("seed", "robot", "objects", "scenes")
INPUTS = ()


def name(cfg: Any) -> str:
    """Artifacts are named after the source of their objects."""
    return cfg.objects.source


def outside(cfg: Any) -> dict[str, str]:
    """Digests of the robot's facts and of the meshes, where the user brings them.

    Raises:
        OSError: a file or folder cannot be read.
        ValueError: the folder holds no meshes.
    """
    found = {}
    if cfg.robot.facts:
        from wbm.artifacts.digest import digest_bytes
        from wbm.robot.facts import read_facts

        found["robot.facts"] = digest_bytes(read_facts(cfg.robot.facts))
    if cfg.objects.source != "procedural":
        from wbm.scenes.sources import sources_digest

        found["objects"] = sources_digest(cfg.objects)
    return found


def run(cfg: Any, inputs: dict[str, Any], draft: Any, progress: Any) -> None:
    """Write `objects.npz`, `scenes.npz`, `instructions.npz`, `report.json`, the robot's MJCF and two contact sheets.

    Args:
        cfg: reads `cfg.robot`, `cfg.objects`, `cfg.scenes` and `cfg.seed`.
        inputs: none.
        draft: the artifact being written.
        progress: offers `track`.
    """
    from wbm.robot.export import export_robot
    from wbm.scenes.assets import Assets
    from wbm.scenes.encoder import SentenceEncoder
    from wbm.scenes.generate import generate_scenes
    from wbm.scenes.instructions import Texts, write_instructions
    from wbm.scenes.model import SceneModel, SceneModelConfig
    from wbm.scenes.pictures import object_sheet, scene_sheet
    from wbm.scenes.sources import collect_objects

    objects, report = collect_objects(cfg.objects, cfg.seed, lambda jobs: progress.track(jobs, "objects"))
    model = SceneModel(objects, SceneModelConfig(num_distractors=cfg.scenes.num_distractors), cfg.robot)
    bank = generate_scenes(model, cfg.scenes, cfg.seed, lambda jobs: progress.track(jobs, "scenes"))
    bank, sentences = write_instructions(objects, bank, cfg.seed)
    texts = Texts(sentences, SentenceEncoder(cfg.scenes.encoder)(sentences.tolist()))

    assets = Assets(objects, bank, texts, model.robot)
    assets.save(draft.path, report)
    export_robot(draft.path / "robot.xml", cfg.robot)
    object_sheet(objects, draft.path / "objects.png")
    scene_sheet(assets, draft.path / "scenes.png")
    draft.metrics |= {
        "objects": len(objects),
        "objects_skipped": len(report["skipped"]),
        "hulls": objects.num_hulls,
        "scenes": len(bank),
        "instructions": len(sentences),
        **{f"objects_{split}": int((objects.split == split).sum()) for split in ("train", "val", "test")},
        **{f"scenes_{split}": int((bank.split == split).sum()) for split in ("train", "val", "test")},
    }

"""deploy-export: pack the student into a bundle that a robot can trust."""

from __future__ import annotations

from typing import Any

KIND = "bundle"
SECTIONS = ("deploy",)
INPUTS = ("student", "assets", "evaluation")


def name(cfg: Any) -> str:
    """Name of the artifact."""
    return "main"


def run(cfg: Any, inputs: Any, draft: Any, progress: Any) -> None:
    """Export to ONNX; write contract, golden vectors and sentences; check all of it on the finished file."""
    from stages.deploy_golden import golden_observations, normalisers, rollout_parity
    from wbm.deploy.bundle import Bundle, write_bundle
    from wbm.deploy.contract import make_contract
    from wbm.deploy.instructions import InstructionCache
    from wbm.deploy.loop import measure_latency
    from wbm.deploy.probe import Probe
    from wbm.deploy.runtime import PolicyRuntime
    from wbm.learning.export import export_onnx
    from wbm.learning.student import load_student
    from wbm.scenes.assets import load_assets

    # Open the inputs
    policy = load_student(inputs["student"].path)
    assets = load_assets(inputs["assets"].path)
    schema = policy.schema

    # Export
    with progress.task("export", total=3) as task:
        onnx = export_onnx(policy)
        task.update(1)

        # Golden vectors: real observations of the evaluation, then edge cases; answers by torch
        golden = golden_observations(schema, inputs["evaluation"].path, cfg.deploy.num_golden)
        answers = policy.act(golden).cpu().numpy()

        # Publish
        sentences = dict(zip(map(str, assets.texts.sentence), assets.texts.embedding, strict=True))
        path = write_bundle(
            draft.path / "policy.wbm",
            onnx=onnx,
            contract=make_contract(
                assets.robot, schema, cfg.deploy, inputs["student"].manifest.name, normalisers(policy)
            ),
            golden_inputs=golden,
            golden_action=answers,
            instructions=InstructionCache(sentences, schema.text_dim),
            provenance={slot: _source(artifact.manifest) for slot, artifact in sorted(inputs.items())},
            sign_key=cfg.deploy.sign_key or None,
        )
        task.update(1)

        # Check the finished file, as a robot would
        bundle = Bundle.open(path)
        facts = bundle.verify()
        gaps = rollout_parity(policy, bundle.policy(), inputs["evaluation"].path)
        replayed = None if gaps is None else float(gaps.max())
        if replayed is not None and replayed > cfg.deploy.parity_tolerance:
            raise ValueError(
                f"on a replayed episode the bundle differs from torch by {replayed:.2g}, "
                f"allowed {cfg.deploy.parity_tolerance:.2g}"
            )
        latency = measure_latency(PolicyRuntime(bundle), Probe(bundle.contract), steps=200, warmup=20)
        task.update(1)

    draft.metrics |= {
        "parity": facts["parity"],
        "p99_ms": round(1e3 * latency["wall_p99_s"], 2),
        "bundle_mb": round(path.stat().st_size / 1e6, 2),
        "instructions": facts["num_instructions"],
        "parity_rollout": replayed,
        "jitter_ms": round(1e3 * latency["jitter_s"], 3),
        "digest": facts["digest"],
    }


def _source(manifest: Any) -> dict[str, Any]:
    """What traces an input; no times and no host names, so that equal inputs give equal bundles."""
    numbers = {k: v for k, v in manifest.metrics.items() if isinstance(v, (int, float)) and not k.endswith("seconds")}
    return {"ref": manifest.ref, "content_digest": manifest.content_digest, "metrics": numbers}

"""The student as ONNX (opset 18, dynamic batch), and the proof that it computes the same."""

from __future__ import annotations

import io
import logging
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from wbm.learning.student import Student, StudentPolicy
from wbm.robot.schema import PolicySchema

OPSET = 18
PARITY = 1e-5
OUTPUTS = ("action", "p_obj_b", "action_chunk")


class _Exported(nn.Module):
    """The network with positional inputs in the schema's order, and actions clipped to the schema's limit."""

    def __init__(self, network: Student) -> None:
        super().__init__()
        self.network = network
        self.names = [f.name for f in network.schema.observation]

    def forward(self, *fields: Tensor) -> tuple[Tensor, ...]:
        out = self.network(dict(zip(self.names, fields, strict=True)))
        limit = self.network.schema.action.limit
        chunk = out["action"].clamp(-limit, limit)
        single = (chunk[:, 0], out["p_obj_b"])
        return (*single, chunk) if self.network.cfg.chunk > 1 else single


def export_onnx(policy: StudentPolicy, path: str | Path | None = None) -> bytes:
    """The policy as one self-contained ONNX file.

    Inputs are the schema's fields by name and type, with the batch as their first axis. Outputs are "action"
    [batch,32], "p_obj_b" [batch,3], and "action_chunk" [batch,k,32] where the student predicts k > 1 actions.

    Args:
        policy: what to export.
        path: file to write; None to write none.

    Returns:
        The file's bytes.

    Raises:
        ValueError: ONNX Runtime's answers differ from torch's by more than 1e-5.
    """
    import onnx

    network = policy.network
    network.to("cpu").eval()
    try:
        example = random_observation(network.schema, 2, seed=0)
        outputs = OUTPUTS if network.cfg.chunk > 1 else OUTPUTS[:2]
        batch = torch.export.Dim("batch", min=1, max=65536)
        with warnings.catch_warnings(), _quiet():
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                _Exported(network).eval(),
                tuple(torch.from_numpy(a) for a in example.values()),
                input_names=list(example),
                output_names=list(outputs),
                opset_version=OPSET,
                dynamic_shapes=(tuple({0: batch} for _ in example),),
                dynamo=True,
                verbose=False,
            )
        stream = io.BytesIO()
        assert program is not None
        model = program.model_proto
        del model.metadata_props[:]
        for node in model.graph.node:  # file names and line numbers of the machine that exported
            del node.metadata_props[:]
            node.doc_string = ""
        onnx.save(model, stream)
        data = stream.getvalue()
        error = check_parity(StudentPolicy(network), data)
    finally:
        network.to(policy.device)
    if error > PARITY:
        raise ValueError(f"the exported student differs from torch by {error:.1e}, more than {PARITY:.0e}")
    if path is not None:
        Path(path).write_bytes(data)
    return data


def check_parity(policy: StudentPolicy, model: bytes, num: int = 32, seed: int = 1) -> float:
    """Largest difference in any output between torch and ONNX Runtime, over random observations and empty clouds."""
    session = make_session(model)
    names = [o.name for o in session.get_outputs()]
    worst = 0.0
    for size in (1, num):
        obs = random_observation(policy.schema, size, seed)
        expected = policy.predict(obs)
        expected = {
            "action": expected["action"][:, 0],
            "action_chunk": expected["action"],
            "p_obj_b": expected["p_obj_b"],
        }
        for name, value in zip(names, session.run(names, obs), strict=True):
            worst = max(worst, float(np.abs(value - expected[name].cpu().numpy()).max()))
    return worst


def make_session(model: bytes, threads: int = 1):
    """An ONNX Runtime session on the CPU."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def random_observation(schema: PolicySchema, num: int, seed: int) -> dict[str, np.ndarray]:
    """Observations [num, ...] of the right types; the last one has empty clouds, no mask and no instruction."""
    rng = np.random.default_rng(seed)
    obs: dict[str, np.ndarray] = {}
    for item in schema.observation:
        shape = (num, *item.shape)
        if item.dtype == "uint8":
            obs[item.name] = rng.integers(0, 256 if item.name.endswith("_rgb") else 2, shape).astype(np.uint8)
        else:
            scale = 0.05 if item.name == "text" else 0.5
            obs[item.name] = (scale * rng.standard_normal(shape)).astype(np.float32)
    for name in ("depth_valid", "depth_target", "lidar_valid", "text"):
        obs[name][-1] = 0
    return obs


class _quiet:
    """Keeps the exporter's log lines off the terminal."""

    def __enter__(self) -> None:
        self._loggers = [logging.getLogger(n) for n in ("torch.onnx", "onnxscript", "onnx_ir")]
        self._levels = [logger.level for logger in self._loggers]
        for logger in self._loggers:
            logger.setLevel(logging.ERROR)

    def __exit__(self, *_: object) -> None:
        for logger, level in zip(self._loggers, self._levels, strict=True):
            logger.setLevel(level)

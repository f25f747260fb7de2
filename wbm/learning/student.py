"""The student: one transformer over tokens of an observation, for all 32 joints (paper, section D)."""

# torch types registered buffers as Tensor | Module.
# pyright: reportCallIssue=false

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from wbm.learning.student_config import StudentConfig
from wbm.learning.tokens import Tokenizer
from wbm.robot import joints
from wbm.robot.schema import PolicySchema

WEIGHTS_FILE = "student.safetensors"
SPEC_FILE = "student.json"
SPEC_VERSION = 1
_GROUPS = tuple(joints.GROUPS.items())


class Layer(nn.Module):
    """Pre-norm transformer layer: attention over all tokens, then a feed-forward block."""

    def __init__(self, cfg: StudentConfig) -> None:
        super().__init__()
        self.heads = cfg.heads
        self.norm_attention = nn.LayerNorm(cfg.width)
        self.qkv = nn.Linear(cfg.width, 3 * cfg.width)
        self.out = nn.Linear(cfg.width, cfg.width)
        self.norm_feedforward = nn.LayerNorm(cfg.width)
        self.feedforward = nn.Sequential(
            nn.Linear(cfg.width, cfg.feedforward), nn.ReLU(), nn.Linear(cfg.feedforward, cfg.width)
        )

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens [B,K,width] to tokens of the same shape."""
        qkv = self.qkv(self.norm_attention(tokens)).unflatten(-1, (3, self.heads, -1)).transpose(1, 3)
        q, k, v = qkv.unbind(2)  # each [B,heads,K,width/heads]
        attended = nn.functional.scaled_dot_product_attention(q, k, v)
        tokens = tokens + self.out(attended.transpose(1, 2).flatten(2))
        return tokens + self.feedforward(self.norm_feedforward(tokens))


class Student(nn.Module):
    """pi_theta(o_t) of equation (8), with auxiliary heads.

    Args:
        schema: names and shapes of inputs and actions.
        cfg: sizes.
    """

    def __init__(self, schema: PolicySchema, cfg: StudentConfig) -> None:
        super().__init__()
        self.schema = schema
        self.cfg = cfg
        self.tokenizer = Tokenizer(schema, cfg)
        self.queries = nn.Parameter(0.02 * torch.randn(len(_GROUPS), cfg.width))
        self.layers = nn.ModuleList(Layer(cfg) for _ in range(cfg.layers))
        self.norm = nn.LayerNorm(cfg.width)
        self.heads = nn.ModuleList(
            nn.Sequential(
                nn.Linear(cfg.width, cfg.width),
                nn.ReLU(),
                nn.Linear(cfg.width, cfg.chunk * len(range(*group.indices(schema.action.size)))),
            )
            for _, group in _GROUPS
        )
        self.p_obj = nn.Linear(cfg.width, 3)
        nn.init.zeros_(self.p_obj.weight)  # starts at the centroid of the selected points
        nn.init.zeros_(self.p_obj.bias)

    def forward(self, obs: dict[str, Tensor]) -> dict[str, Tensor]:
        """Actions and what the auxiliary heads see.

        Args:
            obs: the schema's observation fields, [N, ...].

        Returns:
            "action" [N, chunk, 32]; "p_obj_b" [N,3], the target in the base frame [m]; "target_logit" [N,P].
        """
        tokens, logits, centroid = self.tokenizer(obs)
        queries = self.queries.unsqueeze(0).expand(tokens.shape[0], -1, -1)
        tokens = torch.cat([queries, tokens], dim=1)
        for layer in self.layers:
            tokens = layer(tokens)
        out = self.norm(tokens[:, : len(_GROUPS)])
        parts = [head(out[:, i]).unflatten(-1, (self.cfg.chunk, -1)) for i, head in enumerate(self.heads)]
        return {
            "action": torch.cat(parts, dim=-1),
            "p_obj_b": centroid + self.p_obj(out[:, 1]),  # the arm's query needs it most
            "target_logit": logits,
        }

    @torch.no_grad()
    def set_normalizers(self, statistics: Mapping[str, np.ndarray]) -> None:
        """Fill the input normalisers from `EpisodeDataset.statistics`; spreads are floored so that none blows up."""
        tokenizer = self.tokenizer
        tokenizer.proprio_mean.copy_(torch.as_tensor(statistics["proprio_mean"]))
        tokenizer.proprio_std.copy_(torch.as_tensor(np.maximum(statistics["proprio_std"], 0.02)))
        tokenizer.prev_action_std.copy_(torch.as_tensor(np.maximum(statistics["prev_action_std"], 0.05)))
        tokenizer.centre_b.copy_(torch.as_tensor(statistics["p_obj_b_mean"]))


class StudentPolicy:
    """A trained student, ready to act.

    Attributes:
        network: the module, in evaluation mode.
        schema: of observations and actions.
    """

    def __init__(self, network: Student, device: str | torch.device = "cpu") -> None:
        self.network = network.to(device).eval()
        self.schema = network.schema
        self.device = torch.device(device)

    def act(self, obs: Mapping[str, Any]) -> Tensor:
        """Actions [N,32], clipped to the schema's limit, of an observation of arrays or tensors [N, ...]."""
        return self.act_chunk(obs)[:, 0]

    def act_chunk(self, obs: Mapping[str, Any]) -> Tensor:
        """Actions [N,chunk,32] of now and of the steps that follow."""
        return self.predict(obs)["action"]

    @torch.inference_mode()
    def predict(self, obs: Mapping[str, Any]) -> dict[str, Tensor]:
        """Everything that the network gives, see `Student.forward`, with actions clipped to the limit.

        Raises:
            ValueError: names the first field that is missing, unknown or misshapen.
        """
        tensors = {k: torch.as_tensor(v).to(self.device) for k, v in obs.items()}
        check_shapes(self.schema, tensors)
        out = self.network(tensors)
        limit = self.schema.action.limit
        return {**out, "action": out["action"].clamp(-limit, limit)}


def check_shapes(schema: PolicySchema, obs: Mapping[str, Tensor]) -> None:
    """Check an observation's names and shapes without touching its values (`schema.check` also looks for NaN).

    Raises:
        ValueError: names the first field that is missing, unknown or misshapen.
    """
    expected = {f.name: f.shape for f in schema.observation}
    for name in obs:
        if name not in expected:
            raise ValueError(f"observation field {name!r} is not in the schema; expected {sorted(expected)}")
    for name, shape in expected.items():
        if name not in obs:
            raise ValueError(f"observation field {name!r} is missing")
        if tuple(obs[name].shape[1:]) != shape:
            raise ValueError(f"observation field {name!r} has shape {tuple(obs[name].shape[1:])}, expected {shape}")


def save_student(path: str | Path, network: Student, extra: Mapping[str, Any] | None = None) -> None:
    """Write weights (safetensors) and the specification (JSON: schema, sizes, `extra`) into a folder."""
    folder = Path(path)
    folder.mkdir(parents=True, exist_ok=True)
    tensors = {k: v.detach().to("cpu", torch.float32).contiguous() for k, v in network.state_dict().items()}
    save_file(tensors, folder / WEIGHTS_FILE)
    spec = {
        "version": SPEC_VERSION,
        "schema": network.schema.to_dict(),
        "config": asdict(network.cfg),
        "parameters": count_parameters(network),
        **(extra or {}),
    }
    (folder / SPEC_FILE).write_text(json.dumps(spec, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def load_student(path: str | Path, device: str | torch.device = "cpu") -> StudentPolicy:
    """The student in a folder.

    Raises:
        FileNotFoundError: there is none.
        ValueError: another version or schema, or weights that do not fit.
    """
    folder = Path(path)
    if not (folder / SPEC_FILE).is_file():
        raise FileNotFoundError(f"{folder} holds no student ({SPEC_FILE}); run distill")
    spec = json.loads((folder / SPEC_FILE).read_text(encoding="utf-8"))
    if spec.get("version") != SPEC_VERSION:
        raise ValueError(f"{folder / SPEC_FILE} has version {spec.get('version')}, this version reads {SPEC_VERSION}")
    schema = PolicySchema.from_dict(spec["schema"])
    try:
        network = Student(schema, StudentConfig(**spec["config"]))
        network.load_state_dict(load_file(folder / WEIGHTS_FILE))
    except (RuntimeError, TypeError, SafetensorError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"{folder / WEIGHTS_FILE} does not fit its specification: {reason}") from error
    return StudentPolicy(network, device)


def count_parameters(network: nn.Module) -> int:
    """Number of trained values."""
    return sum(p.numel() for p in network.parameters())

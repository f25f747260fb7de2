"""A trained teacher as files: safetensors weights and a JSON specification, loadable without rsl_rl."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import torch
from safetensors.torch import load_file, save
from torch import Tensor, nn

WEIGHTS, SPEC = "policy.safetensors", "policy.json"
SPEC_VERSION = 1
_ACTIVATIONS = {"elu": nn.ELU, "relu": nn.ReLU, "tanh": nn.Tanh, "silu": nn.SiLU}


@dataclass(frozen=True)
class TeacherSpec:
    """What a teacher expects and answers.

    Attributes:
        name: the teacher's name.
        grasp: `top_down` or `side`.
        obs_labels: names of the observation's entries, in order.
        action_labels: names of the action's entries, in order.
        action: settings of the action term (see `ActionConfig`).
        hidden: widths of the hidden layers.
        activation: hidden activation.
        period_s: time of one step, s.
        version: of this format.
    """

    name: str
    grasp: str
    obs_labels: tuple[str, ...]
    action_labels: tuple[str, ...]
    action: dict
    hidden: tuple[int, ...]
    activation: str
    period_s: float
    version: int = SPEC_VERSION


class TeacherPolicy(nn.Module):
    """The actor's mean: observations [N,O] to actions [N,A]."""

    def __init__(self, spec: TeacherSpec) -> None:
        super().__init__()
        self.spec = spec
        widths = (len(spec.obs_labels), *spec.hidden)
        layers: list[nn.Module] = []
        for before, after in pairwise(widths):
            layers += [nn.Linear(before, after), _ACTIVATIONS[spec.activation]()]
        self.mlp = nn.Sequential(*layers, nn.Linear(widths[-1], len(spec.action_labels)))

    @torch.no_grad()
    def forward(self, obs: Tensor) -> Tensor:
        return self.mlp(obs)


def save_teacher(path: Path, spec: TeacherSpec, actor_state: dict[str, Tensor]) -> None:
    """Write `policy.safetensors` and `policy.json` under `path`, each atomically.

    Args:
        actor_state: state of the actor as rsl_rl names it; only its `mlp` entries are kept.
    """
    path.mkdir(parents=True, exist_ok=True)
    weights = {k: v.detach().cpu().contiguous() for k, v in actor_state.items() if k.startswith("mlp.")}
    _write(path / WEIGHTS, save(weights))
    _write(path / SPEC, json.dumps(spec.__dict__, indent=1).encode())


def load_teacher(path: Path | str, device: str = "cpu") -> TeacherPolicy:
    """Load a teacher; the answer maps observations [N,O] to actions [N,A] and carries its `spec`.

    Raises:
        FileNotFoundError: no teacher there.
        ValueError: the specification is of another version, or does not match the weights.
    """
    path = Path(path)
    for name in (WEIGHTS, SPEC):
        if not (path / name).is_file():
            raise FileNotFoundError(f"no teacher at {path}: {name} is missing")
    data = json.loads((path / SPEC).read_text())
    if data.get("version") != SPEC_VERSION:
        raise ValueError(f"teacher at {path} has format {data.get('version')}; this version reads {SPEC_VERSION}")
    listed = {k: tuple(data[k]) for k in ("obs_labels", "action_labels", "hidden")}
    policy = TeacherPolicy(TeacherSpec(**{**data, **listed}))
    try:
        policy.load_state_dict(load_file(path / WEIGHTS, device=device))
    except RuntimeError as error:
        raise ValueError(f"teacher at {path}: weights do not match {SPEC}: {str(error).splitlines()[-1]}") from error
    return policy.to(device).eval()


def _write(path: Path, data: bytes) -> None:
    partial = path.with_name(path.name + ".partial")
    with open(partial, "wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(partial, path)

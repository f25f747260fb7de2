"""Several processes that train one policy: each steps its share of the environments, and all do the same update.

The ranks are numbered by torch.distributed's environment variables (RANK, WORLD_SIZE, MASTER_ADDR, ...), over NCCL on
GPUs and gloo on CPUs. R ranks with N environments each do what one process with R N environments does, up to the order
of additions: episodes are numbered, noise is drawn and minibatches are chosen over all ranks, from random numbers that
every rank draws alike.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any

import torch
from torch import Tensor
from torch import distributed as dist

from wbm.envs.grasp_env import GraspEnv

_PATIENCE = timedelta(hours=2)  # ranks wait for rank 0 while it evaluates
_SHARED = ("scene_weight",)  # parts of an environment's state that are not by environment


@dataclass
class Team:
    """The ranks. Alone (`size` 1), every operation is the identity and nothing is sent.

    Attributes:
        rank, size: this process among how many.
        device: of the tensors that are summed.
    """

    rank: int = 0
    size: int = 1
    device: str = "cpu"
    _host: Any = field(default=None, repr=False)

    @classmethod
    def join(cls, device: str) -> Team:
        """The team that the environment variables name; waits for all of its ranks."""
        size = int(os.environ.get("WORLD_SIZE", "1"))
        if size == 1:
            return cls(device=device)
        on_gpu = device.startswith("cuda")
        dist.init_process_group("nccl" if on_gpu else "gloo", timeout=_PATIENCE)
        host = dist.new_group(backend="gloo", timeout=_PATIENCE) if on_gpu else None
        return cls(dist.get_rank(), size, device, host)

    def leave(self) -> None:
        """Close the connections."""
        if self.size > 1:
            dist.destroy_process_group()

    @property
    def leads(self) -> bool:
        """Whether this rank writes the results."""
        return self.rank == 0

    def share(self, count: int) -> int:
        """This rank's part of `count` environments.

        Raises:
            ValueError: they cannot be divided evenly.
        """
        if count % self.size:
            raise ValueError(f"teacher.num_envs={count} cannot be divided among {self.size} processes")
        return count // self.size

    def rows(self, count: int) -> slice:
        """Rows of this rank where every rank holds `count`."""
        return slice(self.rank * count, (self.rank + 1) * count)

    def sum(self, values: Tensor) -> Tensor:
        """Sum over the ranks, as a new tensor where values came from."""
        if self.size == 1:
            return values
        total = values.to(self.device, copy=True)
        dist.all_reduce(total)
        return total.to(values.device)

    def any(self, flag: bool) -> bool:
        """Whether the flag is set on some rank."""
        return bool(self.sum(torch.tensor(float(flag))) > 0)

    def tell(self, values: list[float]) -> list[float]:
        """What rank 0 says."""
        if self.size == 1:
            return values
        sent = torch.tensor(values if self.leads else [0.0] * len(values), dtype=torch.float64)
        return self.sum(sent).tolist()

    def same_random(self) -> None:
        """Give all ranks the random state of rank 0, which drew some numbers alone."""
        if self.size > 1:
            state = torch.get_rng_state()
            dist.broadcast(state, 0, group=self._host)
            torch.set_rng_state(state)

    def numbers(self, count: int) -> tuple[int, int]:
        """Where `count` items of this rank stand among those of all ranks, in order of rank, and how many those are."""
        if self.size == 1:
            return 0, count
        counts = torch.zeros(self.size, dtype=torch.int64)
        counts[self.rank] = count
        counts = self.sum(counts)
        return int(counts[: self.rank].sum()), int(counts.sum())

    # The state of all environments as one: what one process with all of them would save

    def save_env(self, env: GraspEnv) -> dict | None:
        """State of the environments of all ranks on rank 0, None elsewhere."""
        state = env.state_dict()
        if self.size == 1:
            return state
        every: list[Any] = [None] * self.size
        dist.gather_object(_to_host(state), every if self.leads else None, group=self._host)
        return _join(every) if self.leads else None

    def load_env(self, env: GraspEnv, state: dict) -> None:
        """Restore this rank's rows of a state that `save_env` gathered, with whatever number of ranks."""
        env.load_state_dict(_rows(state, self.rows(env.num_envs)) if self.size > 1 else state)


def _to_host(state: Any) -> Any:
    if isinstance(state, dict):
        return {name: _to_host(value) for name, value in state.items()}
    return state.cpu() if isinstance(state, Tensor) else state


def _join(states: list[Any], name: str = "") -> Any:
    first = states[0]
    if isinstance(first, dict):
        return {key: _join([s[key] for s in states], key) for key in first}
    return torch.cat(states) if isinstance(first, Tensor) and name not in _SHARED else first


def _rows(state: Any, rows: slice, name: str = "") -> Any:
    if isinstance(state, dict):
        return {key: _rows(value, rows, key) for key, value in state.items()}
    return state[rows] if isinstance(state, Tensor) and name not in _SHARED else state

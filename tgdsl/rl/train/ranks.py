"""Processes that learn together, as torchrun starts them, each with separate environments.

A single process does nothing here. The backend is NCCL on GPUs and gloo on CPUs.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, distributed

from tgdsl.errors import TgdslError


class RankError(TgdslError):
    """Processes that cannot learn together."""


@dataclass(frozen=True)
class Ranks:
    """Rank of this process, from 0, and number of processes; `local`: its rank on this host, its GPU."""

    rank: int = 0
    size: int = 1
    local: int = 0

    @staticmethod
    def of(environ: Mapping[str, str] = os.environ) -> Ranks:
        """Return the ranks that torchrun sets."""
        return Ranks(
            *(int(environ.get(name, default)) for name, default in (("RANK", 0), ("WORLD_SIZE", 1), ("LOCAL_RANK", 0)))
        )

    @property
    def is_first(self) -> bool:
        """Whether this process writes files and progress."""
        return self.rank == 0

    @property
    def rsl_rl(self) -> dict[str, int] | None:
        """The value of rsl_rl's `multi_gpu`."""
        return {"global_rank": self.rank, "local_rank": self.local, "world_size": self.size} if self.size > 1 else None

    def device(self, device: str) -> str:
        """Return this process's device: "cuda" is one GPU each."""
        if self.size == 1 or device.partition(":")[0] != "cuda":
            return device
        if device != "cuda":
            raise RankError(f'device is "{device}", and {self.size} processes take a GPU each; expected "cuda"')
        return f"cuda:{self.local}"

    def join(self, device: str) -> None:
        """Join the process group, if there are other processes and this one has not joined."""
        if self.size == 1 or distributed.is_initialized():
            return
        is_gpu = device.partition(":")[0] == "cuda"
        if is_gpu:
            torch.cuda.set_device(device)
        distributed.init_process_group("nccl" if is_gpu else "gloo", rank=self.rank, world_size=self.size)

    def leave(self) -> None:
        """Leave the process group, if this process has joined."""
        if self.size > 1 and distributed.is_initialized():
            distributed.destroy_process_group()

    def agreed(self, choices: tuple[bool, ...], device: torch.device | str) -> tuple[bool, ...]:
        """Return the first process's choices."""
        if self.size == 1:
            return choices
        numbers = torch.tensor(choices, dtype=torch.int32, device=device)
        distributed.broadcast(numbers, src=0)
        return tuple(bool(each) for each in numbers.tolist())

    def gathered(self, own: Any) -> list[Any]:
        """Return each process's value, in all of them."""
        if self.size == 1:
            return [own]
        every: list[Any] = [None] * self.size
        distributed.all_gather_object(every, own)
        return every


def add_up(tensor: Tensor) -> None:
    """Replace a tensor by its sum over all processes, if there are several; the host does not wait."""
    if num_processes() > 1:
        distributed.all_reduce(tensor)


def num_processes() -> int:
    """Return how many processes there are."""
    is_joined = distributed.is_available() and distributed.is_initialized()
    return distributed.get_world_size() if is_joined else 1

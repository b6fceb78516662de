"""A student: groups of observations are normalised, each is embedded, and the embeddings are mapped to actions together.

While it is taught, heads tell privileged numbers from the embeddings.

Shapes: `env` environments, `feature` numbers of all groups, side by side, `memory` numbers that are remembered of an episode,
`joint` joints that the policy moves, `target` privileged numbers.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from tgdsl.rl.students.encoders import Encoder, mlp, network


@dataclass(frozen=True)
class Architecture:
    """All that students of one stack have in common.

    Attributes:
        groups: Size of each group of observations, and the network that embeds it.
        hidden: Widths of the hidden layers that follow the embeddings.
        actions: Number of joints.
        heads: Widths of the hidden layers of each decoder.
        eps: What is added to the standard deviation by which an observation is divided.
        clip: Bound of normalised observations.
    """

    groups: tuple[tuple[int, Encoder], ...]
    hidden: tuple[int, ...]
    actions: int
    heads: tuple[tuple[int, ...], ...] = ()
    eps: float = 1e-5
    clip: float = 10.0

    @property
    def num_features(self) -> int:
        """How many numbers a student takes."""
        return sum(size for size, _ in self.groups)


class Made(NamedTuple):
    """What a student makes of observations.

    Attributes:
        action: Actions.
        told: What the decoders tell.
        memory: What it remembers.
    """

    action: Tensor
    told: Tensor
    memory: Tensor


class Student(nn.Module):
    """A student.

    Attributes:
        architecture: Its networks.
        memory: How many numbers it remembers of an episode.
    """

    def __init__(self, architecture: Architecture):
        super().__init__()
        self.architecture = architecture
        self.register_buffer("mean", torch.zeros(architecture.num_features))
        self.register_buffer("var", torch.ones(architecture.num_features))
        encoders = [network(size, encoder) for size, encoder in architecture.groups]
        self.encoders, self.memory = nn.ModuleList(encoders), sum(encoder.memory for encoder in encoders)
        latent = sum(encoder.size for _, encoder in architecture.groups)
        self.trunk = mlp(latent, architecture.hidden, architecture.actions)
        self.decoders = nn.ModuleList([mlp(latent, hidden, 1) for hidden in architecture.heads])

    def forward(self, x: Tensor, memory: Tensor) -> Made:
        """Return actions and what else is made of observations."""
        latent, memory = self.embed(x, memory)
        decoded = torch.cat([x[:, :0], *(decoder(latent) for decoder in self.decoders)], dim=1)
        return Made(self.trunk(latent), decoded, memory)

    def act(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return actions and what is remembered, and nothing that is dropped at deployment."""
        latent, memory = self.embed(x, memory)
        return self.trunk(latent), memory

    def embed(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the embeddings of all groups, side by side, and what is remembered."""
        architecture = self.architecture
        mean, var = self.mean, self.var
        normal = ((x - mean) / (var.sqrt() + architecture.eps)).clamp(-architecture.clip, architecture.clip)  # pyright: ignore
        parts = normal.split([size for size, _ in architecture.groups], dim=1)
        held = memory.split([encoder.memory for encoder in self.encoders], dim=1)  # pyright: ignore
        embeddings = [encoder(*each) for encoder, *each in zip(self.encoders, parts, held, strict=True)]
        return torch.cat([each for each, _ in embeddings], dim=1), torch.cat([each for _, each in embeddings], dim=1)


class Acting(nn.Module):
    """The networks of a student as a function: of observations alone, (env, feature), if it remembers nothing."""

    def __init__(self, student: Student):
        super().__init__()
        self.student = student
        self.input_names = ("obs", "memory") if student.memory else ("obs",)
        self.output_names = ("actions", "next_memory") if student.memory else ("actions",)

    def forward(self, x: Tensor, memory: Tensor | None = None) -> Tensor | tuple[Tensor, Tensor]:
        """Return actions, and what is remembered."""
        if memory is None:
            return self.student.act(x, x.new_zeros((x.shape[0], 0)))[0]
        return self.student.act(x, memory)

    def get_dummy_inputs(self) -> tuple[Tensor, ...]:
        """Return an example of what it takes."""
        sizes = (self.student.architecture.num_features, self.student.memory)
        return tuple(torch.zeros((2, size)) for size in sizes[: len(self.input_names)])


RECURRENT = """
def forward(self, x: Tensor) -> Tensor:
    if self.memory.shape[0] != x.shape[0]:
        self.memory = x.new_zeros((x.shape[0], self.size))
    action, memory = self.acting(x, self.memory)
    self.memory = memory
    return action

def begin(self, ended: Tensor) -> None:
    if self.memory.shape[0] == ended.shape[0]:
        self.memory = self.memory.masked_fill(ended.to(self.memory.device).unsqueeze(1), 0.0)
"""
"""TorchScript of what remembers its episodes; `begin` has it forget those that have ended, (env,)."""


class Remembering(nn.Module):
    """The networks of a student with memory as TorchScript, and what it remembers."""

    def __init__(self, acting: torch.jit.ScriptModule, size: int):
        super().__init__()
        self.acting, self.size, self.memory = acting, size, torch.zeros((0, size))


def acting(student: Student) -> Acting:
    """Return a copy of a student on the CPU, without decoders; nor gradients, as memory would keep the graph of all steps."""
    student_copy = copy.deepcopy(student).cpu().eval().requires_grad_(False)
    student_copy.decoders = nn.ModuleList()
    return Acting(student_copy)


def deployed(network: Acting) -> torch.jit.ScriptModule:
    """Return a student as TorchScript, on the CPU."""
    with torch.no_grad():
        traced: torch.jit.ScriptModule = torch.jit.trace(network, network.get_dummy_inputs())  # pyright: ignore[reportAssignmentType]
        if network.student.memory == 0:
            return traced
        script: Any = torch.jit.script(Remembering(traced, network.student.memory))
        script.define(RECURRENT)
        return script


def forgotten(memory: Tensor, ended: Tensor) -> Tensor:
    """Return what is remembered, zeros where an episode has ended."""
    return torch.where(ended[..., None], 0.0, memory)

"""A student: groups of observations are normalised, each is embedded, and the embeddings are mapped to actions together.

A network that embeds a group takes (env, feature) and its memory, (env, memory), and returns the embedding and the next memory;
an episode begins with zeros. Images are built from the features, so a policy's inputs do not depend on its network. In
training, heads predict privileged numbers from the embeddings.

Students of one architecture are stacked: their weights are one tensor each, and they step together. A stack of N is N
separate trainings: each student has its own weights, normalisation, gradient norm and moments of Adam.

Shapes: `env` environments, `feature` numbers of all groups, concatenated, `memory` numbers of an episode's memory, `size` of an
embedding, `joint` joints that the policy moves, `target` privileged numbers, `student` students of a stack, `row` rows of each.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from rsl_rl.modules import MLP
from torch import Tensor, nn
from torch.func import functional_call, stack_module_state, vmap

from tgdsl.rl.students.gates import SCALE, Gates
from tgdsl.rl.train.model import Normalisation

Kind = Literal["mlp", "lstm", "cnn", "convrnn"]


@dataclass(frozen=True)
class Grid:
    """Places of taxels in the images of their links; grids smaller than the largest one fill a corner.

    Features are the `channels` numbers of a taxel: the first channel of all taxels, then the second. The shape is links, rows,
    columns; `taxels` has the taxel of each cell, −1 without one.
    """

    channels: int
    num_taxels: int
    shape: tuple[int, int, int]
    taxels: tuple[int, ...]


@dataclass(frozen=True)
class Encoder:
    """The network that embeds a group.

    `hidden` has the widths of an `mlp`'s hidden layers, the width of an `lstm`, or the channels of `cnn` and `convrnn`; `size`
    is the embedding's size, `kernel` the width of the kernels of images [taxel].
    """

    kind: Kind
    hidden: tuple[int, ...]
    size: int
    kernel: int = 3
    grid: Grid | None = None


def network(size: int, encoder: Encoder) -> Embedding:
    """Return the network that embeds a group of some size."""
    return {"mlp": Mlp, "lstm": Lstm, "cnn": Convolution, "convrnn": RecurrentConvolution}[encoder.kind](size, encoder)


class Embedding(nn.Module):
    """A network that embeds a group, with `memory` numbers of recurrent state."""

    memory: int = 0


class Mlp(Embedding):
    """Linear layers with ELU between them."""

    def __init__(self, size: int, encoder: Encoder):
        super().__init__()
        self.layers = MLP(size, encoder.size, encoder.hidden)

    def forward(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        return self.layers(x), memory


class Lstm(Embedding):
    """One layer of long short-term memory, and a projection.

    With i, f, g, o = W x + U h + b:  c ← σ(f) c + σ(i) tanh(g),  h ← σ(o) tanh(c).
    """

    def __init__(self, size: int, encoder: Encoder):
        super().__init__()
        width = encoder.hidden[-1]
        self.of_input, self.of_memory = nn.Linear(size, 4 * width), nn.Linear(width, 4 * width)
        self.projection, self.memory = nn.Linear(width, encoder.size), 2 * width

    def forward(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        h, c = memory.chunk(2, dim=1)
        h, c = gated(self.of_input(x) + self.of_memory(h), c)
        return self.projection(h), torch.cat([h, c], dim=1)


class Images(Embedding):
    """Base of networks on images: features as images of links, with a channel that marks taxels."""

    cells: Tensor
    mask: Tensor

    def __init__(self, grid: Grid):
        super().__init__()
        self.grid = grid
        cells = torch.tensor(grid.taxels).view(grid.shape)
        self.register_buffer("cells", cells.clamp(min=0), persistent=False)
        mask = (cells >= 0).to(torch.get_default_dtype())[:, None]  # 1 where there is a taxel
        self.register_buffer("mask", mask, persistent=False)

    def images(self, x: Tensor) -> Tensor:
        """Return images of all environments and links, 0 where there is no taxel."""
        by_channel = x.unflatten(1, (self.grid.channels, self.grid.num_taxels))
        return by_channel[:, :, self.cells.flatten()].unflatten(2, self.grid.shape).transpose(1, 2) * self.mask

    def marked(self, x: Tensor) -> Tensor:
        """Return the images of all links and environments, with the mask as the last channel."""
        mask = self.mask.expand(x.shape[0], -1, -1, -1, -1)
        return torch.cat([self.images(x), mask], dim=2).flatten(0, 1)


class Convolution(Images):
    """Convolutions, shared by all links, then a projection of all their features."""

    def __init__(self, size: int, encoder: Encoder):
        assert encoder.grid is not None
        super().__init__(encoder.grid)
        channels = (encoder.grid.channels + 1, *encoder.hidden)
        layers = (nn.Conv2d(a, b, encoder.kernel, padding=encoder.kernel // 2) for a, b in pairwise(channels))
        self.layers = nn.ModuleList(layers)
        self.projection = nn.Linear(channels[-1] * len(encoder.grid.taxels), encoder.size)

    def forward(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        images = self.marked(x)
        for layer in self.layers:
            images = nn.functional.elu(layer(images))
        images = images.unflatten(0, (x.shape[0], -1)) * self.mask
        return self.projection(images.flatten(1)), memory


class RecurrentConvolution(Images):
    """Long short-term memory whose products are convolutions, gates layer-normed per image; then a projection."""

    def __init__(self, size: int, encoder: Encoder):
        assert encoder.grid is not None
        super().__init__(encoder.grid)
        self.width, cells = encoder.hidden[0], len(encoder.grid.taxels)
        channels = encoder.grid.channels + 1 + self.width
        self.gates = nn.Conv2d(channels, 4 * self.width, encoder.kernel, padding=encoder.kernel // 2, bias=False)
        self.norm = nn.LayerNorm([4 * self.width, *encoder.grid.shape[1:]])
        self.projection, self.memory = nn.Linear(self.width * cells, encoder.size), 2 * self.width * cells

    def forward(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        links, *image = self.grid.shape
        state = memory.unflatten(1, (2, links, self.width, *image)).transpose(0, 1).flatten(1, 2)
        h, c = gated(self.norm(self.gates(torch.cat([self.marked(x), state[0]], dim=1))), state[1])
        state = torch.stack([h, c]).unflatten(1, (x.shape[0], links)) * self.mask
        return self.projection(state[0].flatten(1)), state.transpose(0, 1).flatten(1)


def gated(gates: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Return h and c after a step; gates i, f, g, o are concatenated along dimension 1."""
    i, f, g, o = gates.chunk(4, dim=1)
    c = f.sigmoid() * c + i.sigmoid() * g.tanh()
    return o.sigmoid() * c.tanh(), c


@dataclass(frozen=True)
class Architecture:
    """Networks that the students of one stack share."""

    groups: tuple[tuple[int, Encoder], ...]  # size of each group of observations, and the network that embeds it
    hidden: tuple[int, ...]  # widths of the hidden layers that follow the embeddings
    actions: int  # number of joints
    heads: tuple[tuple[int, ...], ...] = ()  # widths of the hidden layers of each decoder
    gates: tuple[int, int] | None = None  # the group whose taxels have gates, by its place, and the number of taxels
    eps: float = 1e-5  # offset of the standard deviation that normalises an observation
    clip: float = 10.0  # bound of normalised observations

    @property
    def num_features(self) -> int:
        """Number of features of all groups."""
        return sum(size for size, _ in self.groups)


class StudentOutput(NamedTuple):
    """Output of a student."""

    action: Tensor  # actions
    decoded: Tensor  # outputs of the decoders
    memory: Tensor  # next memory


class Student(nn.Module):
    """A student, with `memory` numbers of recurrent state."""

    mean: Tensor
    var: Tensor

    def __init__(self, architecture: Architecture):
        super().__init__()
        self.architecture = architecture
        self.register_buffer("mean", torch.zeros(architecture.num_features))
        self.register_buffer("var", torch.ones(architecture.num_features))
        encoders = [network(size, encoder) for size, encoder in architecture.groups]
        self.encoders, self.memory = nn.ModuleList(encoders), sum(encoder.memory for encoder in encoders)
        latent = sum(encoder.size for _, encoder in architecture.groups)
        self.trunk = MLP(latent, architecture.actions, architecture.hidden)
        self.decoders = nn.ModuleList([MLP(latent, 1, hidden) for hidden in architecture.heads])
        self.gates = Gates(architecture.gates[1]) if architecture.gates else None

    def forward(self, x: Tensor, memory: Tensor, noise: Tensor | None = None) -> StudentOutput:
        architecture = self.architecture
        normal = ((x - self.mean) / (self.var.sqrt() + architecture.eps)).clamp(-architecture.clip, architecture.clip)
        parts = list(normal.split([size for size, _ in architecture.groups], dim=1))
        if architecture.gates and self.gates is not None:
            place, _ = architecture.gates
            parts[place] = self.gates(parts[place], noise)
        memories = memory.split([encoder.memory for encoder in self.encoders], dim=1)  # pyright: ignore
        embeddings = [encoder(*each) for encoder, *each in zip(self.encoders, parts, memories, strict=True)]
        latent, memory = (torch.cat(each, dim=1) for each in zip(*embeddings, strict=True))
        decoded = torch.cat([x[:, :0], *(decoder(latent) for decoder in self.decoders)], dim=1)
        return StudentOutput(self.trunk(latent), decoded, memory)


class Acting(nn.Module):
    """The networks of a student as a function of observations, (env, feature), and of memory if it has any."""

    def __init__(self, student: Student):
        super().__init__()
        self.student = student
        self.input_names = ("obs", "memory") if student.memory else ("obs",)
        self.output_names = ("actions", "next_memory") if student.memory else ("actions",)

    def forward(self, x: Tensor, memory: Tensor | None = None) -> Tensor | tuple[Tensor, Tensor]:
        """Return actions, and the next memory if there is one."""
        output = self.student(x, x.new_zeros((x.shape[0], 0)) if memory is None else memory)
        return output.action if memory is None else (output.action, output.memory)

    def get_dummy_inputs(self) -> tuple[Tensor, ...]:
        """Return example inputs."""
        sizes = (self.student.architecture.num_features, self.student.memory)
        return tuple(torch.zeros((2, size)) for size in sizes[: len(self.input_names)])


RECURRENT = """
def forward(self, x: Tensor) -> Tensor:
    if self.memory.shape[0] != x.shape[0]:
        self.memory = x.new_zeros((x.shape[0], self.size))
    action, memory = self.student(x, self.memory)
    self.memory = memory
    return action

def begin(self, ended: Tensor) -> None:
    if self.memory.shape[0] == ended.shape[0]:
        self.memory = self.memory.masked_fill(ended.to(self.memory.device).unsqueeze(1), 0.0)
"""
"""TorchScript of a recurrent student; `begin` resets the memory of ended episodes, (env,)."""


class Deployed(nn.Module):
    """A traced student, and its memory of each environment's episode."""

    def __init__(self, student: torch.jit.ScriptModule, size: int):
        super().__init__()
        self.student, self.size, self.memory = student, size, torch.zeros((0, size))


def acting(student: Student) -> Acting:
    """Return a copy of a student on the CPU, without decoders and gradients: memory would retain the graph of all steps."""
    student_copy = copy.deepcopy(student).cpu().eval().requires_grad_(False)
    student_copy.decoders = nn.ModuleList()
    return Acting(student_copy)


def deployed(network: Acting) -> torch.jit.ScriptModule:
    """Return a student as TorchScript, on the CPU."""
    with torch.no_grad():
        traced: torch.jit.ScriptModule = torch.jit.trace(network, network.get_dummy_inputs())  # pyright: ignore[reportAssignmentType]
        if network.student.memory == 0:
            return traced
        script: Any = torch.jit.script(Deployed(traced, network.student.memory))
        script.define(RECURRENT)
        return script


def forgotten(memory: Tensor, ended: Tensor) -> Tensor:
    """Return the memory, with zeros where an episode has ended."""
    return torch.where(ended[..., None], 0.0, memory)


GATES = "gates.weight"  # name of the gates' weights among a student's
NORM_EPS = 1e-6  # offset of a norm in `torch.nn.utils.clip_grad_norm_`


class Stack:
    """Students of one architecture.

    `parameters` are their weights by name, (student, …); `buffers`, in the same way, means and variances that normalise their
    observations: copies of `moments`, float64 views of `seen`, (student, feature).
    """

    def __init__(
        self,
        architecture: Architecture,
        seeds: Sequence[int],
        learning_rate: float,
        max_grad_norm: float | None,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ):
        self.architecture, self.size = architecture, len(seeds)
        self._max_norm, self._rate = max_grad_norm, learning_rate
        if torch.device(device).type == "cuda":
            self._rate = torch.tensor(learning_rate, dtype=torch.float32, device=device)  # which a CUDA graph reads
        students = [seeded_student(architecture, seed).to(device, dtype) for seed in seeds]
        self.memory = students[0].memory
        self.parameters, self.buffers = stack_module_state(students)  # pyright: ignore[reportArgumentType]
        self.seen = Normalisation([self.size, architecture.num_features]).to(device)
        self.moments = {"mean": self.seen._mean[0], "var": self.seen._var[0]}
        self._shape = copy.deepcopy(students[0]).to("meta")
        self.optimiser = torch.optim.Adam(list(self.parameters.values()), **self._options())

    def __call__(
        self,
        x: Float[Tensor, "student row feature"],
        memory: Float[Tensor, "student row memory"],
        noise: Float[Tensor, "student taxel"] | None = None,
    ) -> StudentOutput:
        """Return each student's output for its rows: (student, row, …)."""
        called: Any = vmap(self._call, (0, 0, 0, 0, None if noise is None else 0))
        return StudentOutput(*called(self.parameters, self.buffers, x, memory, noise))

    @property
    def log_alpha(self) -> Float[Tensor, "student taxel"] | None:
        """Openness of the gates; None without gates."""
        return SCALE * self.parameters[GATES] if GATES in self.parameters else None

    def descend(self, losses: Float[Tensor, " student"]) -> None:
        """Take one step of Adam, each student by its loss."""
        weights = list(self.parameters.values())
        gradients = torch.autograd.grad(losses.sum(), weights)
        with torch.no_grad():
            if self._max_norm is not None:
                squares = torch.stack([gradient.flatten(1).square().sum(dim=1) for gradient in gradients])
                factor = (self._max_norm / (squares.sum(dim=0).sqrt() + NORM_EPS)).clamp(max=1.0)
                gradients = [gradient * factor.view(-1, *(1,) * (gradient.ndim - 1)) for gradient in gradients]
            for weight, gradient in zip(weights, gradients, strict=True):
                weight.grad = torch.empty_like(weight).copy_(gradient)  # Adam's fused kernel takes no others' strides
        self.optimiser.step()

    def set_rate(self, learning_rate: float) -> None:
        """Set Adam's learning rate from the next step on, also in a captured CUDA graph."""
        if isinstance(self._rate, Tensor):
            self._rate.fill_(learning_rate)
        else:
            self._rate = learning_rate
            self._rated()

    @torch.no_grad()
    def observe(self, x: Float[Tensor, "student row feature"]) -> None:
        """Update each student's mean and variance by rows, in place."""
        var, mean = torch.var_mean(x.double(), dim=1, correction=0)
        self.seen.merge(x.shape[1], mean, var)
        self._normalise()

    def student(self, index: int) -> Student:
        """Return a copy of one student, on the CPU."""
        student = Student(self.architecture)
        state = {name: value[index].detach().cpu() for name, value in (self.parameters | self.buffers).items()}
        student.load_state_dict({name: state[name] for name in student.state_dict()})
        return student

    def state_dict(self) -> dict[str, Any]:
        """Return the state for resuming: live tensors."""
        networks = {name: value.detach() for name, value in self.parameters.items()}
        seen = self.moments | {"rows": self.seen.count}
        return {"networks": networks, "seen": seen, "optimiser": self.optimiser.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from a saved state, with the stack's present learning rate."""
        current = self.state_dict()
        for part in ("networks", "seen"):
            if current[part].keys() != state[part].keys():
                raise RuntimeError(f"its {part} are {', '.join(state[part])}")
            for name, value in current[part].items():
                if (shape := state[part][name].shape) != value.shape:
                    raise RuntimeError(f"{name} is {tuple(shape)}, not {tuple(value.shape)}")
        with torch.no_grad():
            for part in ("networks", "seen"):
                for name, value in current[part].items():
                    value.copy_(state[part][name])
            self._normalise()
        optimiser = state["optimiser"]  # saved on another device perhaps, and at another rate; the options place its `step`
        groups = [group | self._options() for group in optimiser["param_groups"]]
        self.optimiser.load_state_dict({"state": optimiser["state"], "param_groups": groups})
        self._rated()  # it has copied it

    def _rated(self) -> None:
        for group in self.optimiser.param_groups:
            group["lr"] = self._rate

    def _normalise(self) -> None:
        for name, value in self.moments.items():
            self.buffers[name].copy_(value)

    def _options(self) -> dict[str, Any]:
        is_cuda = self.seen.count.is_cuda
        return {"lr": self._rate, "capturable": is_cuda, "fused": True if is_cuda else None}

    def _call(self, parameters: dict[str, Tensor], buffers: dict[str, Tensor], *inputs: Tensor | None) -> tuple[Tensor, ...]:
        return tuple(functional_call(self._shape, (parameters, buffers), inputs))


def seeded_student(architecture: Architecture, seed: int) -> Student:
    """Return a student with initial weights from a seed alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Student(architecture)

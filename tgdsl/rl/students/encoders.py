"""Networks that embed one group of observations, with memory or without.

All take (env, feature) and what they remember, (env, memory), and return the embedding and what they remember then; an episode
begins with zeros. Images are made from the features themselves, so that a policy takes the same numbers whatever its network.

Shapes: `env` environments, `feature` numbers of the group, `memory` numbers that are remembered, `size` of the embedding.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn

Kind = Literal["mlp", "lstm", "cnn", "convrnn"]


@dataclass(frozen=True)
class Grid:
    """Where taxels stand in the images of their links; links whose grids are smaller than the largest fill a corner.

    Features are the `channels` numbers of a taxel, those of all taxels of the first channel, then of the second. The shape is
    links, rows, columns; of each cell there is the taxel, −1 where there is none.
    """

    channels: int
    num_taxels: int
    shape: tuple[int, int, int]
    taxels: tuple[int, ...]


@dataclass(frozen=True)
class Encoder:
    """What network embeds a group.

    `hidden` are widths of an `mlp`'s hidden layers, the one of an `lstm`, channels of `cnn` and of `convrnn`; `size` is that of
    the embedding, `kernel` the width of the kernels of images [taxel].
    """

    kind: Kind
    hidden: tuple[int, ...]
    size: int
    kernel: int = 3
    grid: Grid | None = None


def mlp(size: int, hidden: tuple[int, ...], output: int) -> nn.Sequential:
    """Return linear layers with ELU between them."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(size, width), nn.ELU()]
        size = width
    return nn.Sequential(*layers, nn.Linear(size, output))


def network(size: int, encoder: Encoder) -> Embedding:
    """Return the network that embeds a group of some size."""
    if encoder.kind == "mlp":
        return Mlp(size, encoder)
    if encoder.kind == "lstm":
        return Lstm(size, encoder)
    return Convolution(encoder) if encoder.kind == "cnn" else RecurrentConvolution(encoder)


class Embedding(nn.Module):
    """A network that embeds a group, and remembers so many numbers of an episode."""

    memory: int = 0


class Mlp(Embedding):
    """Linear layers."""

    def __init__(self, size: int, encoder: Encoder):
        super().__init__()
        self.layers = mlp(size, encoder.hidden, encoder.size)

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
    """What networks of images have in common: features as images of links, with a channel that tells where there are taxels."""

    def __init__(self, grid: Grid):
        super().__init__()
        self.grid = grid
        cells = torch.tensor(grid.taxels).view(grid.shape)
        self.register_buffer("cells", cells.clamp(min=0), persistent=False)
        self.register_buffer("mask", (cells >= 0).to(torch.get_default_dtype()), persistent=False)

    def images(self, x: Tensor) -> Tensor:
        """Return images, 0 where there is no taxel."""
        by_channel = x.unflatten(1, (self.grid.channels, self.grid.num_taxels))
        cells: Tensor = self.cells  # pyright: ignore[reportAssignmentType]
        result = by_channel[:, :, cells.flatten()].unflatten(2, self.grid.shape)
        return result.transpose(1, 2) * self.masks()

    def masks(self) -> Tensor:
        """Return 1 where there is a taxel, else 0."""
        mask: Tensor = self.mask  # pyright: ignore[reportAssignmentType]
        return mask[:, None]

    def marked(self, x: Tensor) -> Tensor:
        """Return the images of all links and environments, and as their last channel the mask."""
        images = self.images(x)
        mask = self.masks().expand(x.shape[0], -1, -1, -1, -1)
        return torch.cat([images, mask], dim=2).flatten(0, 1)


class Convolution(Images):
    """Convolutions, the same ones of all links, then a projection of all that they find."""

    def __init__(self, encoder: Encoder):
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
        images = images.unflatten(0, (x.shape[0], -1)) * self.masks()
        return self.projection(images.flatten(1)), memory


class RecurrentConvolution(Images):
    """Long short-term memory whose products are convolutions, gates layer-normed per image; then a projection."""

    def __init__(self, encoder: Encoder):
        assert encoder.grid is not None
        super().__init__(encoder.grid)
        self.width, cells = encoder.hidden[0], len(encoder.grid.taxels)
        size = encoder.grid.channels + 1 + self.width
        self.gates = nn.Conv2d(size, 4 * self.width, encoder.kernel, padding=encoder.kernel // 2, bias=False)
        self.norm = nn.LayerNorm([4 * self.width, *encoder.grid.shape[1:]])
        self.projection, self.memory = nn.Linear(self.width * cells, encoder.size), 2 * self.width * cells

    def forward(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        links, *image = self.grid.shape
        state = memory.unflatten(1, (2, links, self.width, *image)).transpose(0, 1).flatten(1, 2)
        h, c = gated(self.norm(self.gates(torch.cat([self.marked(x), state[0]], dim=1))), state[1])
        state = torch.stack([h, c]).unflatten(1, (x.shape[0], links)) * self.masks()
        return self.projection(state[0].flatten(1)), state.transpose(0, 1).flatten(1)


def gated(gates: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Return h and c after a step; gates i, f, g, o stand side by side along dimension 1."""
    i, f, g, o = gates.chunk(4, dim=1)
    c = f.sigmoid() * c + i.sigmoid() * g.tanh()
    return o.sigmoid() * c.tanh(), c

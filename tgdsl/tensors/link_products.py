"""A matrix for each link that maps its taxels' values to each of its taxels: crosstalk, and the markers of a skin.

Shapes: `line` environments, or environments and channels, `row` the taxels of all links, one link after the other, `from` and
`to` the taxels of one link, `plane` outputs per taxel.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.tensors.operations import Operation

LARGEST = 256  # most taxels of a link for which the kernel is used: a library multiplies larger matrices faster
Matrices = Sequence[Float[Tensor, "_from plane _to"]]


def products(lines: Float[Tensor, "line row"], matrices: Matrices) -> Float[Tensor, "plane line row"]:
    """Return Σ_from line[from] matrix[from] of each link."""
    parts = lines.split([len(matrix) for matrix in matrices], dim=1)
    results = [(part @ matrix.flatten(1)).unflatten(1, matrix.shape[1:]) for part, matrix in zip(parts, matrices, strict=True)]
    return torch.cat(results, dim=-1).transpose(0, 1)


def _by_kernel(lines: Float[Tensor, "line row"], matrices: Matrices) -> Float[Tensor, "plane line row"]:
    from tgdsl.tensors.link_products_kernel import link_products

    return link_products(lines.contiguous(), matrices)


def _inputs(lines: Float[Tensor, "*line row"], matrices: Matrices) -> tuple[Tensor, ...]:
    return lines, *matrices


def _are_small(lines: Float[Tensor, "*line row"], matrices: Matrices) -> bool:
    return max(len(matrix) for matrix in matrices) <= LARGEST


LINK_PRODUCTS = Operation("link_products", products, _by_kernel, _inputs, _are_small)

"""What all taxels of a link do to each of them, by a matrix for each link: crosstalk, and the markers of a skin.

Shapes: `line` environments, or environments and channels, `row` the taxels of all links, one link after the other, `from` and
`to` those of one link, `plane` numbers that come out for each taxel.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.tensors.fusion import takes_kernel

LARGEST = 256
"""Most taxels of a link that the kernel takes; a library multiplies larger matrices faster."""


def are_for_kernel(lines: Float[Tensor, "*line row"], matrices: Sequence[Float[Tensor, "_from plane _to"]]) -> bool:
    """Return whether one kernel can multiply all links."""
    return takes_kernel(lines, *matrices) and max(len(matrix) for matrix in matrices) <= LARGEST


def products(
    lines: Float[Tensor, "line row"], matrices: Sequence[Float[Tensor, "_from plane _to"]]
) -> Float[Tensor, "plane line row"]:
    """Return Σ_from line[from] matrix[from] of each link.

    Args:
        lines: What there is before.
        matrices: Of each link, in the order of their rows, which together are all.
    """
    if are_for_kernel(lines, matrices):
        from tgdsl.tensors.link_products_kernel import link_products

        return link_products(lines.contiguous(), matrices)
    parts = lines.split([len(matrix) for matrix in matrices], dim=1)
    found = [(own @ matrix.flatten(1)).unflatten(1, matrix.shape[1:]) for own, matrix in zip(parts, matrices, strict=True)]
    return torch.cat(found, dim=-1).transpose(0, 1)

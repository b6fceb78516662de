"""Conduction within links: what a step adds to the cells of a box.

Along an axis with n cells of size Δ and insulated ends a step multiplies mode k, cos((i + ½)kπ/n), by e^(−aμ_k), with
a = αΔt/Δ² and μ_k = 4 sin²(kπ/2n) [1]: see `cells`. Axes commute, so what a step adds is (I + G_x) ⊗ (I + G_y) ⊗ (I + G_z) − I,
G = Cᵀ diag(e^(−aμ) − 1) C of an axis. Axes whose cells are few are taken together as one dense operator, and those groups one
after the other. An operator acts on what cells differ from their mean, and from what it adds the mean is taken off: what leaves
some cells enters others, but for rounding of what flows.

`spectral` has (kπΔ/L)² in the exponent in place of μ_k: the decay of the continuous solid's modes. `semi_implicit` divides each
mode of the box by 1 + αΔt|k|² (the paper).

Shapes: `env` environments, or 1 where all are alike; `row` bodies, `x`, `y`, `z` cells; `to`, `from` cells of a group; `wave`
modes but for the mean.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.geometry import planes

Cells = Float[Tensor, "env row x y z"]
MOST_DENSE = {"cpu": 100, "cuda": 8}
"""Cells of a group: a product of matrices takes less time than two smaller ones; a GPU sums in single precision, by threads."""


class Axis(NamedTuple):
    """What a step adds along one axis, or along some that follow one another.

    Attributes:
        gains: (env, row, to, from) [1].
        is_there: 1 for the cells that a row has (row, cell).
    """

    gains: Float[Tensor, "env row to from"]
    is_there: Float[Tensor, "row cell"]


def along_axis(rate: Tensor, cosines: Float[Tensor, "row mode cell"], exponent: Float[Tensor, "row wave"]) -> Axis:
    """Return what a step adds along an axis.

    Args:
        rate: a = αΔt/Δ² (env, row) [1].
        cosines: Modes; mode 0 is the mean.
        exponent: What a is multiplied with in the exponent, of the modes from 1 on: μ, or (kπΔ/L)².
    """
    decay = torch.expm1(-rate[..., None] * exponent)
    waves = cosines[:, 1:]
    if waves.is_cuda:  # a product of matrices there may be rounded to ten bits, if its user wants that elsewhere
        gains = ((decay[..., None] * waves)[..., :, None] * waves[..., None, :]).sum(dim=-3)
    else:
        gains = (decay[..., None] * waves).transpose(-2, -1) @ waves
    return Axis(gains, (cosines[:, 0] > 0).to(cosines.dtype))


def together(first: Axis, second: Axis) -> Axis:
    """Return what a step adds along two axes: G ⊗ (I + H) + I ⊗ H."""
    one, other = (torch.eye(axis.gains.shape[-1], dtype=axis.gains.dtype, device=axis.gains.device) for axis in (first, second))
    outer, inner = first.gains[..., :, None, :, None], second.gains[..., None, :, None, :]
    both = outer * (other[:, None, :] + inner) + one[:, None, :, None] * inner
    is_there = first.is_there[:, :, None] * second.is_there[:, None, :]
    return Axis(both.flatten(-4, -3).flatten(-2, -1), is_there.flatten(1))


def grouped(axes: list[Axis], device: str) -> list[Axis]:
    """Return axes in groups, in their order: those that follow one another and have few cells together are one.

    What differs between environments is left in small pieces.
    """
    groups: list[Axis] = []
    for axis in reversed(axes):
        size = axis.gains.shape[-1]
        is_small = len(groups) > 0 and size * groups[-1].gains.shape[-1] <= MOST_DENSE.get(device, MOST_DENSE["cuda"])
        if is_small and len(axis.gains) == 1:
            groups[-1] = together(axis, groups[-1])
        else:
            groups.append(axis)
    return groups[::-1]


def spread(cells: Cells, axes: list[Axis]) -> Cells:
    """Return what the cells gain in a step [K].

    Args:
        cells: Temperatures [K].
        axes: What it adds along x, y and z; or along groups of them that have all cells together.
    """
    groups, shape, behind = grouped(axes, cells.device.type), cells.shape, 1
    gained = None
    for group in reversed(groups):
        size = group.gains.shape[-1]
        if size > 1:
            now = cells if gained is None else cells + gained
            more = _added(now.reshape(*shape[:2], -1, size, behind), group).reshape(shape)
            gained = more if gained is None else gained + more
        behind *= size
    return torch.zeros_like(cells) if gained is None else gained


def _added(cells: Float[Tensor, "env row ahead from behind"], group: Axis) -> Float[Tensor, "env row ahead to behind"]:
    """Return what a group adds."""
    there = group.is_there[:, None, :, None]
    share = there / there.sum(dim=2, keepdim=True)
    apart = cells - (cells * share).sum(dim=3, keepdim=True)
    if apart.is_cuda:
        gains = group.gains[:, :, None, :, None, :]
        made = (gains * apart.movedim(3, -1)[:, :, :, None]).sum(dim=-1)
    elif len(group.gains) == 1 and apart.shape[-1] == 1:  # one product for each row, over all environments
        num_envs, num_rows, ahead, size, _ = apart.shape
        flat = apart.transpose(0, 1).reshape(num_rows, num_envs * ahead, size)
        made = torch.bmm(flat, group.gains[0].transpose(1, 2))
        made = made.reshape(num_rows, num_envs, ahead, size, 1).transpose(0, 1)
    else:
        made = group.gains[:, :, None] @ apart
    return made - there * (made * share).sum(dim=3, keepdim=True)


def along(matrix: Tensor, cells: Cells, axis: int) -> Cells:
    """Return a matrix of each row times what stands along an axis of its cells.

    Args:
        matrix: (row, to, from), or (env, row, to, from).
        cells: (env, row, x, y, z).
        axis: 0, 1 or 2.
    """
    moved = cells.movedim(2 + axis, -1)  # (env, row, a, b, from)
    if moved.is_cuda:
        made = (matrix[..., None, None, :, :] * moved[..., None, :]).sum(dim=-1)
    else:
        made = moved @ matrix[..., None, :, :].transpose(-2, -1)
    return made.movedim(-1, 2 + axis)


def semi_implicit(
    cells: Cells, rates: Tensor, cosines: tuple[Tensor, ...], least: Tensor | None = None
) -> Float[Tensor, "env row x y z"]:
    """Return what the cells gain in a step that divides each mode by 1 + αΔt|k|² [K].

    Args:
        cells: Temperatures [K].
        rates: αΔt/L² along each axis (env, row, 3) [1]; env is 1 where all are alike.
        cosines: Modes along each axis (row, mode, cell).
        least: Least αΔt|k|², which the mean has too [1]; default: the mean stays.
    """
    found = cells
    for axis, mode in enumerate(cosines):
        found = along(mode, found, axis)
    decay = torch.zeros_like(cells[:1])
    for axis, mode in enumerate(cosines):
        k = planes.pi() * torch.arange(mode.shape[-2], device=cells.device, dtype=cells.dtype)
        shape = [1, 1, 1]
        shape[axis] = -1
        decay = decay + rates[..., axis, None, None, None] * (k * k).reshape(shape)
    decay = decay if least is None else torch.maximum(decay, least)
    found = -found * (decay / (1.0 + decay))
    for axis, mode in enumerate(cosines):
        found = along(mode.transpose(-2, -1), found, axis)
    return found

"""Conduction within links with losses at their faces: the change of a box's cells in a step, also from a constant source.

    θ̇ = −(M_x + M_y + M_z) θ + s,   M_a = α/Δ_a² (−D² + diag(b)),   b = u Δ_a/k at exposed faces                [K/s]

with D² the second difference between insulated walls and u [W/(m²·K)] the heat transfer coefficient between a cell at the face
and the surroundings (`losses`). Eigenvectors of M_a and eigenvalues αμ/Δ² are known beforehand (`quantities.patches`). A
step of Δt is exact in time:

    θ ← (I + G_x) ⊗ (I + G_y) ⊗ (I + G_z) θ + Δt φ₁(x) s,   G = Vᵀ diag(e^(−aμ) − 1) V,   φ₁(x) = (1 − e^(−x))/x

with a = αΔt/Δ² of an axis and x = Σ aμ of a mode of the box. Neighbouring axes with few cells form one dense operator, and the
operators act one after the other. Each acts separately on the cells' mean and on their differences from it. Its result is
corrected to sum to the heat through the faces, so heat is conserved to the rounding of the flow.

`spectral` replaces 4 sin²(kπ/2n) in μ_k by (kπ/n)²: the decay of the continuous solid's modes between insulated walls.
`semi_implicit` divides each mode of the box by 1 + x (the paper), and replaces φ₁ by 1/(1 + x).

Source: Carslaw and Jaeger, *Conduction of Heat in Solids*, 3.9 and 3.11, for modes of a slab that loses heat at its faces;
Hochbruck and Ostermann, Exponential integrators, *Acta Numerica* 2010, for φ₁.

Shapes: `env` environments, or 1 where all are alike; `row` bodies, `x`, `y`, `z` cells; `to`, `from` cells of a group; `mode`
modes along an axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

Cells = Float[Tensor, "env row x y z"]
MOST_DENSE = {"cpu": 100, "cuda": 8}
"""Cells of a group: a product of matrices takes less time than two smaller ones; a GPU sums in single precision, by threads."""


class Modes(NamedTuple):
    """Modes along an axis: vectors (row, mode, cell); their sums over cells, and the factors of a in x, (row, mode) each."""

    vectors: Float[Tensor, "row mode cell"]
    totals: Float[Tensor, "row mode"]
    exponent: Float[Tensor, "row mode"]


class Axis(NamedTuple):
    """The change of a step along one axis, or along a group of neighbouring axes."""

    gains: Float[Tensor, "env row to from"]  # G, symmetric (env, row, to, from) [1]
    # column sums of G: the change of all cells together per unit in one (env, row, from) [1]
    leaves: Float[Tensor, "env row from"]
    is_there: Float[Tensor, "row cell"]  # 1 for the cells that a row has (row, cell)


class Spread(NamedTuple):
    """Gains of cells in a step (env, row, x, y, z) [K], and the part of their sum that came through faces (env, row) [K]."""

    gained: Tensor
    entered: Tensor


def along_axis(rate: Float[Tensor, "env row"], modes: Modes) -> Axis:
    """Return the change along an axis; the rate is a = αΔt/Δ² [1]."""
    decay = torch.expm1(-rate[..., None] * modes.exponent)
    waves, scaled, totals = modes.vectors, decay[..., None] * modes.vectors, decay * modes.totals
    # On a GPU a matrix product may use TF32 with its ten-bit mantissa, if the user allows that.
    is_summed = waves.is_cuda
    gains = (scaled[..., :, None] * waves[..., None, :]).sum(dim=-3) if is_summed else scaled.transpose(-2, -1) @ waves
    return Axis(gains, (totals[..., None] * waves).sum(dim=-2), (waves[:, 0] > 0).to(waves.dtype))


def together(first: Axis, second: Axis) -> Axis:
    """Return the change along two axes: G ⊗ (I + H) + I ⊗ H."""
    one, other = (torch.eye(axis.gains.shape[-1], dtype=axis.gains.dtype, device=axis.gains.device) for axis in (first, second))
    outer, inner = first.gains[..., :, None, :, None], second.gains[..., None, :, None, :]
    both = outer * (other[:, None, :] + inner) + one[:, None, :, None] * inner
    mine, its = first.leaves[..., :, None], second.leaves[..., None, :]
    leaves = mine * (second.is_there[:, None, :] + its) + first.is_there[:, :, None] * its
    is_there = first.is_there[:, :, None] * second.is_there[:, None, :]
    return Axis(both.flatten(-4, -3).flatten(-2, -1), leaves.flatten(-2), is_there.flatten(1))


def grouped(axes: list[Axis], device: str) -> list[Axis]:
    """Return axes in groups, in their order: neighbours with few cells are merged.

    Axes that differ between environments are not merged.
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


def spread(cells: Cells, axes: list[Axis]) -> Spread:
    """Return the change of cells in a step.

    Args:
        cells: Temperatures [K].
        axes: The change along x, y and z, or along groups that cover all three.
    """
    groups, shape, behind = grouped(axes, cells.device.type), cells.shape, 1
    gained, entered = torch.zeros_like(cells), torch.zeros_like(cells[:, :, 0, 0, 0])
    for i, group in enumerate(reversed(groups)):
        size = group.gains.shape[-1]
        now = cells if i == 0 else cells + gained
        more, through = _added(now.reshape(*shape[:2], -1, size, behind), group)
        gained, entered = gained + more.reshape(shape), entered + through
        behind *= size
    return Spread(gained, entered)


def _added(
    cells: Float[Tensor, "env row ahead from behind"], group: Axis
) -> tuple[Float[Tensor, "env row ahead to behind"], Float[Tensor, "env row"]]:
    """Return the change along a group of axes, and the part of its sum that came through the faces."""
    there, leaves = group.is_there[:, None, :, None], group.leaves[:, :, None, :, None]
    share = there / there.sum(dim=2, keepdim=True)
    mean = (cells * share).sum(dim=3, keepdim=True)
    apart = cells - there * mean
    if apart.is_cuda:
        gains = group.gains[:, :, None, :, None, :]
        change = (gains * apart.movedim(3, -1)[:, :, :, None]).sum(dim=-1)
    elif len(group.gains) == 1 and apart.shape[-1] == 1:  # one product for each row, over all environments
        num_envs, num_rows, ahead, size, _ = apart.shape
        flat = apart.transpose(0, 1).reshape(num_rows, num_envs * ahead, size)
        change = torch.bmm(flat, group.gains[0].transpose(1, 2))
        change = change.reshape(num_rows, num_envs, ahead, size, 1).transpose(0, 1)
    else:
        change = group.gains[:, :, None] @ apart
    change = change + leaves * mean
    through = (leaves * apart).sum(dim=3, keepdim=True) + mean * leaves.sum(dim=3, keepdim=True)
    change = change - there * (change * share).sum(dim=3, keepdim=True) + share * through
    return change, through.sum(dim=(2, 3, 4))


def along(matrix: Tensor, cells: Cells, axis: int) -> Cells:
    """Return each row's matrix times its cells along an axis.

    Args:
        matrix: (row, to, from), or (env, row, to, from).
        cells: (env, row, x, y, z).
        axis: 0, 1 or 2.
    """
    moved = cells.movedim(2 + axis, -1)  # (env, row, a, b, from)
    if moved.is_cuda:
        product = (matrix[..., None, None, :, :] * moved[..., None, :]).sum(dim=-1)
    else:
        product = moved @ matrix[..., None, :, :].transpose(-2, -1)
    return product.movedim(-1, 2 + axis)


def to_modes(cells: Cells, modes: tuple[Modes, ...]) -> Cells:
    """Return the amplitude of each mode of a box. The mean is projected by `totals`: modes of zero sum get none of it."""
    there = _there(modes)
    mean = (cells * there).sum(dim=(-3, -2, -1), keepdim=True) / there.sum(dim=(-3, -2, -1), keepdim=True)
    result = cells - there * mean
    for axis, basis in enumerate(modes):
        result = along(basis.vectors, result, axis)
    return result + mean * outer([basis.totals for basis in modes], torch.mul)


def from_modes(parts: Cells, modes: tuple[Modes, ...]) -> Spread:
    """Return the gains of cells from amplitudes of modes. The modes' own sum is the part that came through the faces."""
    entered = (parts * outer([basis.totals for basis in modes], torch.mul)).sum(dim=(-3, -2, -1))
    for axis, basis in enumerate(modes):
        parts = along(basis.vectors.transpose(-2, -1), parts, axis)
    there = _there(modes)
    excess = parts.sum(dim=(-3, -2, -1)) - entered
    return Spread(parts - there * (excess / there.sum(dim=(-3, -2, -1)))[..., None, None, None], entered)


def _there(modes: tuple[Modes, ...]) -> Tensor:
    return outer([(basis.vectors[:, 0] > 0).to(basis.vectors.dtype) for basis in modes], torch.mul)


def squared_wavenumbers(step: Sequence[Float[Tensor, " row"]], modes: tuple[Modes, ...]) -> Float[Tensor, "row x y z"]:
    """Return x/(αΔt) = Σ μ/Δ² of the modes of a box [1/m²], from Δ of each axis [m]."""
    return outer([basis.exponent / (side * side)[:, None] for side, basis in zip(step, modes, strict=True)], torch.add)


def semi_implicit(cells: Cells, x: Float[Tensor, "#env row x y z"], modes: tuple[Modes, ...]) -> Spread:
    """Return the change of a step that divides each mode by 1 + x."""
    return from_modes(to_modes(cells, modes) * (-x / (1.0 + x)), modes)


def outer(parts: list[Tensor], join) -> Tensor:  # type: ignore[no-untyped-def]
    """Return outer products or sums of values along x, y and z (…, x, y, z)."""
    x, y, z = parts
    # Expanded first: inductor writes a value of many reads to memory, and fuses it only with others of its shape.
    x, y, z = torch.broadcast_tensors(x[..., :, None, None], y[..., None, :, None], z[..., None, None, :])
    return join(join(x, y), z)

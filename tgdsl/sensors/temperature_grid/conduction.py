"""Conduction between what touches: one step for all cells and bodies in contact, in the course of time of `response`.

    H_is = f_is (φ̄_n − θ̄_i),   J_is = f_is (φ'_n − θ'_i)              each cell i and side s, at node n of the side       [J]

with the flow f = Δt g of conductances g [W/K], means over the step θ̄ and φ̄, and temperatures at its end θ' and φ'. Cells show

    (θ̄, θ')_i = (θ̄, θ')_i,free + W_i Σ_s (H, J)_is/C + Σ_t R_st Σ_j (H, J)_jt/C,   W = (m_a, m_b; e_a, e_b)

free: without contact, as conduction, losses and sources have it; W_i of the cell itself; and R what a side shows of the heat of
others and of its other cells, in their mean by conductance. So contacts of one solid are solved together. Nodes are bodies of
one temperature, φ' = φ − Σ H/K and φ̄ the same with m_a and m_b of a mode that does not decay, and interfaces, where Σ H = 0 and
Σ J = 0. Solved cell by cell, what is left is a system of twice the sides of each row, and then one of twice the nodes.

What flows into cells is what leaves nodes, to rounding. A body of one temperature that touches one other is exact in time.

Shapes: `env` environments, `row` rows of cells, `side` sides of patches on each, `node` nodes; `both` H of the sides, then J,
or temperatures in the mean over the step, then those at its end.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.sensors.temperature_grid.diffusion import Modes
from tgdsl.sensors.temperature_grid.response import Four, Response, impulsiveness, of_cells, of_sides, response

MOST_UNROLLED = 8
"""Sides of a row, or nodes, up to which their system is solved number by number, which compiles to one kernel."""


class Sides(NamedTuple):
    """Which side of a patch is at which node.

    Attributes:
        tables: Those of `quantities.patches`.
        is_plain: Whether side n of each row is at node n, and these are all bodies.
    """

    tables: Mapping[str, Tensor]
    is_plain: bool


class Flows(NamedTuple):
    """What flows in a step: H and J of cells (env, row, x, y, z), σ (env, row), and what nodes get, (env, body) [J]."""

    heat: Tensor
    rate: Tensor
    sigma: Tensor
    nodes: Tensor


def step(
    free: tuple[Tensor, Tensor],
    nodes: Tensor,
    capacity: Tensor,
    inverse: Tensor,
    flow: Tensor,
    sides: Sides,
    phi: Four,
    modes: tuple[Modes, ...],
    is_implicit: bool,
) -> Flows:
    """Return what flows.

    Args:
        free: What cells are without contact, in the mean over the step and at its end (env, row, x, y, z) each [K].
        nodes: Temperatures of the bodies of one temperature, the first of the nodes (env, body) [K].
        capacity: C of a row's cells (env, row) [J/K].
        inverse: 1/K of these bodies (env, body) [K/J].
        flow: f (env, row, side, x, y, z) [J/K].
        sides: Which side is at which node.
        phi: φ₀ to φ₃ of the rows' modes.
        modes: The modes.
        is_implicit: Whether a step divides modes by 1 + x: then σ = 0.
    """
    num_bodies, num_nodes = nodes.shape[-1], sides.tables["at_node"].shape[0]
    whole = flow.sum(dim=(-3, -2, -1))
    is_side = whole > 0
    shares = flow / torch.where(is_side, whole, 1.0)[..., None, None, None]
    own = of_cells(phi, modes)
    every, beside = of_sides(shares, own, phi, modes)
    sigma = torch.zeros_like(whole[..., 0])
    if not is_implicit:
        sigma = impulsiveness(*(_shown(part, whole, capacity, inverse, sides) for part in every[:2]))
    cell = _Two.of(response(own, sigma[..., None, None, None]), capacity[..., None, None, None])
    between = _square(response(tuple(beside), sigma[..., None, None])) / capacity[..., None, None]  # type: ignore[arg-type]
    total = flow.sum(dim=2)
    solved = cell.solved(total)
    pair, target = _of_row(flow, total, solved, free)
    # H and J of the sides are F (pair V − target), V the temperatures of their nodes.
    num = pair.shape[-1]
    unit = torch.eye(num, dtype=flow.dtype, device=flow.device)
    both = _solved(unit + _times(pair, between), torch.cat([pair, target[..., None]], dim=-1))
    coupled, pulled = both[..., :num], both[..., num]
    lump = response(_at_rest(sigma), sigma)
    at = torch.cat([_of_nodes(sides, part) for part in _nodes(coupled, pulled, nodes, inverse, lump, sides)], dim=-1)
    flows = _times(coupled, at[..., None])[..., 0] - pulled
    near = at - _times(between, flows[..., None])[..., 0]
    mean, end = (part[..., None, None, None] for part in near.unflatten(-1, (2, -1)).unbind(2))
    heat, rate = solved.times((flow * (mean - free[0][:, :, None])).sum(dim=2), (flow * (end - free[1][:, :, None])).sum(dim=2))
    shown = free[0] + cell.mean_of_heat * heat + cell.mean_of_rate * rate
    heats = flow * (mean - shown[:, :, None])
    got = _at_nodes(sides, heats.sum(dim=(-3, -2, -1)))
    if num_nodes > num_bodies:  # an interface stores nothing: what rounding leaves over is taken back
        slack = torch.where(torch.arange(num_nodes, device=got.device) < num_bodies, 0.0, got)
        slack = slack / _positive(_at_nodes(sides, whole))
        heats = heats - flow * _of_nodes(sides, slack)[..., None, None, None]
    return Flows(heats.sum(dim=2), rate, sigma, -got[:, :num_bodies])


class _Two(NamedTuple):
    """A matrix of two by two of each cell, by its rows."""

    mean_of_heat: Tensor
    mean_of_rate: Tensor
    end_of_heat: Tensor
    end_of_rate: Tensor

    @staticmethod
    def of(found: Response, capacity: Tensor) -> _Two:
        return _Two(*(part / capacity for part in found))

    def solved(self, flow: Tensor) -> _Two:
        """Return (1 + f W)⁻¹."""
        a, d = 1.0 + flow * self.mean_of_heat, 1.0 + flow * self.end_of_rate
        b, c = flow * self.mean_of_rate, flow * self.end_of_heat
        over = 1.0 / (a * d - b * c)
        return _Two(d * over, -b * over, -c * over, a * over)

    def times(self, mean: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
        return self.mean_of_heat * mean + self.mean_of_rate * end, self.end_of_heat * mean + self.end_of_rate * end


def _square(found: Response) -> Float[Tensor, "env row both both"]:
    upper, lower = torch.cat([found[0], found[1]], dim=-1), torch.cat([found[2], found[3]], dim=-1)
    return torch.cat([upper, lower], dim=-2)


def _of_row(flow: Tensor, total: Tensor, solved: _Two, free: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Return how H and J of the sides follow from the nodes' temperatures, (env, row, both, both), and what is taken off."""
    part = flow / _positive(total)[:, :, None]

    def between(factor: Tensor) -> Tensor:
        return ((part * factor[:, :, None])[:, :, :, None] * flow[:, :, None]).sum(dim=(-3, -2, -1))

    zero = torch.zeros_like(between(total))
    result = _square(Response(*(between(own) for own in solved)))
    if flow.shape[2] > 1:  # what sides exchange at once through the cells that they share
        direct = between(torch.ones_like(total))
        direct = torch.diag_embed(direct.sum(dim=-1)) - direct
        result = result + _square(Response(direct, zero, zero, direct))
    taken = [(flow * own[:, :, None]).sum(dim=(-3, -2, -1)) for own in solved.times(*free)]
    return result, torch.cat(taken, dim=-1)


def _shown(
    between: Float[Tensor, "env row side side"],
    whole: Float[Tensor, "env row side"],
    capacity: Tensor,
    inverse: Tensor,
    sides: Sides,
) -> Float[Tensor, "env row"]:
    """Return r of a φ: see `response`."""
    bodies = torch.nn.functional.pad(inverse, (0, sides.tables["at_node"].shape[0] - inverse.shape[-1]))
    at_nodes = bodies * _at_nodes(sides, whole)
    shown = _times(between, whole[..., None])[..., 0] / capacity[..., None] + _of_nodes(sides, at_nodes)
    return (whole * shown).sum(dim=-1) / _positive(whole.sum(dim=-1))


def _nodes(
    coupled: Float[Tensor, "env row both both"],
    pulled: Float[Tensor, "env row both"],
    nodes: Float[Tensor, "env body"],
    inverse: Float[Tensor, "#env body"],
    lump: Response,
    sides: Sides,
) -> tuple[Tensor, Tensor]:
    """Return the temperatures of the nodes in the mean over the step and at its end (env, node)."""
    num_bodies, num_nodes = nodes.shape[-1], sides.tables["at_node"].shape[0]
    num = pulled.shape[-1] // 2

    def equations(of_heat: Tensor, of_rate: Tensor, join: Callable[[Sides, Tensor], Tensor]) -> Tensor:
        """Return what bodies get for their means and ends, of interfaces H and J, joined over sides."""
        mean_of_heat, mean_of_rate = (part.reshape(*part.shape, *[1] * (of_heat.ndim - 2)) for part in lump[:2])
        heat, mean = join(sides, of_heat), join(sides, mean_of_heat * of_heat + mean_of_rate * of_rate)
        if num_nodes == num_bodies:
            return torch.cat([mean, heat], dim=1)
        rate = join(sides, of_rate)
        return torch.cat([mean[:, :num_bodies], heat[:, num_bodies:], heat[:, :num_bodies], rate[:, num_bodies:]], dim=1)

    right = equations(pulled[..., :num], pulled[..., num:], _at_nodes)
    blocks = coupled[..., :num], coupled[..., num:]
    columns = [equations(block[..., :num, :], block[..., num:, :], _between_nodes) for block in blocks]
    matrix = torch.cat(columns, dim=-1)
    is_idle = (_diagonal(matrix) == 0).to(nodes.dtype)
    stores, gain, before = is_idle, torch.ones_like(is_idle), torch.zeros_like(right)
    if num_bodies:
        of_faces = [part.unflatten(1, (2, num_nodes))[:, :, num_bodies:] for part in (stores, gain, before)]
        bodies = torch.ones_like(nodes), inverse.expand_as(nodes), nodes
        stores, gain, before = (
            torch.cat([part[:, None].expand(-1, 2, -1), faces], dim=-1).flatten(1)
            for part, faces in zip(bodies, of_faces, strict=True)
        )
    matrix = torch.diag_embed(stores) + gain[..., None] * matrix
    mean, end = _solved(matrix, (stores * before + gain * right)[..., None])[..., 0].unflatten(1, (2, num_nodes)).unbind(1)
    return mean, end


def _between_nodes(sides: Sides, values: Float[Tensor, "env row side side"]) -> Float[Tensor, "env node node"]:
    """Return the sums over the sides at each two nodes."""
    if sides.is_plain:
        return values.sum(dim=1)
    between = torch.nn.functional.pad(values.flatten(1), (0, 1))[:, sides.tables["coupled"]].sum(dim=-1)
    return between + torch.diag_embed(_at_nodes(sides, _diagonal(values)))


def _solved(matrix: Float[Tensor, "*rest both both"], right: Float[Tensor, "*rest both column"]) -> Tensor:
    """Return the solutions of some right sides, by Gauss-Jordan steps with pivots of two by two where they are few."""
    num = matrix.shape[-1] // 2
    if num > MOST_UNROLLED:
        return torch.linalg.solve_ex(matrix, right)[0]
    parts = torch.cat([matrix, right], dim=-1)
    rows = [[parts[..., n, :], parts[..., num + n, :]] for n in range(num)]
    for n in range(num):
        one, other = rows[n]
        (a, b), (c, d) = ((part[..., n, None], part[..., num + n, None]) for part in (one, other))
        over = 1.0 / (a * d - b * c)
        one, other = over * (d * one - b * other), over * (a * other - c * one)
        rows = [[part - part[..., n, None] * one - part[..., num + n, None] * other for part in row] for row in rows]
        rows[n] = [one, other]
    return torch.stack([row[k][..., 2 * num :] for k in range(2) for row in rows], dim=-2)


def _diagonal(matrix: Float[Tensor, "*rest both both"]) -> Float[Tensor, "*rest both"]:
    """Return the diagonal; Inductor's own lowering of `Tensor.diagonal` warns."""
    return matrix.flatten(-2)[..., :: matrix.shape[-1] + 1]


def _times(one: Tensor, other: Tensor) -> Tensor:
    """Return a product of matrices. On a GPU one may be rounded to ten bits, if its user wants that elsewhere."""
    return (one[..., None] * other[..., None, :, :]).sum(dim=-2) if one.is_cuda else one @ other


def _at_rest(like: Tensor) -> Four:
    one = torch.ones_like(like)
    return one, one, 0.5 * one, one / 6.0


def _positive(values: Tensor) -> Tensor:
    return torch.where(values > 0, values, 1.0)


def _at_nodes(sides: Sides, values: Float[Tensor, "env row side"]) -> Float[Tensor, "env node"]:
    if sides.is_plain:
        return values.sum(dim=1)
    return torch.nn.functional.pad(values.flatten(1), (0, 1))[:, sides.tables["at_node"]].sum(dim=-1)


def _of_nodes(sides: Sides, values: Float[Tensor, "env node"]) -> Float[Tensor, "env row side"]:
    return values[:, None] if sides.is_plain else values[:, sides.tables["node"]]

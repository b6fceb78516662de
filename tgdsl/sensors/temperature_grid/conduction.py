"""How cells respond to the heat that contacts bring within a step, while it is conducted on.

The heat that flows through a side of a patch in a step, H [J], and its flow at the end of the step times Δt, J [J], stand for
its course in time: an impulse at the step's begin, a constant and a linear part,

    H a(t) + J b(t),   a = ((1 − σ) δ(t) + 6σ − 6σ t)/(1 + 2σ),   b = ((σ − 1) δ(t) + 1 − 4σ + 6σ t)/(1 + 2σ),   0 ≤ t ≤ 1

so that ∫ a = 1, a(1) = 0, ∫ b = 0 and b(1) = 1. A steady flow, H = J, is exact for any σ. Of it a mode of the cells that
decays by e^(−x) in the step shows at the step's end, and in its mean, over the heat capacity of a cell

    e_a = (1 − σ, 6σ, −6σ) · (φ₀, φ₁, φ₂)/(1 + 2σ),   e_b = (σ − 1, 1 − 4σ, 6σ) · (φ₀, φ₁, φ₂)/(1 + 2σ)                   [1]
    m_a, m_b: the same of (φ₁, φ₂, φ₃),   φ₀ = e^(−x),   φ_k = (1/(k − 1)! − φ_(k−1))/x

A flow that decays as e^(−zt), as between two bodies of one temperature each, has exactly

    σ = (J₀ − z e^(−z))/(2 (Q − J₀)),   Q = 1 − e^(−z),   J₀ = 2 (Q/z − e^(−z))

from 1, a linear course, for z → 0 to 1/z, an impulse. z of all that touches a row follows from what its cells, and the bodies
of one temperature, show of an impulse and of a constant flow, r_k = Σ_st g_s φ_k,st Δt g_t/(C Σ g):

    z = r₀/(1 + r₁ − r₀) + 16 (1 − r₀/r₁)² r₁/(1 + r₁)

The first term is exact for bodies of one temperature, and has what cells conduct within the step in series with the patch. The
second was fitted to the closed form of a half-space, whose flow first falls as 1/√t: in the first step of a contact it gets its
heat to 1 %, from the second step on to 0.1 %, for any αΔt/Δ².

Source: Hochbruck and Ostermann, Exponential integrators, *Acta Numerica* 2010, for φ_k. With σ = 1 the step is the Radau IIA
method of third order, with σ = 0 the (0, 2) Padé approximation: Hairer and Wanner, *Solving Ordinary Differential Equations
II*, IV.3 and IV.5.

Shapes: `env` environments, `row` rows of cells, `side` sides of patches on each, `x`, `y`, `z` cells or modes.

Conduction between what touches: one step for all cells and bodies in contact, in the course of time of `response`.

    H_is = f_is (φ̄_n − θ̄_i),   J_is = f_is (φ'_n − θ'_i)              each cell i and side s, at node n of the side       [J]

with the flow f = Δt g of conductances g [W/K], means over the step θ̄ and φ̄, and temperatures at its end θ' and φ'. Cells show

    (θ̄, θ')_i = (θ̄, θ')_i,free + W_i Σ_s (H, J)_is/C + Σ_t R_st Σ_j (H, J)_jt/C,   W = (m_a, m_b; e_a, e_b)

free: without contact, as conduction, losses and sources have it; W_i of the cell itself; and R what a side shows of the heat of
others and of its other cells, in their mean by conductance. So contacts of one solid are solved together. Nodes are bodies of
one temperature, φ' = φ − Σ H/K and φ̄ the same with m_a and m_b of a mode that does not decay, and interfaces, where Σ H = 0 and
Σ J = 0. Eliminating the cells leaves a system of twice the sides of each row, and then one of twice the nodes.

Heat into cells equals heat out of nodes, to rounding. A body of one temperature that touches one other is exact in time.

Shapes: `env` environments, `row` rows of cells, `side` sides of patches on each, `node` nodes; `both` H of the sides, then J,
or temperatures in the mean over the step, then those at its end.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.sensors.temperature_grid.diffusion import Modes, along

Four = tuple[Tensor, Tensor, Tensor, Tensor]


class Response(NamedTuple):
    """What heat of unit H and J shows [1], each times the cells' heat capacity: in the mean, then at the end of the step."""

    mean_of_heat: Tensor
    mean_of_rate: Tensor
    end_of_heat: Tensor
    end_of_rate: Tensor


def decays(x: Tensor, is_implicit: bool) -> Four:
    """Return φ₀ − 1, φ₁ − 1, φ₂ − ½ and φ₃ − ⅙ of modes that decay by e^(−x), or by 1/(1 + x): then φ₀ = φ₁ = φ₂ [1]."""
    if is_implicit:
        less = -x / (1.0 + x)
        return less, less, 0.5 + less, less
    is_far = x > 1.0
    near, far = torch.where(is_far, 1.0, x), torch.where(is_far, x, 1.0)
    fourth = torch.ones_like(x)
    for n in range(18, 4, -1):
        fourth = 1.0 - near * fourth / n
    third = -near * fourth / 24.0
    second = -near * (1.0 / 6.0 + third)
    first = -near * (0.5 + second)
    zeroth = -near * (1.0 + first)
    far_first = -torch.expm1(-far) / far
    far_second = (1.0 - far_first) / far
    parts = torch.expm1(-far), far_first - 1.0, far_second - 0.5, (0.5 - far_second) / far - 1.0 / 6.0
    a, b, c, d = (torch.where(is_far, far, near) for far, near in zip(parts, (zeroth, first, second, third), strict=True))
    return a, b, c, d


def whole(parts: Four) -> Four:
    """Return φ₀ to φ₃ of what `decays` returns."""
    a, b, c, d = (part + at_rest for part, at_rest in zip(parts, (1.0, 1.0, 0.5, 1.0 / 6.0), strict=True))
    return a, b, c, d


def response(phi: Four, sigma: Tensor) -> Response:
    """Return the equation of this module.

    Args:
        phi: φ₀ to φ₃.
        sigma: σ, to multiply them.
    """
    over = 1.0 / (1.0 + 2.0 * sigma)
    impulse, linear = (1.0 - sigma) * over, 6.0 * sigma * over
    constant = (1.0 - 4.0 * sigma) * over

    def of_heat(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
        return impulse * a + linear * (b - c)

    def of_rate(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
        return constant * b + linear * c - impulse * a

    return Response(of_heat(*phi[1:]), of_rate(*phi[1:]), of_heat(*phi[:3]), of_rate(*phi[:3]))


def of_cells(phi: Four, modes: tuple[Modes, ...]) -> Four:
    """Return each cell's response to its own heat, Σ_m v_im² φ_k (env or 1, row, x, y, z)."""
    result = list(phi)
    for axis, part in enumerate(modes):
        squared = (part.vectors * part.vectors).transpose(-2, -1)
        result = [along(squared, values, axis) for values in result]
    a, b, c, d = result
    return a, b, c, d


def of_sides(
    shares: Float[Tensor, "env row side x y z"], own: Four, phi: Four, modes: tuple[Modes, ...]
) -> tuple[list[Tensor], list[Tensor]]:
    """Return the sides' responses to one another's heat (env, row, side, side), for φ₀ to φ₃: whole, and less each cell's own.

    Args:
        shares: Each cell's share of a side's conductance.
        own: See `of_cells`.
        phi: φ₀ to φ₃ of the modes.
        modes: Modes along each axis.
    """
    num_envs, _, sides = shares.shape[:3]
    waves = shares.transpose(1, 2).flatten(0, 1)
    for axis, part in enumerate(modes):
        waves = along(part.vectors, waves, axis)
    waves = waves.unflatten(0, (num_envs, sides)).transpose(1, 2)
    every = [_between(waves, values) for values in phi]
    return every, [all_of - _between(shares, values) for all_of, values in zip(every, own, strict=True)]


def _between(parts: Tensor, factor: Tensor) -> Tensor:
    return ((parts * factor[:, :, None])[:, :, :, None] * parts[:, :, None]).sum(dim=(-3, -2, -1))


def impulsiveness(start: Tensor, constant: Tensor) -> Tensor:
    """Return σ from r₀ and r₁; 1 where nothing touches."""
    is_any = constant > 0
    safe = torch.where(is_any, constant, 1.0)
    spread = torch.where(is_any, 1.0 - start / safe, 0.0)
    z = start / (1.0 + constant - start) + 16.0 * spread * spread * constant / (1.0 + constant)
    is_fast = z > 0.5
    far, near = torch.where(is_fast, z, 1.0), torch.where(is_fast, 0.5, z)
    left = torch.exp(-far)
    last = 2.0 * ((1.0 - left) / far - left)
    fast = (last - far * left) / (2.0 * (1.0 - left - last))
    square = near * near  # the next term is below 1e-15
    series = 1 / 5600 - square * (1 / 504000 - square * (37 / 1552320000 - square * 59 / 201801600000))
    return torch.where(is_fast, fast, 1.0 - 0.25 * near + square * (1 / 40 - square * series))


MOST_UNROLLED = 8  # sides of a row, or nodes, up to which their system is solved number by number, which compiles to one kernel


class Sides(NamedTuple):
    """Which side of a patch is at which node."""

    tables: Mapping[str, Tensor]  # the tables of `quantities.patches`
    is_plain: bool  # whether side n of each row is at node n, and these are all bodies


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
    """Return the heat flows of a step.

    Args:
        free: Temperatures without contact, in the mean over the step and at its end (env, row, x, y, z) each [K].
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
    by_cell = of_cells(phi, modes)
    every, beside = of_sides(shares, by_cell, phi, modes)
    sigma = torch.zeros_like(whole[..., 0])
    if not is_implicit:
        sigma = impulsiveness(*(_response_of(part, whole, capacity, inverse, sides) for part in every[:2]))
    cell = _Two.of(response(by_cell, sigma[..., None, None, None]), capacity[..., None, None, None])
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
    cell_mean = free[0] + cell.mean_of_heat * heat + cell.mean_of_rate * rate
    heats = flow * (mean - cell_mean[:, :, None])
    got = _at_nodes(sides, heats.sum(dim=(-3, -2, -1)))
    if num_nodes > num_bodies:  # an interface stores nothing: remove the rounding error
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
    """Return the matrix from the nodes' temperatures to H and J of the sides (env, row, both, both), and the offset."""
    part = flow / _positive(total)[:, :, None]

    def between(factor: Tensor) -> Tensor:
        return ((part * factor[:, :, None])[:, :, :, None] * flow[:, :, None]).sum(dim=(-3, -2, -1))

    zero = torch.zeros_like(between(total))
    result = _square(Response(*(between(term) for term in solved)))
    if flow.shape[2] > 1:  # what sides exchange at once through the cells that they share
        direct = between(torch.ones_like(total))
        direct = torch.diag_embed(direct.sum(dim=-1)) - direct
        result = result + _square(Response(direct, zero, zero, direct))
    taken = [(flow * term[:, :, None]).sum(dim=(-3, -2, -1)) for term in solved.times(*free)]
    return result, torch.cat(taken, dim=-1)


def _response_of(
    between: Float[Tensor, "env row side side"],
    whole: Float[Tensor, "env row side"],
    capacity: Tensor,
    inverse: Tensor,
    sides: Sides,
) -> Float[Tensor, "env row"]:
    """Return r of a φ: see `response`."""
    bodies = torch.nn.functional.pad(inverse, (0, sides.tables["at_node"].shape[0] - inverse.shape[-1]))
    at_nodes = bodies * _at_nodes(sides, whole)
    at_sides = _times(between, whole[..., None])[..., 0] / capacity[..., None] + _of_nodes(sides, at_nodes)
    return (whole * at_sides).sum(dim=-1) / _positive(whole.sum(dim=-1))


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
    stores, gain, start = is_idle, torch.ones_like(is_idle), torch.zeros_like(right)
    if num_bodies:
        of_faces = [part.unflatten(1, (2, num_nodes))[:, :, num_bodies:] for part in (stores, gain, start)]
        bodies = torch.ones_like(nodes), inverse.expand_as(nodes), nodes
        stores, gain, start = (
            torch.cat([part[:, None].expand(-1, 2, -1), faces], dim=-1).flatten(1)
            for part, faces in zip(bodies, of_faces, strict=True)
        )
    matrix = torch.diag_embed(stores) + gain[..., None] * matrix
    mean, end = _solved(matrix, (stores * start + gain * right)[..., None])[..., 0].unflatten(1, (2, num_nodes)).unbind(1)
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
    return matrix.flatten(-2)[..., :: matrix.shape[-1] + 1]  # Inductor's own lowering of `Tensor.diagonal` warns


def _times(one: Tensor, other: Tensor) -> Tensor:
    # On a GPU a product of matrices may be rounded to ten bits, if its user wants that elsewhere.
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

"""Conduction between what touches: one implicit step for all cells and bodies in contact.

    C_i (θ'_i − θ_i) = Δt Σ_n g_in (φ'_n − θ'_i)                                            each cell i
    K_n (φ'_n − φ_n) = Δt Σ_i g_in (θ'_i − φ'_n)                                            each node n     [J]

with heat capacities C and K [J/K], C that which a cell shows in a step (`response`), conductances g [W/K], temperatures θ and
φ; nodes are bodies of one temperature, and interfaces with K = 0. Solved for θ' cell by cell, what is left is a small system of
the nodes, whose matrix has a dominant diagonal and no positive number beside it: temperatures after the step are means of those
before, for any Δt, k and area. What flows is w_in (φ'_n − θ_i) + Σ_m M_nm,i (φ'_n − φ'_m), with w = Δt g C/d, M = Δt² g g/d and
d = C + Δt Σ g: differences, in which nothing cancels, and equal on both sides.

Shapes: `env` environments, `row` rows of cells, `side` sides of patches on each, `node` nodes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

MOST_UNROLLED = 8
"""Nodes up to which their system is solved number by number, which compiles to one kernel."""


class Sides(NamedTuple):
    """Which side of a patch is at which node.

    Attributes:
        tables: Those of `quantities.patches`.
        is_plain: Whether side n of each row is at node n, and these are all bodies.
    """

    tables: Mapping[str, Tensor]
    is_plain: bool


class Flows(NamedTuple):
    """What a step changes: cells (env, row, x, y, z) and nodes (env, node), in kelvins."""

    cells: Tensor
    nodes: Tensor


def step(cells: Tensor, nodes: Tensor, capacity: Tensor, inverse: Tensor, flow: Tensor, sides: Sides) -> Flows:
    """Return what cells and nodes gain [K].

    Args:
        cells: θ (env, row, x, y, z) [K].
        nodes: φ of the bodies of one temperature, the first of the nodes (env, body) [K].
        capacity: C of cells (env, row, x, y, z) [J/K].
        inverse: 1/K of these bodies (env, body) [K/J].
        flow: Δt g (env, row, side, x, y, z) [J/K].
        sides: Which side is at which node.
    """
    num_bodies, num_nodes = nodes.shape[-1], sides.tables["at_node"].shape[0]
    total = capacity + flow.sum(dim=2)
    weight = flow * (capacity / total)[:, :, None]
    flat = cells[:, :, None]
    held = _at_nodes(sides, weight.sum(dim=(-3, -2, -1)))
    pulled = held, _at_nodes(sides, (weight * flat).sum(dim=(-3, -2, -1)))
    coupled = _coupled(flow, total, sides)
    stores, gain = _rows(nodes, inverse, held, num_bodies, num_nodes)
    before = torch.nn.functional.pad(nodes, (0, num_nodes - num_bodies)) if num_nodes > num_bodies else nodes
    after = _solved(stores, gain, pulled, coupled, before)
    across = _of_nodes(sides, after)[..., None, None, None] - flat
    left = _at_nodes(sides, (weight * across).sum(dim=(-3, -2, -1))) + _between(coupled, after)
    if num_nodes > num_bodies:  # an interface stores nothing: what rounding leaves over is taken back
        slack = torch.where(stores > 0, 0.0, -left / torch.where(held > 0, held, 1.0))
        across = across + _of_nodes(sides, slack)[..., None, None, None]
    return Flows((flow * across).sum(dim=2) / total, -inverse * left[:, :num_bodies])


def _at_nodes(sides: Sides, values: Float[Tensor, "env row side"]) -> Float[Tensor, "env node"]:
    """Return the sums over the sides at each node."""
    if sides.is_plain:
        return values.sum(dim=1)
    return torch.nn.functional.pad(values.flatten(1), (0, 1))[:, sides.tables["at_node"]].sum(dim=-1)


def _of_nodes(sides: Sides, values: Float[Tensor, "env node"]) -> Float[Tensor, "env row side"]:
    """Return what the node of each side has."""
    return values[:, None] if sides.is_plain else values[:, sides.tables["node"]]


def _coupled(flow: Tensor, total: Tensor, sides: Sides) -> Tensor | None:
    """Return M between nodes (env, node, node) [J/K]; None if no row has two sides."""
    between = sides.tables["coupled"]
    if between.shape[-1] == 0:
        return None
    share = flow / total[:, :, None]
    both = (flow[:, :, :, None] * share[:, :, None, :]).sum(dim=(-3, -2, -1))
    if sides.is_plain:
        return both.sum(dim=1) * (1.0 - torch.eye(both.shape[-1], dtype=both.dtype, device=both.device))
    return torch.nn.functional.pad(both.flatten(1), (0, 1))[:, between].sum(dim=-1)


def _between(coupled: Tensor | None, after: Tensor) -> Tensor:
    """Return what leaves each node for others [J]."""
    if coupled is None:
        return torch.zeros_like(after)
    return (coupled * (after[:, :, None] - after[:, None, :])).sum(dim=-1)


def _rows(nodes: Tensor, inverse: Tensor, pulled: Tensor, num_bodies: int, num_nodes: int) -> tuple[Tensor, Tensor]:
    """Return what each row of the system stores, and by what its flows are multiplied (env, node)."""
    bodies = torch.ones_like(nodes)
    if num_nodes == num_bodies:
        return bodies, inverse
    is_idle = (pulled[:, num_bodies:] <= 0).to(nodes.dtype)
    stores = torch.cat([bodies.expand(pulled.shape[0], -1), is_idle], dim=1)
    return stores, torch.cat([inverse.expand(pulled.shape[0], -1), torch.ones_like(is_idle)], dim=1)


def _solved(
    stores: Tensor, gain: Tensor, pulled: tuple[Tensor, Tensor], coupled: Tensor | None, before: Tensor
) -> Float[Tensor, "env node"]:
    """Return the nodes' temperatures after the step."""
    right = stores * before + gain * pulled[1]
    diagonal = stores + gain * pulled[0]
    if coupled is None:
        return right / diagonal
    diagonal = diagonal + gain * coupled.sum(dim=-1)
    num = right.shape[-1]
    if num > MOST_UNROLLED:
        matrix = torch.diag_embed(diagonal) - gain[..., None] * coupled
        return torch.linalg.solve_ex(matrix, right[..., None])[0][..., 0]
    rows = [[diagonal[:, n] if n == m else -gain[:, n] * coupled[:, n, m] for m in range(num)] for n in range(num)]
    values = list(right.unbind(-1))
    for n in range(num):
        for m in range(n + 1, num):
            factor = rows[m][n] / rows[n][n]
            rows[m] = [rows[m][j] - factor * rows[n][j] if j > n else rows[m][j] for j in range(num)]
            values[m] = values[m] - factor * values[n]
    for n in reversed(range(num)):
        for m in range(n + 1, num):
            values[n] = values[n] - rows[n][m] * values[m]
        values[n] = values[n] / rows[n][n]
    return torch.stack(values, dim=-1)

"""A step of all that holds heat, kept as compensated sums, and its start.

Shapes: `env` environments, `row` links, then objects that are divided into cells; `object` objects; `x`, `y`, `z` cells.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tgdsl.quantities.patches import ContactPatch
from tgdsl.sensors.base import Constants, Context, State
from tgdsl.sensors.temperature_grid import objects as held
from tgdsl.sensors.temperature_grid import paper
from tgdsl.sensors.temperature_grid.rows import Rows, is_there, num_cells, padded, rows_of
from tgdsl.sensors.temperature_grid.step import HEAT_STEP, Stepped


class Heat(NamedTuple):
    """What there is after a step, above ambient.

    Attributes:
        cells: Temperatures of the links' cells (env, link, x, y, z), and `cells_low` what these lack [K].
        cells_low: See `cells`.
        objects: The same of the objects' cells, (env, object, x, y, z); of an object of one temperature the first.
        objects_low: See `objects`.
        stored: What links hold (env, link) [J].
        gained: What they got from source, radiation, convection and contact, (env, link) each [J].
        of_objects: Mean temperature [K], what they hold, and got from radiation, convection and contact [J], (env, object)
            each; empty without objects.
    """

    cells: Tensor
    cells_low: Tensor
    objects: Tensor
    objects_low: Tensor
    stored: Tensor
    gained: tuple[Tensor, ...]
    of_objects: tuple[Tensor, ...]


def advanced(patches: ContactPatch, context: Context, constants: Constants, state: State) -> Heat:
    """Return what there is at a call; at the first one after a reset that is the start."""
    rows = rows_of(constants, patches, any(f"is_{name}" in constants for name in ("spectral", "semi_implicit", "paper")))
    where, lumped, grids = patches.topology, list(patches.topology.lumped), list(patches.topology.grids)
    cells, cells_low = state["cells"], state["cells_low"]
    objects = objects_low = cells.new_zeros((cells.shape[0], 0, 1, 1, 1))
    if where.num_objects:
        most = [max(own[axis] for own in where.cells) for axis in range(3)]
        objects, objects_low = (state[name].reshape(cells.shape[0], -1, *most) for name in ("objects", "objects_low"))
    all_cells = _with_objects(cells, objects[:, grids], rows) if grids else cells
    nodes = objects[:, :, 0, 0, 0] if where.is_plain else objects[:, lumped, 0, 0, 0]
    if "is_paper" in constants:
        made = _as_printed(all_cells, nodes, objects, rows, patches, constants, context.dt)
    else:
        made = HEAT_STEP(all_cells, nodes, rows, patches, constants, context.dt)
    is_first = context.is_first[..., None, None, None]
    links, extra = made.cells[:, : where.num_bodies], made.cells[:, where.num_bodies :]
    x, y, z = cells.shape[2:]
    begun = constants["start"] * constants["is_cell"]
    cells, cells_low = _sum(cells, cells_low, links[:, :, :x, :y, :z], begun, is_first)
    if where.num_objects:
        gained = held.gained(objects, where, made.nodes, extra)
        start = torch.where(patches.objects.has_start > 0, patches.objects.start - constants["ambient"], 0.0)
        begun = start[..., None, None, None] * held.is_cell(objects, where)
        objects, objects_low = _sum(objects, objects_low, gained, begun, is_first)
    calm = context.is_first
    got, nodes_got = (tuple(torch.where(calm, 0.0, part) for part in parts) for parts in (made.got, made.nodes_got))
    num = where.num_bodies
    total = cells.sum(dim=(-3, -2, -1)) + cells_low.sum(dim=(-3, -2, -1))
    of_links = tuple(part[:, :num] for part in got)
    mean = total / constants["number"]
    of_objects = held.account(objects + objects_low, patches, rows.capacity, got, nodes_got, mean)
    return Heat(cells, cells_low, objects, objects_low, total * rows.capacity[:, :num], of_links, of_objects)


def _with_objects(cells: Tensor, objects: Tensor, rows: Rows) -> Tensor:
    size = num_cells(rows)
    x, y, z = size
    return torch.cat([padded(cells, size), padded(objects[..., :x, :y, :z], size)], dim=1)


def _sum(high: Tensor, low: Tensor, gained: Tensor, begun: Tensor, is_first: Tensor) -> tuple[Tensor, Tensor]:
    """Return a compensated sum, or the start (Knuth's two-sum)."""
    more = low + gained
    total = high + more
    kept = total - high
    rest = (high - (total - kept)) + (more - kept)
    return torch.where(is_first, begun, total), torch.where(is_first, 0.0, rest)


def _as_printed(
    cells: Tensor,
    nodes: Tensor,
    objects: Tensor,
    rows: Rows,
    patches: ContactPatch,
    constants: Constants,
    dt: Tensor,
) -> Stepped:
    """Return what a step does by the paper's formulas: the objects keep their temperatures."""
    where = patches.topology
    means = cells.sum(dim=(-3, -2, -1)) / is_there(rows).sum(dim=(-3, -2, -1))
    others = [objects[:, i, 0, 0, 0] if own < 0 else means[:, own] for i, own in enumerate(where.links)]
    beside = torch.stack(others, dim=1) if others else objects.flatten(1)
    spread, made, radiated, blown, touched = paper.stepped(cells, beside, rows, patches, constants, dt)
    got = tuple(part.sum(dim=(-3, -2, -1)) * rows.capacity for part in (made, radiated, blown, touched))
    idle = torch.zeros_like(nodes)
    return Stepped(spread + made + radiated + blown + touched, idle, got, (idle, idle, idle))

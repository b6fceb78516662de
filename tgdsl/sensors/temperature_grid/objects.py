"""What the objects hold: their temperatures in one batch, whether of one temperature or divided into cells.

Shapes: `env` environments, `object` objects; `x`, `y`, `z` cells of the one with most; `node` objects of one temperature.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tgdsl.quantities.patches import ContactPatch, Topology
from tgdsl.sensors.temperature_grid.rows import padded


def gained(objects: Tensor, where: Topology, nodes: Tensor, grids: Tensor) -> Tensor:
    """Return what each object's cells gained (env, object, x, y, z) [K].

    Args:
        objects: Their temperatures, for the shape.
        where: Which object is what.
        nodes: Gains of those of one temperature (env, node).
        grids: Gains of those with cells (env, grid, …), padded to the links' cells too.
    """
    if where.is_plain and objects.shape[2:].numel() == 1:
        return nodes[:, :, None, None, None]
    size, parts = tuple(objects.shape[-3:]), []
    x, y, z = size
    none = torch.zeros_like(objects[:, 0])
    for i in range(where.num_objects):
        if i in where.lumped:
            parts.append(padded(nodes[:, where.lumped.index(i), None, None, None], (x, y, z)))
        elif i in where.grids:
            parts.append(grids[:, where.grids.index(i), :x, :y, :z])
        else:
            parts.append(none)  # a link of the sensor
    return torch.stack(parts, dim=1)


def is_cell(objects: Tensor, where: Topology) -> Tensor:
    """Return 1 for the cells that each object has (object, x, y, z)."""
    result = torch.zeros(objects.shape[1:], dtype=objects.dtype, device=objects.device)
    for i, (x, y, z) in enumerate(where.cells):
        if where.links[i] < 0:
            result[i, :x, :y, :z].fill_(1.0)
    return result


def account(
    objects: Tensor,
    patches: ContactPatch,
    capacity: Tensor,
    got: tuple[Tensor, ...],
    nodes_got: tuple[Tensor, ...],
    links: Tensor,
) -> tuple[Tensor, ...]:
    """Return mean temperature [K], what they hold, and got from radiation, convection and contact [J], (env, object) each.

    Args:
        objects: Temperatures of their cells (env, object, x, y, z).
        patches: What they are made of.
        capacity: Heat capacity of a row's cells (env, row) [J/K].
        got: What rows got from source, radiation, convection and contact (env, row) each [J].
        nodes_got: What nodes got from the last three (env, node) each [J].
        links: Mean temperature of the links (env, link) [K].
    """
    where = patches.topology
    if not where.num_objects:
        return ()
    heat = patches.objects.volumetric_heat * patches.objects.volume
    if where.is_plain:
        own = objects[:, :, 0, 0, 0]
        return own, own * torch.where(torch.isfinite(heat), heat, 0.0), *nodes_got
    columns: list[tuple[Tensor, ...]] = []
    for i in range(where.num_objects):
        if i in where.lumped:
            own = objects[:, i, 0, 0, 0]
            capacity_of = torch.where(torch.isfinite(heat[:, i]), heat[:, i], 0.0)
            columns.append((own, own * capacity_of, *(part[:, where.lumped.index(i)] for part in nodes_got)))
        elif i in where.grids:
            row, cells = where.num_bodies + where.grids.index(i), where.cells[i]
            total = objects[:, i].sum(dim=(-3, -2, -1))
            mean = total / (cells[0] * cells[1] * cells[2])
            columns.append((mean, total * capacity[:, row], *(part[:, row] for part in got[1:])))
        else:  # a link of the sensor, whose own report has its heat
            own = links[:, where.links[i]]
            columns.append((own, *[torch.zeros_like(own)] * 4))
    return tuple(torch.stack(part, dim=1) for part in zip(*columns, strict=True))

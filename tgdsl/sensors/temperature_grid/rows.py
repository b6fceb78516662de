"""Rows of cells: the links of a sensor, and the objects that are divided into cells, as one batch.

Shapes: `env` environments, or 1 where all are alike; `row` links, then objects with cells; `x`, `y`, `z` cells of the largest.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.quantities.patches import ContactPatch, Topology
from tgdsl.sensors.base import Constants
from tgdsl.sensors.temperature_grid.diffusion import Modes


class Boxes(NamedTuple):
    """Boxes of rows, planes (row,): lowest corner, sides and cells' sides [m]; number of cells along each axis."""

    corner: Vec
    size: Vec
    step: Vec
    cells: Vec


class Rows(NamedTuple):
    """Materials, cells and modes of rows."""

    conductivity: Tensor  # k (env, row) [W/(m·K)]
    diffusivity: Tensor  # α = k/(ρc) (env, row) [m²/s]
    capacity: Tensor  # heat capacity of a cell (env, row) [J/K]
    emissivity: Tensor | None  # ε (env, row) [1]; None if nothing radiates
    ends: Vec  # how many exposed faces across an axis cells along it have (row, cell)
    resistance: Vec  # resistance between a cell and such a face (env, row) [m²·K/W]: see `losses`
    film: Vec | None  # heat transfer coefficient of the modes at such a face (row,) [W/(m²·K)]; None: no loss
    film_radiated: Tensor | None  # the share of it that is radiation (row,) [1]
    boxes: Boxes  # the boxes
    modes: tuple[Modes, Modes, Modes]  # modes along each axis

    @property
    def rates(self) -> tuple[Tensor, Tensor, Tensor]:
        """Diffusivity over the square of a cell's side, along each axis (env, row) [1/s]."""
        x, y, z = (self.diffusivity / (step * step) for step in self.boxes.step)
        return x, y, z


def num_cells(rows: Rows) -> tuple[int, int, int]:
    """Return how many cells there are along each axis, padded."""
    x, y, z = (ends.shape[-1] for ends in rows.ends)
    return x, y, z


def rows_of(constants: Constants, patches: ContactPatch, is_smooth: bool) -> Rows:
    """Return the rows of a sensor.

    Args:
        constants: Constants from `lower`.
        patches: The links' contact patches, and the materials there.
        is_smooth: Whether modes decay like the continuous solid's.
    """
    objects, grids = patches.objects, list(patches.topology.grids)
    tables, size = dict(constants), patches.boxes[:, 1] - patches.boxes[:, 0]
    corner = patches.boxes[:, 0]
    k, heat = constants["conductivity"][None], constants["volumetric_heat"][None]
    emissivity = constants["emissivity"][None] if "emissivity" in constants else None
    if grids:
        tables = {name: _joined(constants[name], table) for name, table in patches.cells.items()}
        size = torch.cat([size, torch.stack([part[grids] for part in objects.size], dim=-1)])
        corner = torch.cat([corner, torch.stack([part[grids] for part in objects.corner], dim=-1)])
        k, heat = (_beside(link, part[:, grids]) for link, part in ((k, objects.conductivity), (heat, objects.volumetric_heat)))
        emissivity = None if emissivity is None else _beside(emissivity, objects.emissivity[:, grids])
    count = planes.split(tables["count"])
    sides = planes.split(size)
    step = planes.vec(side / n for side, n in zip(sides, count, strict=True))
    boxes = Boxes(planes.split(corner), sides, step, count)
    name = "smooth" if is_smooth else "square"
    ends = planes.vec(tables[f"ends_{axis}"] for axis in "xyz")
    resistance = (d / (2.0 * k) * (1.0 - end.sum(dim=-1) / (3.0 * n)) for d, n, end in zip(step, count, ends, strict=True))
    film, radiated = None, None
    if "film" in constants:
        # The modes of objects lose nothing.
        film = planes.vec(pad(part, (0, len(grids))) for part in planes.split(constants["film"]))
        radiated = pad(constants["film_radiated"], (0, len(grids)))
    modes = [Modes(*(tables[f"{part}_{axis}"] for part in ("mode", "total", name))) for axis in "xyz"]
    return Rows(
        conductivity=k,
        diffusivity=k / heat,
        capacity=heat * tables["volume"],
        emissivity=emissivity,
        ends=ends,
        resistance=planes.vec(resistance),
        film=film,
        film_radiated=radiated,
        boxes=boxes,
        modes=(modes[0], modes[1], modes[2]),
    )


def is_there(rows: Rows) -> Tensor:
    """Return 1 for the cells that a row has (row, x, y, z)."""
    parts = []
    for axis, size in enumerate(num_cells(rows)):
        place = torch.arange(size, device=rows.ends[0].device)
        parts.append((place[None] < rows.boxes.cells[axis][:, None]).to(rows.ends[0].dtype))
    return of_cells(parts[0], 0) * of_cells(parts[1], 1) * of_cells(parts[2], 2)


def of_cells(values: Tensor, axis: int) -> Tensor:
    """Return values of cells along an axis (row, cell), such that they multiply cells (row, x, y, z)."""
    shape = [len(values), 1, 1, 1]
    shape[1 + axis] = -1
    return values.reshape(shape)


def padded(cells: Tensor, num_cells: tuple[int, int, int]) -> Tensor:
    """Return cells (…, x, y, z) with more of them, of value 0."""
    lack = [want - size for want, size in zip(num_cells, cells.shape[-3:], strict=True)]
    return pad(cells, (0, lack[2], 0, lack[1], 0, lack[0])) if any(lack) else cells


def _beside(links: Tensor, objects: Tensor) -> Tensor:
    return torch.cat([links.expand(len(objects), -1), objects], dim=1)


def _joined(links: Tensor, objects: Tensor) -> Tensor:
    """Return two tables concatenated along rows, each padded with zeros to the larger shape."""
    shape = [max(a, b) for a, b in zip(links.shape[1:], objects.shape[1:], strict=True)]
    parts = []
    for table in (links, objects):
        lack = [want - size for want, size in zip(shape, table.shape[1:], strict=True)]
        parts.append(pad(table, [n for lacking in reversed(lack) for n in (0, lacking)]))
    return torch.cat(parts)


def gained_by_objects(objects: Tensor, where: Topology, nodes: Tensor, grids: Tensor) -> Tensor:
    """Return what each object's cells gained (env, object, x, y, z) [K].

    Args:
        objects: Their temperatures, for the shape.
        where: Which object is what.
        nodes: Gains of objects of one temperature (env, node).
        grids: Gains of objects with cells (env, grid, …), padded to the links' cells too.
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


def is_object_cell(objects: Tensor, where: Topology) -> Tensor:
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
    """Return mean temperature [K], stored heat, and heat from radiation, convection and contact [J], (env, object) each.

    Args:
        objects: Temperatures of their cells (env, object, x, y, z).
        patches: Contact patches with the objects' materials.
        capacity: Heat capacity of a row's cells (env, row) [J/K].
        got: Heat of rows from source, radiation, convection and contact (env, row) each [J].
        nodes_got: Heat of nodes from the last three (env, node) each [J].
        links: Mean temperature of the links (env, link) [K].
    """
    where = patches.topology
    if not where.num_objects:
        return ()
    heat = patches.objects.volumetric_heat * patches.objects.volume
    if where.is_plain:
        temperature = objects[:, :, 0, 0, 0]
        return temperature, temperature * torch.where(torch.isfinite(heat), heat, 0.0), *nodes_got
    columns: list[tuple[Tensor, ...]] = []
    for i in range(where.num_objects):
        if i in where.lumped:
            temperature = objects[:, i, 0, 0, 0]
            capacity_of = torch.where(torch.isfinite(heat[:, i]), heat[:, i], 0.0)
            columns.append((temperature, temperature * capacity_of, *(part[:, where.lumped.index(i)] for part in nodes_got)))
        elif i in where.grids:
            row, cells = where.num_bodies + where.grids.index(i), where.cells[i]
            total = objects[:, i].sum(dim=(-3, -2, -1))
            mean = total / (cells[0] * cells[1] * cells[2])
            columns.append((mean, total * capacity[:, row], *(part[:, row] for part in got[1:])))
        else:  # a link of the sensor, whose own report has its heat
            temperature = links[:, where.links[i]]
            columns.append((temperature, *[torch.zeros_like(temperature)] * 4))
    return tuple(torch.stack(part, dim=1) for part in zip(*columns, strict=True))

"""A step of all cells and bodies: contact, losses, sources and conduction, one after the other.

Shapes: `env` environments, `row` links, then objects that are divided into cells; `node` objects of one temperature; `x`, `y`,
`z` cells.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tgdsl.quantities.patches import ContactPatch
from tgdsl.sensors.base import Constants
from tgdsl.sensors.temperature_grid import conduction, diffusion, losses
from tgdsl.sensors.temperature_grid.patch_flow import patch_area, patch_flow, resistance
from tgdsl.sensors.temperature_grid.rows import Rows, is_there, num_cells, padded
from tgdsl.tensors.operations import Operation

LARGEST_BLOCK = 2048
"""Rows × sides × cells, each the next power of two, that the kernel takes."""


class Stepped(NamedTuple):
    """What a step does.

    Attributes:
        cells: What the cells gain (env, row, x, y, z) [K].
        nodes: What the nodes gain (env, node) [K].
        got: What rows got from source, radiation, convection and contact (env, row) each [J].
        nodes_got: What nodes got from radiation, convection and contact (env, node) each [J].
    """

    cells: Tensor
    nodes: Tensor
    got: tuple[Tensor, ...]
    nodes_got: tuple[Tensor, ...]


def step(cells: Tensor, nodes: Tensor, rows: Rows, patches: ContactPatch, constants: Constants, dt: Tensor) -> Stepped:
    """Return what a step does.

    Args:
        cells: Temperatures of the rows' cells above ambient (env, row, x, y, z) [K].
        nodes: Those of the objects of one temperature (env, node) [K].
        rows: What the rows are made of.
        patches: What links touch, and what that is made of.
        constants: What `lower` folded.
        dt: Δt [s].
    """
    gained, nodes_gained = torch.zeros_like(cells), torch.zeros_like(nodes)
    touched, inverse = torch.zeros_like(cells[:, :, 0, 0, 0]), _of_nodes(patches, _inverse(patches))
    if patches.topology.met:
        flow = dt * patch_flow(patches, rows, constants)
        sides = conduction.Sides(patches.sides, patches.topology.is_plain)
        # Sums, and no views of what the module overwrites: derivatives are taken of them later.
        before = cells + gained, nodes + nodes_gained
        gained, nodes_gained = conduction.step(*before, rows.capacity, inverse, flow, sides)
        touched = gained.sum(dim=(-3, -2, -1)) * rows.capacity
    touched_nodes = _joules(nodes_gained, inverse)
    cooling, of_nodes = _surfaces(rows, patches, inverse, constants)
    lost, share = losses.lost(cells + gained, cooling, dt)
    nodes_lost, nodes_share = losses.lost(nodes + nodes_gained, of_nodes, dt)
    gained, nodes_gained = gained + lost, nodes_gained + nodes_lost
    source = torch.zeros_like(touched)
    if "source" in constants:
        made = 0.5 * dt * _made(rows, patches, constants) / rows.capacity[..., None, None, None]
        source = source + 2.0 * made.sum(dim=(-3, -2, -1)) * rows.capacity
        gained = gained + made
        gained = gained + diffused(cells + gained, rows, constants, dt) + made
    else:
        gained = gained + diffused(cells + gained, rows, constants, dt)
    radiated = lost * share
    got = (source, *(part.sum(dim=(-3, -2, -1)) * rows.capacity for part in (radiated, lost - radiated)), touched)
    radiated_nodes = nodes_lost * nodes_share
    own = (*(_joules(part, inverse) for part in (radiated_nodes, nodes_lost - radiated_nodes)), touched_nodes)
    return Stepped(gained, nodes_gained, got, own)


def _surfaces(
    rows: Rows, patches: ContactPatch, inverse: Tensor, constants: Constants
) -> tuple[losses.Surfaces, losses.Surfaces]:
    """Return what cells and nodes lose heat by."""
    blown, around = constants.get("convection"), constants["ambient"]
    area = rows.outer / rows.capacity[..., None, None, None]
    own_area = _of_nodes(patches, patches.objects.area) * inverse
    if rows.emissivity is None:
        return losses.Surfaces(area, None, blown, around), losses.Surfaces(own_area, None, blown, around)
    glowing = rows.emissivity[..., None, None, None], _of_nodes(patches, patches.objects.emissivity)
    return losses.Surfaces(area, glowing[0], blown, around), losses.Surfaces(own_area, glowing[1], blown, around)


def _of_nodes(patches: ContactPatch, of_objects: Tensor) -> Tensor:
    """Return what objects (env, object) have, of those of one temperature."""
    where = patches.topology
    return of_objects if where.is_plain else of_objects[:, list(where.lumped)]


def _made(rows: Rows, patches: ContactPatch, constants: Constants) -> Tensor:
    """Return the heat that is made in each cell (row, x, y, z) [W]; objects make none."""
    made, more = padded(constants["source"], num_cells(rows)), len(patches.topology.grids)
    return torch.cat([made, made.new_zeros((more, *made.shape[1:]))]) if more else made


def diffused(cells: Tensor, rows: Rows, constants: Constants, dt: Tensor) -> Tensor:
    """Return what cells gain by conduction within their row [K]."""
    rate = rows.diffusivity * dt
    if "is_semi_implicit" in constants:
        rates = torch.stack([rate / (side * side) for side in rows.boxes.size], dim=-1)
        gained = diffusion.semi_implicit(cells, rates, rows.cosines)
        there = is_there(rows)
        return (gained - gained.sum(dim=(-3, -2, -1), keepdim=True) / there.sum(dim=(-3, -2, -1), keepdim=True)) * there
    tables = zip(rows.boxes.step, rows.cosines, rows.exponent, strict=True)
    return diffusion.spread(cells, [diffusion.along_axis(rate / (step * step), *own) for step, *own in tables])


def _inverse(patches: ContactPatch) -> Tensor:
    """Return one over each object's heat capacity [K/J]; 0 for what keeps its temperature."""
    return 1.0 / (patches.objects.volumetric_heat * patches.objects.volume)


def _joules(gained: Tensor, inverse: Tensor) -> Tensor:
    """Return the heat of a gain of temperature [J]; that of what keeps its temperature is not known, and 0."""
    is_finite = inverse > 0
    return torch.where(is_finite, gained, 0.0) / torch.where(is_finite, inverse, 1.0)


def _by_kernel(cells: Tensor, nodes: Tensor, rows: Rows, patches: ContactPatch, constants: Constants, dt: Tensor) -> Stepped:
    """Do the same by the kernel."""
    from tgdsl.sensors.temperature_grid.step_kernel import heat_step

    area, objects = patch_area(patches, constants), patches.objects
    series = resistance(area, patches, patches.topology.lumped, constants)
    assert series is not None  # objects of one temperature have one
    source = constants.get("source")
    gained, nodes_gained, got, nodes_got = heat_step(
        [cells, nodes],
        [part.expand(len(cells), -1, -1) for part in (area, series, *patches.pos, *patches.normal)],
        [*(constants[name] for name in ("conductivity", "volumetric_heat", "volume", "box")), rows.outer],
        constants.get("emissivity"),
        source,
        [*rows.cosines, *rows.exponent],
        [objects.volumetric_heat, objects.volume, objects.area, objects.emissivity],
        [dt, constants["ambient"]],
        constants.get("convection"),
    )
    made = torch.zeros_like(got[:, 0])
    if source is not None:
        made = made + dt * constants["power"]
    return Stepped(gained, nodes_gained, (made, *got.unbind(1)), nodes_got.unbind(1))


def _inputs(cells: Tensor, nodes: Tensor, rows: Rows, patches: ContactPatch, constants: Constants, dt: Tensor) -> list[Tensor]:
    return [cells, nodes, patches.force, *patches.pos, *patches.normal, dt]


def is_small(cells: Tensor, nodes: Tensor, rows: Rows, patches: ContactPatch, constants: Constants, dt: Tensor) -> bool:
    """Return whether all objects have one temperature each, some of them may meet a link, and a program holds all numbers."""
    x, y, z = num_cells(rows)
    size = 1
    for number in (cells.shape[1], nodes.shape[1], x * y * z):
        size *= 1 << max(number - 1, 0).bit_length()
    is_met = patches.topology.is_plain and len(patches.topology.met) > 0
    return is_met and size <= LARGEST_BLOCK and "is_semi_implicit" not in constants


HEAT_STEP = Operation("heat_step", step, _by_kernel, _inputs, is_small)

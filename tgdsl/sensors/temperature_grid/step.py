"""A step of all cells and bodies: contact, radiation beyond its tangent, then conduction, linear losses and sources at once.

Shapes: `env` environments, `row` links, then objects that are divided into cells; `node` objects of one temperature; `x`, `y`,
`z` cells.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.quantities.patches import ContactPatch
from tgdsl.sensors.base import Constants, Context, State
from tgdsl.sensors.temperature_grid import conduction, diffusion, losses
from tgdsl.sensors.temperature_grid.conduction import decays, response, whole
from tgdsl.sensors.temperature_grid.losses import paper_step
from tgdsl.sensors.temperature_grid.patch_flow import patch_area, patch_flow, resistance
from tgdsl.sensors.temperature_grid.rows import (
    Rows,
    account,
    gained_by_objects,
    is_object_cell,
    is_there,
    num_cells,
    of_cells,
    padded,
    rows_of,
)
from tgdsl.tensors.operations import Operation

LARGEST_BLOCK = 2048  # rows × cells, each the next power of two, that the kernel takes


class Stepped(NamedTuple):
    """What a step does."""

    cells: Tensor  # gains of the cells (env, row, x, y, z) [K]
    nodes: Tensor  # gains of the nodes (env, node) [K]
    got: tuple[Tensor, ...]  # heat of rows from source, radiation, convection and contact (env, row) each [J]
    nodes_got: tuple[Tensor, ...]  # heat of nodes from radiation, convection and contact (env, node) each [J]


def step(cells: Tensor, nodes: Tensor, rows: Rows, patches: ContactPatch, constants: Constants, dt: Tensor) -> Stepped:
    """Return the gains of one step.

    Args:
        cells: Temperatures of the rows' cells above ambient (env, row, x, y, z) [K].
        nodes: Temperatures of the objects of one temperature (env, node) [K].
        rows: Materials of the rows.
        patches: The links' contact patches, and the materials there.
        constants: What `lower` folded.
        dt: Δt [s].
    """
    inverse = _of_nodes(patches, 1.0 / (patches.objects.volumetric_heat * patches.objects.volume))
    gained, nodes_gained = torch.zeros_like(cells), torch.zeros_like(nodes)
    # Sums, not views of buffers that the module overwrites: autograd needs the values later.
    cells, nodes = cells + gained, nodes + nodes_gained
    blown = radiated = source = touched = torch.zeros_like(cells[:, :, 0, 0, 0])
    blown_nodes = radiated_nodes = touched_nodes = torch.zeros_like(nodes)
    cooling, of_nodes = _surfaces(rows, patches, inverse, constants)
    if cooling is not None:
        gained, share = losses.lost(cells, cooling, dt)
        glow = gained * share
        radiated, blown = ((part.sum(dim=(-3, -2, -1)) * rows.capacity) for part in (glow, gained - glow))
    if of_nodes is not None:
        nodes_gained, share = losses.lost(nodes, of_nodes, dt)
        glow = nodes_gained * share
        radiated_nodes, blown_nodes = _joules(glow, inverse), _joules(nodes_gained - glow, inverse)
    generated = None
    if "source" in constants:
        generated = dt * _source(rows, patches, constants) / rows.capacity[..., None, None, None]
        source = source + generated.sum(dim=(-3, -2, -1)) * rows.capacity
    if patches.topology.met:
        spread, entered, heat, got = _in_modes(
            cells + gained, nodes + nodes_gained, rows, patches, constants, dt, inverse, generated
        )
        touched, nodes_gained = touched + heat, nodes_gained + inverse * got
        touched_nodes = torch.where(inverse > 0, got, 0.0)
    else:
        spread, entered = diffused(cells + gained, rows, constants, dt)
        if generated is not None:
            late = decays(_exponents(rows, dt), "is_semi_implicit" in constants)[1]
            more = diffusion.from_modes(diffusion.to_modes(generated, rows.modes) * late, rows.modes)
            spread, entered = spread + (generated + more.gained), entered + more.entered
    if rows.film_radiated is not None:
        linear = entered * rows.capacity
        radiated, blown = radiated + linear * rows.film_radiated, blown + linear * (1.0 - rows.film_radiated)
    return Stepped(
        gained + spread, nodes_gained, (source, radiated, blown, touched), (radiated_nodes, blown_nodes, touched_nodes)
    )


def _in_modes(
    cells: Tensor,
    nodes: Tensor,
    rows: Rows,
    patches: ContactPatch,
    constants: Constants,
    dt: Tensor,
    inverse: Tensor,
    generated: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return what conduction, linear losses, contact and a constant source [K] do together."""
    is_implicit = "is_semi_implicit" in constants
    less, capacity = decays(_exponents(rows, dt), is_implicit), rows.capacity[..., None, None, None]
    phi, parts = whole(less), diffusion.to_modes(cells, rows.modes)
    mean, change = parts * less[1], parts * less[0]
    if generated is not None:
        warmed = diffusion.to_modes(generated, rows.modes)
        mean, change = mean + warmed * less[2], change + warmed * less[1]
    free = [cells + diffusion.from_modes(part, rows.modes).gained for part in (mean, change)]
    if generated is not None:
        free = [free[0] + 0.5 * generated, free[1] + generated]
    sides, flow = conduction.Sides(patches.sides, patches.topology.is_plain), dt * patch_flow(patches, rows, constants)
    flows = conduction.step((free[0], free[1]), nodes, rows.capacity, inverse, flow, sides, phi, rows.modes, is_implicit)
    shows = response(less, flows.sigma[..., None, None, None])  # without the parts that do not decay, 1 and 0
    heat, rate = flows.heat / capacity, flows.rate / capacity
    change = change + diffusion.to_modes(heat, rows.modes) * shows.end_of_heat
    change = change + diffusion.to_modes(rate, rows.modes) * shows.end_of_rate
    total = heat if generated is None else heat + generated
    spread, entered = diffusion.from_modes(change, rows.modes)
    return total + spread, entered, flows.heat.sum(dim=(-3, -2, -1)), flows.nodes


def _surfaces(
    rows: Rows, patches: ContactPatch, inverse: Tensor, constants: Constants
) -> tuple[losses.Surfaces | None, losses.Surfaces | None]:
    """Return what cells and nodes lose heat by beyond what modes do; None where that is nothing."""
    blown, around = constants.get("convection"), constants["ambient"]
    if rows.emissivity is None and blown is None:
        return None, None
    faces = []
    for axis, (ends, inner, step) in enumerate(zip(rows.ends, rows.resistance, rows.boxes.step, strict=True)):
        per_face = rows.diffusivity / (rows.conductivity * step)
        area = per_face[..., None, None, None] * of_cells(ends, axis) * is_there(rows)
        film = radiated = None
        if rows.film is not None and rows.film_radiated is not None:
            film, radiated = rows.film[axis][:, None, None, None], rows.film_radiated[:, None, None, None]
        faces.append(losses.Face(area, inner[..., None, None, None], film, radiated))
    volume = _of_nodes(patches, patches.objects.volume)
    is_finite = torch.isfinite(volume)
    width = planes.power(torch.where(is_finite, volume, 1.0), 1.0 / 3.0)
    face = losses.Face(
        _of_nodes(patches, patches.objects.area) * inverse, width / (6.0 * _of_nodes(patches, patches.objects.conductivity))
    )
    if rows.emissivity is None:
        # Without radiation the modes of links lose all.
        cells = losses.Surfaces(tuple(faces), None, blown, around) if patches.topology.grids else None
        return cells, losses.Surfaces((face,), None, blown, around)
    glowing = rows.emissivity[..., None, None, None], _of_nodes(patches, patches.objects.emissivity)
    return losses.Surfaces(tuple(faces), glowing[0], blown, around), losses.Surfaces((face,), glowing[1], blown, around)


def _of_nodes(patches: ContactPatch, of_objects: Tensor) -> Tensor:
    where = patches.topology
    return of_objects if where.is_plain else of_objects[:, list(where.lumped)]


def _source(rows: Rows, patches: ContactPatch, constants: Constants) -> Tensor:
    source, more = padded(constants["source"], num_cells(rows)), len(patches.topology.grids)
    return torch.cat([source, source.new_zeros((more, *source.shape[1:]))]) if more else source


def diffused(cells: Tensor, rows: Rows, constants: Constants, dt: Tensor) -> diffusion.Spread:
    """Return what conduction within rows, and linear losses of their faces, do in a step [K]."""
    if "is_semi_implicit" in constants:
        return diffusion.semi_implicit(cells, _exponents(rows, dt), rows.modes)
    return diffusion.spread(
        cells, [diffusion.along_axis(dt * rate, basis) for rate, basis in zip(rows.rates, rows.modes, strict=True)]
    )


def _exponents(rows: Rows, dt: Tensor) -> Tensor:
    return (dt * rows.diffusivity)[..., None, None, None] * diffusion.squared_wavenumbers(rows.boxes.step, rows.modes)


def _joules(gained: Tensor, inverse: Tensor) -> Tensor:
    is_finite = inverse > 0
    return torch.where(is_finite, gained, 0.0) / torch.where(is_finite, inverse, 1.0)


def _by_kernel(cells: Tensor, nodes: Tensor, rows: Rows, patches: ContactPatch, constants: Constants, dt: Tensor) -> Stepped:
    """Do the same by the kernel."""
    from tgdsl.sensors.temperature_grid.step_kernel import heat_step

    area, objects = patch_area(patches, constants), patches.objects
    series = resistance(area, patches, patches.topology.lumped, constants)
    assert series is not None  # objects of one temperature have one
    source = constants.get("source")
    less = [part[0].flatten(1) for part in decays(_exponents(rows, dt), is_implicit=False)]
    gained, nodes_gained, got, nodes_got = heat_step(
        [cells, nodes],
        [part.expand(cells.shape[0], -1, -1) for part in (area, series, *patches.pos, *patches.normal)],
        [*(constants[name] for name in ("conductivity", "volumetric_heat", "volume", "box")), *rows.ends],
        constants.get("film"),
        constants.get("film_radiated"),
        constants.get("emissivity"),
        source,
        [*(basis.vectors for basis in rows.modes), *(basis.totals for basis in rows.modes), *less],
        [objects.volumetric_heat, objects.volume, objects.area, objects.conductivity, objects.emissivity],
        [dt, constants["ambient"]],
        constants.get("convection"),
    )
    generated = torch.zeros_like(got[:, 0])
    if source is not None:
        generated = generated + dt * constants["power"]
    return Stepped(gained, nodes_gained, (generated, *got.unbind(1)), nodes_got.unbind(1))


def _inputs(cells: Tensor, nodes: Tensor, rows: Rows, patches: ContactPatch, constants: Constants, dt: Tensor) -> list[Tensor]:
    return [cells, nodes, patches.force, *patches.pos, *patches.normal, dt]


def is_small(cells: Tensor, nodes: Tensor, rows: Rows, patches: ContactPatch, constants: Constants, dt: Tensor) -> bool:
    """Return whether there is one object, of one temperature, that may meet a link, and a program holds all numbers."""
    x, y, z = num_cells(rows)
    size = 1
    for number in (cells.shape[1], x * y * z):
        size *= 1 << max(number - 1, 0).bit_length()
    is_met = patches.topology.is_plain and nodes.shape[1] == 1 and len(patches.topology.met) > 0
    return is_met and size <= LARGEST_BLOCK and "is_semi_implicit" not in constants


HEAT_STEP = Operation("heat_step", step, _by_kernel, _inputs, is_small)


class Heat(NamedTuple):
    """Temperatures above ambient, and heat, after a step."""

    cells: Tensor  # temperatures of the links' cells (env, link, x, y, z); `cells_low` has their low parts [K]
    cells_low: Tensor  # see `cells`
    objects: Tensor  # the same of the objects' cells, (env, object, x, y, z); of an object of one temperature the first
    objects_low: Tensor  # low parts of the compensated sums [K]
    stored: Tensor  # heat stored in links (env, link) [J]
    gained: tuple[Tensor, ...]  # their heat from source, radiation, convection and contact, (env, link) each [J]
    # mean temperature [K], stored heat, and heat from radiation, convection and contact [J], (env, object) each; empty
    # without objects
    of_objects: tuple[Tensor, ...]


def advanced(patches: ContactPatch, context: Context, constants: Constants, state: State) -> Heat:
    """Return what there is at a call; at the first one after a reset that is the start."""
    rows = rows_of(constants, patches, any(f"is_{name}" in constants for name in ("spectral", "semi_implicit", "paper")))
    where, lumped, grids = patches.topology, list(patches.topology.lumped), list(patches.topology.grids)
    cells, cells_low = state["cells"], state["cells_low"]
    objects = objects_low = cells.new_zeros((cells.shape[0], 0, 1, 1, 1))
    if where.num_objects:
        most = [max(count[axis] for count in where.cells) for axis in range(3)]
        objects, objects_low = (state[name].reshape(cells.shape[0], -1, *most) for name in ("objects", "objects_low"))
    all_cells = _with_objects(cells, objects[:, grids], rows) if grids else cells
    nodes = objects[:, :, 0, 0, 0] if where.is_plain else objects[:, lumped, 0, 0, 0]
    if "is_paper" in constants:
        stepped = _as_printed(all_cells, nodes, objects, rows, patches, constants, context.dt)
    else:
        stepped = HEAT_STEP(all_cells, nodes, rows, patches, constants, context.dt)
    is_first = context.is_first[..., None, None, None]
    links, extra = stepped.cells[:, : where.num_bodies], stepped.cells[:, where.num_bodies :]
    x, y, z = cells.shape[2:]
    begun = constants["start"] * constants["is_cell"]
    cells, cells_low = _sum(cells, cells_low, links[:, :, :x, :y, :z], begun, is_first)
    if where.num_objects:
        gained = gained_by_objects(objects, where, stepped.nodes, extra)
        start = torch.where(patches.objects.has_start > 0, patches.objects.start - constants["ambient"], 0.0)
        begun = start[..., None, None, None] * is_object_cell(objects, where)
        objects, objects_low = _sum(objects, objects_low, gained, begun, is_first)
    calm = context.is_first
    got, nodes_got = (tuple(torch.where(calm, 0.0, part) for part in parts) for parts in (stepped.got, stepped.nodes_got))
    num = where.num_bodies
    total = cells.sum(dim=(-3, -2, -1)) + cells_low.sum(dim=(-3, -2, -1))
    of_links = tuple(part[:, :num] for part in got)
    mean = total / constants["number"]
    of_objects = account(objects + objects_low, patches, rows.capacity, got, nodes_got, mean)
    return Heat(cells, cells_low, objects, objects_low, total * rows.capacity[:, :num], of_links, of_objects)


def _with_objects(cells: Tensor, objects: Tensor, rows: Rows) -> Tensor:
    size = num_cells(rows)
    x, y, z = size
    return torch.cat([padded(cells, size), padded(objects[..., :x, :y, :z], size)], dim=1)


def _sum(high: Tensor, low: Tensor, gained: Tensor, begun: Tensor, is_first: Tensor) -> tuple[Tensor, Tensor]:
    """Return a compensated sum, or the start (Knuth's two-sum)."""
    more = low + gained
    total = high + more
    added = total - high
    rest = (high - (total - added)) + (more - added)
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
    """Return the gains of a step by the paper's formulas: the objects keep their temperatures."""
    where = patches.topology
    means = cells.sum(dim=(-3, -2, -1)) / is_there(rows).sum(dim=(-3, -2, -1))
    temperatures = [objects[:, i, 0, 0, 0] if link < 0 else means[:, link] for i, link in enumerate(where.links)]
    beside = torch.stack(temperatures, dim=1) if temperatures else objects.flatten(1)
    spread, generated, radiated, blown, touched = paper_step(cells, beside, rows, patches, constants, dt)
    got = tuple(part.sum(dim=(-3, -2, -1)) * rows.capacity for part in (generated, radiated, blown, touched))
    idle = torch.zeros_like(nodes)
    return Stepped(spread + generated + radiated + blown + touched, idle, got, (idle, idle, idle))

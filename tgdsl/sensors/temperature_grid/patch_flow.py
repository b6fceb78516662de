"""How a patch joins the cells of a box: which of them, and with what conductance.

A patch is treated as a square of its area A across its normal, about its centre, moved to lie inside the box. Its temperature
is interpolated linearly between the centres of cells and constant beyond the last one: cell i has the share w_i, a product of
one factor per axis.

    G = 2 k A/d + 4 k a φ/(1 + ρ/2) · (1 + ¾ ρ (2q − 1) max(0, 1 − 2ρ)),   ρ = a/Δ,   a = √(A/π)          [W/K]

is its conductance to the cells. The first term is half a cell below the patch, d thick along the normal, in the shares w_i. The
second is the constriction of heat towards a spot smaller than a cell; Δ is the side of a cell across the normal. For a small
spot it is 4ka, an isothermal disc on a half-space; it fades as cells resolve the spot. It acts at the patch's four edges, each
with the part φ that is not within half a cell of the box's end, where heat cannot spread: it is zero for a patch that covers
the face. q = Σ w_i² across the normal tells how many cells share the spot [1]. The term ρ/2 follows from the resistance of the
cells' grid at large ρ. The last factor was fitted to that grid's Green's function: a disc on a half-space of cells has its
closed-form resistance 1/4ka to 1.5 %, for Δ from a/4 to 10 a and any position.

Source: Carslaw and Jaeger, *Conduction of Heat in Solids*, 8.2, for the disc.

Shapes: `env` environments, `row` rows of cells, `side` sides of patches on each, `cell` cells along an axis.

Areas of patches, and the resistances in series with the cells of a link:

    A = max(A_polygon, π (3 F / (4 E* κ))^(2/3)),   1/E* = (1 − ν₁²)/E₁ + (1 − ν₂²)/E₂,   κ = 1/R₁ + 1/R₂     [m²]
    G_o = 2 k_o A/D + 4 k_o a φ/(1 + a/2D),   D = V^(1/3),   φ = max(0, 1 − √A/D)                            [W/K]

G_o is the conductance of a body of one temperature from the patch to its middle: the formula of `conductances` for a cube of
its volume in one cell. Source: Johnson, *Contact Mechanics*, 4.2.

Shapes: `env` environments, `body` links, `object` objects, `row` rows of cells, `side` sides of patches on each.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.quantities.patches import ContactPatch
from tgdsl.sensors.base import Constants
from tgdsl.sensors.temperature_grid.rows import Boxes, Rows, num_cells


def least_width() -> float:
    """Return the least half-width of a patch along an axis [cells]; a smaller patch has a point's shares."""
    return 0.05


class Axis(NamedTuple):
    """Along one axis: shares of cells and of both edges (…, cell), Σ w², and the part of the patch that is in the box [1]."""

    shares: Tensor
    edges: Tensor
    squared: Tensor
    within: Tensor


def conductances(
    area: Tensor, pos: Vec, normal: Vec, conductivity: Tensor, boxes: Boxes, num_cells: tuple[int, int, int]
) -> Tensor:
    """Return the conductance between each side of a patch and each cell (env, row, side, x, y, z) [W/K].

    Args:
        area: Area of each patch (env, row, side) [m²]; 0 where there is none.
        pos: Its centre in the row's frame, planes [m].
        normal: Its unit normal, planes.
        conductivity: k of each row (env, row) [W/(m·K)].
        boxes: The rows' boxes.
        num_cells: Cells along each axis, padded.
    """
    is_any = area > 0
    safe = torch.where(is_any, area, 1e-6)
    side, across, parts = torch.sqrt(safe), planes.vec((1.0 - n * n).clamp(min=0.0) for n in normal), []
    for a in range(3):
        corner, step, count = (value[..., None] for value in (boxes.corner[a], boxes.step[a], boxes.cells[a]))
        half = 0.5 * side * planes.safe_sqrt(across[a])
        parts.append(_along((pos[a] - corner) / step, half / step, count, num_cells[a]))
    within = parts[0].within * parts[1].within * parts[2].within
    fit = safe * within
    k = conductivity[..., None]
    depth = sum(n * n * step[..., None] for n, step in zip(normal, boxes.step, strict=True))
    volume = (boxes.step[0] * boxes.step[1] * boxes.step[2])[..., None]
    radius = torch.sqrt(fit / planes.pi())
    rho = radius * torch.sqrt(depth / volume)
    few = torch.ones_like(area)
    for part, weight in zip(parts, across, strict=True):
        few = few * (1.0 - weight * (1.0 - part.squared))
    fitted = 1.0 + 0.75 * rho * (2.0 * few - 1.0) * (1.0 - 2.0 * rho).clamp(min=0.0)
    cover = torch.where(is_any, 2.0 * k * fit / depth, 0.0)
    spot = torch.where(is_any, 4.0 * k * radius / (1.0 + 0.5 * rho) * fitted, 0.0)
    return _spread(cover, spot, across, parts)


def _spread(cover: Tensor, spot: Tensor, across: Vec, parts: list[Axis]) -> Tensor:
    """Return conductances per cell: `cover` distributed by the shares, `spot` at the edges."""
    (x, y, z), (ex, ey, ez) = ([getattr(part, name) for part in parts] for name in ("shares", "edges"))
    x, ex = (part[..., :, None, None] for part in (x, ex))
    y, ey = (part[..., None, :, None] for part in (y, ey))
    z, ez = (part[..., None, None, :] for part in (z, ez))
    tx, ty, tz = ((0.5 * spot * weight)[..., None, None, None] for weight in across)
    body = cover[..., None, None, None]
    return x * (y * (body * z + tz * ez) + ty * ey * z) + tx * ex * y * z


def _along(centre: Tensor, half: Tensor, length: Tensor, num_cells: int) -> Axis:
    """Return a patch's shares and edges along one axis; all lengths in cells."""
    is_wide = half > 0
    middle = 0.5 * length
    fits = torch.minimum(half, middle)
    within = torch.where(is_wide, fits / torch.where(is_wide, half, 1.0), 1.0)
    width = torch.minimum(fits.clamp(min=least_width()), middle)
    centre = torch.minimum(torch.maximum(centre, fits), length - fits)
    about = torch.minimum(torch.maximum(centre, width), length - width)
    place = torch.arange(num_cells, device=half.device, dtype=half.dtype) + 0.5
    top = length - 0.5
    low, high = about - width, about + width
    covered = _below(_clamped(high, top)[..., None] - place) - _below(_clamped(low, top)[..., None] - place)
    before_first = (0.5 - low).clamp(min=0.0) - (0.5 - high).clamp(min=0.0)
    after = (high - top).clamp(min=0.0) - (low - top).clamp(min=0.0)
    is_last = (place - top[..., None]).abs() < 0.25
    covered = covered + torch.where(place < 1.0, before_first[..., None], 0.0) + torch.where(is_last, after[..., None], 0.0)
    shares = covered / (2.0 * width)[..., None]
    ends = centre - fits, centre + fits
    is_open = (2.0 * ends[0]).clamp(0.0, 1.0), (2.0 * (length - ends[1])).clamp(0.0, 1.0)
    at = [(1.0 - (_clamped(end, top)[..., None] - place).abs()).clamp(min=0.0) for end in ends]
    edges = 0.5 * (is_open[0][..., None] * at[0] + is_open[1][..., None] * at[1])
    return Axis(shares, edges, (shares * shares).sum(dim=-1), within)


def _clamped(point: Tensor, top: Tensor) -> Tensor:
    return torch.minimum(point.clamp(min=0.5), top)


def _below(offset: Tensor) -> Tensor:
    offset = offset.clamp(-1.0, 1.0)
    return offset * (1.0 - 0.5 * offset.abs())


def patch_area(patches: ContactPatch, constants: Constants) -> Tensor:
    """Return the area of each patch (env, body, object) [m²]; 0 where they do not touch."""
    if "contact_area" in constants:
        return torch.where(patches.force > 0, constants["contact_area"], 0.0)
    compliance = constants["compliance"][:, None] + patches.objects.compliance[:, None, :]
    curvature = constants["curvature"][:, None] + patches.objects.curvature[:, None, :]
    cubed = 0.75 * patches.force * compliance / curvature
    return torch.maximum(patches.area, planes.pi() * planes.power(cubed, 2.0 / 3.0))


def patch_flow(patches: ContactPatch, rows: Rows, constants: Constants) -> Tensor:
    """Return the conductance between each side and each cell of its row (env, row, side, x, y, z) [W/K].

    Args:
        patches: Which there are.
        rows: Materials of the rows.
        constants: What `lower` folded.
    """
    area = patch_area(patches, constants)
    pos, normal = (planes.vec(_of_sides(patches, part) for part in vector) for vector in (patches.pos, patches.normal))
    if patches.object_pos is not None and patches.object_normal is not None:
        is_object = patches.sides["is_object"] > 0
        pos = planes.where(is_object, planes.vec(_of_sides(patches, part) for part in patches.object_pos), pos)
        normal = planes.where(is_object, planes.vec(_of_sides(patches, part) for part in patches.object_normal), normal)
    of_sides = _of_sides(patches, area)
    result = conductances(of_sides, pos, normal, rows.conductivity, rows.boxes, num_cells(rows))
    series = resistance(area, patches, patches.topology.lumped, constants)
    if series is None:
        return result
    whole = result.sum(dim=(-3, -2, -1))
    return result / (1.0 + whole * _of_sides(patches, series))[..., None, None, None]


def _of_sides(patches: ContactPatch, plane: Tensor) -> Tensor:
    return plane if patches.topology.is_plain else pad(plane.flatten(1), (0, 1))[:, patches.sides["pair"]]


def resistance(area: Tensor, patches: ContactPatch, lumped: tuple[int, ...], constants: Constants) -> Tensor | None:
    """Return what stands in series with a link's cells (env, body, object) [K/W]; None if nothing does."""
    safe = torch.where(area > 0, area, 1e-6)
    series = torch.zeros_like(area)
    if lumped:
        inside = _inside(safe, patches)
        count = area.shape[-1]
        is_lumped = [1.0 if i in lumped else 0.0 for i in range(count)]
        series = inside if all(is_lumped) else inside * _of_objects(is_lumped, area)
    if "contact_conductance" in constants:
        film = 1.0 / (constants["contact_conductance"] * safe)
        halves = [1.0 if i in lumped else 0.5 for i in range(area.shape[-1])]
        series = series + (film if all(h == 1.0 for h in halves) else film * _of_objects(halves, area))
    elif not lumped:
        return None
    return series


def _of_objects(factors: list[float], like: Tensor) -> Tensor:
    return torch.stack([like.new_full((), factor) for factor in factors])


def _inside(area: Tensor, patches: ContactPatch) -> Tensor:
    """Return the resistance between a patch and the middle of a body of one temperature [K/W]."""
    objects = patches.objects
    k = objects.conductivity[:, None, :]
    width = planes.power(objects.volume, 1.0 / 3.0)[:, None, :]
    radius, side = torch.sqrt(area / planes.pi()), torch.sqrt(area)
    open_part = (1.0 - side / width).clamp(min=0.0)
    return 1.0 / (k * (2.0 * area / width + 4.0 * radius * open_part / (1.0 + 0.5 * radius / width)))

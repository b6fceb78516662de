"""From patches to conductances: their areas, and what stands in series with the cells of a link.

    A = max(A_polygon, π (3 F / (4 E* κ))^(2/3)),   1/E* = (1 − ν₁²)/E₁ + (1 − ν₂²)/E₂,   κ = 1/R₁ + 1/R₂     [m²]
    G_o = 2 k_o A/D + 4 k_o a φ/(1 + a/2D),   D = V^(1/3),   φ = max(0, 1 − √A/D)                            [W/K]

G_o is what a body of one temperature conducts from the patch to its middle, by the formula of `shares` for a cube of its volume
in one cell. Source: Johnson, *Contact Mechanics*, 4.2.

Shapes: `env` environments, `body` links, `object` objects, `row` rows of cells, `side` sides of patches on each.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from tgdsl.geometry import planes
from tgdsl.quantities.patches import ContactPatch
from tgdsl.sensors.base import Constants
from tgdsl.sensors.temperature_grid.rows import Rows, num_cells
from tgdsl.sensors.temperature_grid.shares import conductances


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
    """Return what each side has of a plane (env, body, object), as (env, row, side); 0 where there is none."""
    return plane if patches.topology.is_plain else pad(plane.flatten(1), (0, 1))[:, patches.sides["pair"]]


def resistance(area: Tensor, patches: ContactPatch, lumped: tuple[int, ...], constants: Constants) -> Tensor | None:
    """Return what stands in series with a link's cells (env, body, object) [K/W]; None if nothing does."""
    safe = torch.where(area > 0, area, 1e-6)
    series = torch.zeros_like(area)
    if lumped:
        made = _inside(safe, patches)
        count = area.shape[-1]
        is_lumped = [1.0 if i in lumped else 0.0 for i in range(count)]
        series = made if all(is_lumped) else made * _of_objects(is_lumped, area)
    if "contact_conductance" in constants:
        film = 1.0 / (constants["contact_conductance"] * safe)
        halves = [1.0 if i in lumped else 0.5 for i in range(area.shape[-1])]
        series = series + (film if all(h == 1.0 for h in halves) else film * _of_objects(halves, area))
    elif not lumped:
        return None
    return series


def _of_objects(factors: list[float], like: Tensor) -> Tensor:
    """Return a factor of each object (object,): filled on the device, as a CUDA graph cannot hold a copy from the host."""
    return torch.stack([like.new_full((), factor) for factor in factors])


def _inside(area: Tensor, patches: ContactPatch) -> Tensor:
    """Return the resistance between a patch and the middle of a body of one temperature [K/W]."""
    objects = patches.objects
    k = objects.conductivity[:, None, :]
    width = planes.power(objects.volume, 1.0 / 3.0)[:, None, :]
    radius, side = torch.sqrt(area / planes.pi()), torch.sqrt(area)
    open_part = (1.0 - side / width).clamp(min=0.0)
    return 1.0 / (k * (2.0 * area / width + 4.0 * radius * open_part / (1.0 + 0.5 * radius / width)))

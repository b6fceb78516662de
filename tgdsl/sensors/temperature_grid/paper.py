"""The formulas of the paper as printed: `model: paper`.

    T̂ ← T̂ / (1 + α Δt k²)                                       within a link, k² at least `least_squared_wavenumber`
    ΔT = Δt q / (Δ ρc)                                           in every cell; q the flux, Δ a cell along its face's axis
    ΔT = Δt k_eff (T_o − T) A² / (V² ρc),  k_eff = 2 k_a k_b/(k_a + k_b)      in the cell at the centre of a patch
    ΔT = −Δt [εσ (T⁴ − T_a⁴) + h (T − T_a)] / (ρc)               in every cell at a face
    T_meas ← T_meas + Δt/τ (T − T_meas)

one after the other, each with the temperatures of before it. The losses have no length in them, so they are some 1/Δ times too
large in number; contact is quadratic in area and explicit, so it explodes; the object keeps its temperature. A is the polygon
of the contact points, at least πδ, which is a length; the penetration δ is that of a Hertzian contact, a²κ.

Source: the paper's appendix on TemperatureGrid.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.quantities.patches import ContactPatch
from tgdsl.sensors.base import Constants
from tgdsl.sensors.temperature_grid import diffusion
from tgdsl.sensors.temperature_grid.losses import stefan_boltzmann, zero_celsius
from tgdsl.sensors.temperature_grid.rows import Rows, is_there, num_cells, of_cells


def least_squared_wavenumber() -> float:
    """Return what the paper calls ε, without a number [1/m²]."""
    return 1e-6


def stepped(
    cells: Tensor, objects: Tensor, rows: Rows, patches: ContactPatch, constants: Constants, dt: Tensor
) -> tuple[Tensor, ...]:
    """Return what links' cells gain from conduction, source, radiation, convection and contact (env, link, x, y, z) each [K].

    Args:
        cells: Temperatures above ambient (env, link, x, y, z) [K].
        objects: Those of the objects (env, object) [K].
        rows: What the links are made of.
        patches: What they touch.
        constants: What `lower` folded.
        dt: Δt [s].
    """
    alpha = rows.diffusivity * dt
    x = diffusion.exponents([dt * rate for rate in rows.rates], rows.modes)
    x = torch.maximum(x, alpha[..., None, None, None] * least_squared_wavenumber())
    spread = diffusion.semi_implicit(cells, x, rows.modes).gained
    heat = rows.conductivity / rows.diffusivity
    made = torch.zeros_like(cells)
    if "paper_source" in constants:
        made = made + (dt * constants["paper_source"] / heat)[..., None, None, None] * constants["is_cell"]
    now = cells + spread + made
    touched = torch.zeros_like(cells)
    if patches.topology.num_objects:
        touched = _touched(now, objects, rows, patches, constants, dt)
    now = now + touched
    ends = (of_cells(part, axis) for axis, part in enumerate(rows.ends))
    outer, scale = (
        (sum(ends, torch.zeros_like(cells[:1])) > 0).to(cells.dtype) * is_there(rows),
        (dt / heat)[..., None, None, None],
    )
    radiated = blown = torch.zeros_like(cells)
    if rows.emissivity is not None:
        around = constants["ambient"] + zero_celsius()
        flux = stefan_boltzmann() * rows.emissivity[..., None, None, None] * ((now + around) ** 4 - around**4)
        radiated = -scale * outer * flux
    if "convection" in constants:
        blown = -scale * outer * constants["convection"] * now
    return spread, made, radiated, blown, touched


def area(patches: ContactPatch, constants: Constants) -> Tensor:
    """Return A of each patch (env, body, object) [m²]."""
    if "contact_area" in constants:
        return torch.where(patches.force > 0, constants["contact_area"], 0.0)
    compliance = constants["compliance"][:, None] + patches.objects.compliance[:, None, :]
    curvature = constants["curvature"][:, None] + patches.objects.curvature[:, None, :]
    cubed = 0.75 * patches.force * compliance / curvature
    depth = planes.power(cubed, 2.0 / 3.0) * curvature
    return torch.maximum(patches.area, planes.pi() * depth)


def _touched(now: Tensor, objects: Tensor, rows: Rows, patches: ContactPatch, constants: Constants, dt: Tensor) -> Tensor:
    """Return what cells gain from what they touch [K]."""
    own, other = rows.conductivity[..., None], patches.objects.conductivity[:, None, :]
    volume = (rows.boxes.step[0] * rows.boxes.step[1] * rows.boxes.step[2])[:, None]
    heat = (rows.conductivity / rows.diffusivity)[..., None]
    size = area(patches, constants)
    rate = dt * 2.0 * own * other / (own + other) * size * size / (volume * volume * heat)
    at = _at_centre(rows, patches)
    warmer = objects[:, None, :, None, None, None] - now[:, :, None]
    return (rate[..., None, None, None] * at * warmer).sum(dim=2)


def _at_centre(rows: Rows, patches: ContactPatch) -> Tensor:
    """Return 1 for the cell that holds each patch's centre, or is nearest (env, body, object, x, y, z)."""
    parts = []
    for axis, size in enumerate(num_cells(rows)):
        corner, step, count = (part[axis][:, None] for part in (rows.boxes.corner, rows.boxes.step, rows.boxes.count))
        place = torch.floor((patches.pos[axis].detach() - corner) / step).clamp(min=0.0)
        place = torch.minimum(place, count - 1.0)
        number = torch.arange(size, device=place.device, dtype=place.dtype)
        parts.append((place[..., None] == number) + 0.0 * place[..., None])  # a place that is no number is none of the cells
    x, y, z = parts
    return x[..., :, None, None] * y[..., None, :, None] * z[..., None, None, :]

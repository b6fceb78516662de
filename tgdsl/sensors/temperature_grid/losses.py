"""Radiation and convection from surfaces to the surroundings.

    C θ̇ = −A u θ,   1/u = 1/H + R,   H = h + εσ (T_s + T_a)(T_s² + T_a²),   θ_s = θ/(1 + H R)                    [W]

with θ = T − T_a of a cell [K], θ_s of its surface, and T in kelvins where they are powers. R is the resistance between a cell
and its exposed face across an axis,

    R = Δ/2k · (1 − e/3n)                                                                                    [m²K/W]

with n cells along the axis and e of its two ends exposed. Δ/2k is the resistance of half a cell. The factor corrects it for
cells that hold their mean, under the parabola of a slowly cooling body: Δ/6k for one cell. R tends to Δ/2k as cells get small,
and the error of losses is of second order in Δ, not first. A body of one temperature counts as one cell; Δ is the side of a
cube of its volume. H in θ_s is evaluated at θ of the step's start.

Linear losses of a link's faces, u₀ with H₀ = h + 4εσ T_a³, are part of the exact operator of conduction (`diffusion`); `lost`
does the rest, u − u₀, which is radiation beyond its tangent at T_a, and all of bodies that have no such operator. A step takes
u at its middle, θ e^(−uAΔt/2C) with u of its start: of second order in Δt, and never beyond the surroundings, however long it
is.

Source: Incropera et al., *Fundamentals of Heat and Mass Transfer*, 1.2, and 5.5 for the slab that cools.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.quantities.patches import ContactPatch
from tgdsl.sensors.base import Constants
from tgdsl.sensors.temperature_grid import diffusion
from tgdsl.sensors.temperature_grid.rows import Rows, is_there, num_cells, of_cells
from tgdsl.tensors.fusion import materialised


def stefan_boltzmann() -> float:
    """Return σ [W/(m²·K⁴)] (CODATA 2018)."""
    return 5.670374419e-8


def zero_celsius() -> float:
    """Return 0 °C [K]."""
    return 273.15


class Face(NamedTuple):
    """Faces across an axis, or of all of a body."""

    area: Tensor  # exposed area over heat capacity A/C [m²·K/J]
    resistance: Tensor  # R [m²·K/W]
    film: Tensor | None = None  # u₀, which `lost` leaves out [W/(m²·K)]; None: nothing
    film_radiated: Tensor | None = None  # share of u₀ that is radiation [1]


class Surfaces(NamedTuple):
    """What loses heat: faces, emissivity ε, heat transfer coefficient h [W/(m²·K)].

    None where a term is off. `ambient` is T_a [°C].
    """

    faces: tuple[Face, ...]
    emissivity: Tensor | None
    convection: Tensor | None
    ambient: Tensor


def lost(above: Tensor, surfaces: Surfaces, dt: Tensor) -> tuple[Tensor, Tensor]:
    """Return the gain of temperatures above the surroundings in a step [K], and its radiated share [1]."""
    total, _ = _coefficient(above, surfaces)
    covered = [1.0 / (1.0 + total * face.resistance) for face in surfaces.faces]
    whole = sum((face.area * part for face, part in zip(surfaces.faces, covered, strict=True)), torch.zeros_like(above))
    middle = above * torch.exp(-0.5 * dt * total * whole)
    rate, glowing = torch.zeros_like(above), torch.zeros_like(above)
    for face, part in zip(surfaces.faces, covered, strict=True):
        coefficient, radiated = _coefficient(middle * part, surfaces)
        through = 1.0 / (1.0 + coefficient * face.resistance)
        rate, glowing = rate + face.area * (coefficient * through), glowing + face.area * (radiated * through)
        if face.film is not None and face.film_radiated is not None:
            rate, glowing = rate - face.area * face.film, glowing - face.area * (face.film * face.film_radiated)
    is_any = rate != 0
    share = torch.where(is_any, glowing, 0.0) / torch.where(is_any, rate, 1.0)
    # The loss of cells and the report must be one number: another kernel contracts the films' difference differently, and the
    # two are then 1e-4 apart.
    return materialised(above * torch.expm1(-rate * dt)), share


def _coefficient(above: Tensor, surfaces: Surfaces) -> tuple[Tensor, Tensor]:
    """Return H, and the part of it that is radiation [W/(m²·K)]."""
    radiated = torch.zeros_like(above)
    if surfaces.emissivity is not None:
        around = surfaces.ambient + zero_celsius()
        hot = above + around
        radiated = stefan_boltzmann() * surfaces.emissivity * (hot + around) * (hot * hot + around * around)
    return (radiated if surfaces.convection is None else radiated + surfaces.convection), radiated


def least_squared_wavenumber() -> float:
    """Return the paper's ε, for which it gives no number [1/m²]."""
    return 1e-6


def paper_step(
    cells: Tensor, objects: Tensor, rows: Rows, patches: ContactPatch, constants: Constants, dt: Tensor
) -> tuple[Tensor, ...]:
    """Return gains of links' cells from conduction, source, radiation, convection and contact (env, link, x, y, z) each [K].

    The formulas of the paper as printed: `model: paper`.

        T̂ ← T̂ / (1 + α Δt k²)                                       within a link, k² at least `least_squared_wavenumber`
        ΔT = Δt q / (Δ ρc)                                           in every cell; q the flux, Δ a cell along its face's axis
        ΔT = Δt k_eff (T_o − T) A² / (V² ρc),  k_eff = 2 k_a k_b/(k_a + k_b)      in the cell at the centre of a patch
        ΔT = −Δt [εσ (T⁴ − T_a⁴) + h (T − T_a)] / (ρc)               in every cell at a face
        T_meas ← T_meas + Δt/τ (T − T_meas)

    one after the other, each from the temperatures left by the last. The losses contain no length, so their values are about
    1/Δ times too large. Contact is quadratic in area and explicit, so it diverges. The object keeps its temperature. A is the
    area of the contact points' polygon, at least πδ, which is a length; δ = a²κ is the penetration of a Hertzian contact.

    Source: the paper's appendix on TemperatureGrid.

    Args:
        cells: Temperatures above ambient (env, link, x, y, z) [K].
        objects: Temperatures of the objects (env, object) [K].
        rows: Materials of the links.
        patches: Their contact patches.
        constants: Constants from `lower`.
        dt: Δt [s].
    """
    wavenumbers = diffusion.squared_wavenumbers(rows.boxes.step, rows.modes).clamp(min=least_squared_wavenumber())
    spread = diffusion.semi_implicit(cells, (dt * rows.diffusivity)[..., None, None, None] * wavenumbers, rows.modes).gained
    heat = rows.conductivity / rows.diffusivity
    generated = torch.zeros_like(cells)
    if "paper_source" in constants:
        generated = generated + (dt * constants["paper_source"] / heat)[..., None, None, None] * constants["is_cell"]
    now = cells + spread + generated
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
    return spread, generated, radiated, blown, touched


def paper_area(patches: ContactPatch, constants: Constants) -> Tensor:
    """Return A of each patch (env, body, object) [m²]."""
    if "contact_area" in constants:
        return torch.where(patches.force > 0, constants["contact_area"], 0.0)
    compliance = constants["compliance"][:, None] + patches.objects.compliance[:, None, :]
    curvature = constants["curvature"][:, None] + patches.objects.curvature[:, None, :]
    cubed = 0.75 * patches.force * compliance / curvature
    depth = planes.power(cubed, 2.0 / 3.0) * curvature
    return torch.maximum(patches.area, planes.pi() * depth)


def _touched(now: Tensor, objects: Tensor, rows: Rows, patches: ContactPatch, constants: Constants, dt: Tensor) -> Tensor:
    """Return the gains of cells from contact [K]."""
    k, other = rows.conductivity[..., None], patches.objects.conductivity[:, None, :]
    volume = (rows.boxes.step[0] * rows.boxes.step[1] * rows.boxes.step[2])[:, None]
    heat = (rows.conductivity / rows.diffusivity)[..., None]
    size = paper_area(patches, constants)
    rate = dt * 2.0 * k * other / (k + other) * size * size / (volume * volume * heat)
    at = _at_centre(rows, patches)
    warmer = objects[:, None, :, None, None, None] - now[:, :, None]
    return (rate[..., None, None, None] * at * warmer).sum(dim=2)


def _at_centre(rows: Rows, patches: ContactPatch) -> Tensor:
    """Return 1 for the cell that holds each patch's centre, or is nearest (env, body, object, x, y, z)."""
    parts = []
    for axis, size in enumerate(num_cells(rows)):
        corner, step, count = (part[axis][:, None] for part in (rows.boxes.corner, rows.boxes.step, rows.boxes.cells))
        place = torch.floor((patches.pos[axis].detach() - corner) / step).clamp(min=0.0)
        place = torch.minimum(place, count - 1.0)
        number = torch.arange(size, device=place.device, dtype=place.dtype)
        parts.append((place[..., None] == number) + 0.0 * place[..., None])  # a place that is no number is none of the cells
    x, y, z = parts
    return x[..., :, None, None] * y[..., None, :, None] * z[..., None, None, :]

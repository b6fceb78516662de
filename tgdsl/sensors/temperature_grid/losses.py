"""Radiation and convection from surfaces to the surroundings.

    C θ̇ = −A u θ,   1/u = 1/H + R,   H = h + εσ (T_s + T_a)(T_s² + T_a²),   θ_s = θ/(1 + H R)                    [W]

with θ = T − T_a of a cell [K], θ_s that of its surface, and T in kelvins where they are powers. R is the resistance between a
cell and its exposed face across an axis,

    R = Δ/2k · (1 − e/3n)                                                                                    [m²K/W]

with n cells along the axis and e of its two ends exposed. Δ/2k is that of half a cell; the factor makes it that of what cells
hold, their mean, under the parabola by which a body cools slowly: Δ/6k of one cell. It takes R to Δ/2k as cells get small, and
the error of losses from first to second order in Δ. A body of one temperature counts as one cell, Δ the side of a cube of its
volume. H in θ_s is that of θ at the step's begin.

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

from tgdsl.tensors.fusion import materialised


def stefan_boltzmann() -> float:
    """Return σ [W/(m²·K⁴)] (CODATA 2018)."""
    return 5.670374419e-8


def zero_celsius() -> float:
    """Return 0 °C [K]."""
    return 273.15


class Face(NamedTuple):
    """Faces across an axis, or of all of a body.

    Attributes:
        area: Exposed area over heat capacity A/C [m²·K/J].
        resistance: R [m²·K/W].
        film: u₀, which `lost` leaves out [W/(m²·K)]; None: nothing.
        film_radiated: Share of u₀ that is radiation [1].
    """

    area: Tensor
    resistance: Tensor
    film: Tensor | None = None
    film_radiated: Tensor | None = None


class Surfaces(NamedTuple):
    """What loses heat: faces, emissivity ε, heat transfer coefficient h [W/(m²·K)].

    None where a term is off. `ambient` is T_a [°C].
    """

    faces: tuple[Face, ...]
    emissivity: Tensor | None
    convection: Tensor | None
    ambient: Tensor


def lost(above: Tensor, surfaces: Surfaces, dt: Tensor) -> tuple[Tensor, Tensor]:
    """Return what temperatures above the surroundings gain in a step [K], and the share of it that is radiation [1]."""
    total, _ = _coefficient(above, surfaces)
    covered = [1.0 / (1.0 + total * face.resistance) for face in surfaces.faces]
    whole = sum((face.area * part for face, part in zip(surfaces.faces, covered, strict=True)), torch.zeros_like(above))
    middle = above * torch.exp(-0.5 * dt * total * whole)
    rate, glowing = torch.zeros_like(above), torch.zeros_like(above)
    for face, part in zip(surfaces.faces, covered, strict=True):
        own, radiated = _coefficient(middle * part, surfaces)
        through = 1.0 / (1.0 + own * face.resistance)
        rate, glowing = rate + face.area * (own * through), glowing + face.area * (radiated * through)
        if face.film is not None and face.film_radiated is not None:
            rate, glowing = rate - face.area * face.film, glowing - face.area * (face.film * face.film_radiated)
    is_any = rate != 0
    share = torch.where(is_any, glowing, 0.0) / torch.where(is_any, rate, 1.0)
    # One number for what cells lose and what is reported: computed again in another kernel, where the films' difference is
    # contracted otherwise, the two are 1e-4 apart.
    return materialised(above * torch.expm1(-rate * dt)), share


def _coefficient(above: Tensor, surfaces: Surfaces) -> tuple[Tensor, Tensor]:
    """Return H, and the part of it that is radiation [W/(m²·K)]."""
    radiated = torch.zeros_like(above)
    if surfaces.emissivity is not None:
        around = surfaces.ambient + zero_celsius()
        hot = above + around
        radiated = stefan_boltzmann() * surfaces.emissivity * (hot + around) * (hot * hot + around * around)
    return (radiated if surfaces.convection is None else radiated + surfaces.convection), radiated

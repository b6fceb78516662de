"""Radiation and convection from surfaces to the surroundings.

    C θ' = −A [h θ + εσ (T⁴ − T_a⁴)] = −A H(θ) θ,   H = h + εσ (T + T_a)(T² + T_a²)                [W]

with θ = T − T_a [K], in kelvins where they are powers. A step takes H at its middle, θ e^(−H A Δt/2C) with H of its start: of
second order in Δt, and never beyond the surroundings, however long it is.

Source: Incropera et al., *Fundamentals of Heat and Mass Transfer*, 1.2.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


def stefan_boltzmann() -> float:
    """Return σ [W/(m²·K⁴)] (CODATA 2018)."""
    return 5.670374419e-8


def zero_celsius() -> float:
    """Return 0 °C [K]."""
    return 273.15


class Surfaces(NamedTuple):
    """What loses heat: exposed area over heat capacity A/C [m²·K/J], emissivity ε, heat transfer coefficient h [W/(m²·K)].

    None where a term is off. `ambient` is T_a [°C].
    """

    area: Tensor
    emissivity: Tensor | None
    convection: Tensor | None
    ambient: Tensor


def lost(above: Tensor, surfaces: Surfaces, dt: Tensor) -> tuple[Tensor, Tensor]:
    """Return what temperatures above the surroundings gain in a step [K], and the share of it that is radiation [1]."""
    if surfaces.emissivity is None and surfaces.convection is None:
        return torch.zeros_like(above), torch.zeros_like(above)
    rate = surfaces.area * dt
    total, _ = _coefficient(above, surfaces)
    middle = above * torch.exp(-0.5 * rate * total)
    total, radiated = _coefficient(middle, surfaces)
    is_any = total > 0
    share = torch.where(is_any, radiated, 0.0) / torch.where(is_any, total, 1.0)
    return above * torch.expm1(-rate * total), share


def _coefficient(above: Tensor, surfaces: Surfaces) -> tuple[Tensor, Tensor]:
    """Return H, and the part of it that is radiation [W/(m²·K)]."""
    radiated = torch.zeros_like(above)
    if surfaces.emissivity is not None:
        around = surfaces.ambient + zero_celsius()
        hot = above + around
        radiated = stefan_boltzmann() * surfaces.emissivity * (hot + around) * (hot * hot + around * around)
    return (radiated if surfaces.convection is None else radiated + surfaces.convection), radiated

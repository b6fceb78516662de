"""Capacitance: change of the capacitance of each taxel's electrode, under a soft dielectric cover, as a conductor comes near.

    y_j = C(g_j, t_j) − C(r_max, t),    C(g, s) = ε₀ A_j / (g + s/ε_r)                         [F]
    g_j = min(max(0, φ_j), r_max),      t_j = max(t_min, t + min(0, φ_j))                      [m]

with φ_j the signed distance of taxel j from the nearest surface of the sensed objects [m], negative inside, g_j the air gap up
to the range r_max [m], t_j the thickness of the cover, t at rest, which an object that presses in displaces down to t_min [m],
ε_r its relative permittivity [1], A_j the taxel's area [m²], and ε₀ = 8.8541878128e-12 F/m. Taxels are on the cover's outside.
Inactive taxels, and all where nothing is within the range, read 0.

Source: the parallel-plate capacitor, two dielectrics in series (Griffiths, *Introduction to Electrodynamics*, 4.4).

Limits: fringing fields are left out, so C is too low, the more the larger the gap is against the electrode's width. Objects are
grounded conductors, flat over an electrode; of several the nearest counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Generic, Literal

import numpy as np
import torch
from pydantic import model_validator

from tgdsl.fields.models import Positive, PositiveLength, Usual
from tgdsl.layout.layout import Layout
from tgdsl.quantities import ContactDepth, Gathered, References
from tgdsl.sensors import Kind
from tgdsl.sensors.base import (
    Array,
    Channel,
    Context,
    Lowered,
    ProbeSpec,
    ReferenceContext,
    ReferenceState,
    State,
    SurfaceOf,
    scalar,
)
from tgdsl.sensors.noise import BASE

EPSILON = 8.8541878128e-12
"""ε₀, permittivity of the vacuum [F/m]."""


class CapacitanceSpec(ProbeSpec):
    """Change of the capacitance of each taxel as a conductor comes near."""

    kind: Literal["capacitance"]
    """Change of each taxel's capacitance from its value with nothing in range [F]."""
    thickness: Annotated[PositiveLength, Usual("length", high=0.02)] = 1e-3
    """Thickness of the cover at rest, t [m]."""
    least_thickness: Annotated[PositiveLength, Usual("length", high=0.02)] = 1e-4
    """Thickness down to which it is compressed, t_min [m]."""
    permittivity: Positive = 2.8
    """Relative permittivity of the cover, ε_r [1]; default: silicone rubber."""
    range: Annotated[PositiveLength, Usual("length", high=0.5)] = 0.02
    """Largest air gap that changes the reading, r_max [m]."""

    @model_validator(mode="after")
    def _ordered(self) -> CapacitanceSpec:
        if self.least_thickness > self.thickness:
            problem = f"least_thickness {self.least_thickness:g} m is above thickness {self.thickness:g} m"
            raise ValueError(f"{problem}, expected at most that")
        return self


def reference(
    spec: CapacitanceSpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return y (taxel, 1) [F]."""
    distance = gathered[ContactDepth].distance.min(axis=1)
    gap = np.minimum(np.maximum(0.0, distance), spec.range)
    cover = np.maximum(spec.least_thickness, spec.thickness + np.minimum(0.0, distance))
    rest = EPSILON * layout.area / (spec.range + spec.thickness / spec.permittivity)
    return (EPSILON * layout.area / (gap + cover / spec.permittivity) - rest)[:, None], {}


@dataclass(frozen=True, eq=False)
class CapacitanceConstants(Generic[Array]):
    """Area times ε₀ of each taxel [F·m], and the parameters."""

    strength: Array
    thickness: Array
    least_thickness: Array
    permittivity: Array
    range: Array


def lower(spec: CapacitanceSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """One constant per taxel, its area times ε₀, and the parameters."""
    parameters = (spec.thickness, spec.least_thickness, spec.permittivity, spec.range)
    constants = CapacitanceConstants(EPSILON * layout.area, *map(scalar, parameters))
    request = ContactDepth(spec.objects, spec.is_gated, range=spec.range, distance=True)
    return Lowered((Channel("capacitance", "F"),), constants, requests=(request,))


def forward(
    gathered: Gathered, context: Context, constants: CapacitanceConstants[torch.Tensor], state: State
) -> tuple[dict[str, torch.Tensor], State]:
    """Return the plane of y [F], (env, taxel), as one fraction: exactly 0 at rest."""
    distances = [each.value for each in gathered[ContactDepth].distances.values()]
    distance = torch.stack(distances).amin(dim=0)
    gap = torch.minimum(distance.clamp(min=0.0), constants.range)
    cover = torch.maximum(constants.least_thickness, constants.thickness + distance.clamp(max=0.0))
    nearer = (constants.range - gap) + (constants.thickness - cover) / constants.permittivity
    rest = constants.range + constants.thickness / constants.permittivity
    return {"capacitance": constants.strength * nearer / ((gap + cover / constants.permittivity) * rest)}, {}


CAPACITANCE = Kind(CapacitanceSpec, lower, forward, reference, knobs=BASE, constants=CapacitanceConstants)

"""Surface distance: signed distance from each probe's centre to each object's surface, before and during contact.

    y_jo = min(φ_jo, r_max),    φ_jo = min_g φ_g(q_j)                                         [m]
    u_jo = −φ_jo m_jo where φ_jo ≤ r_max, else 0                                              [m]

q_j is the probe's world position and φ_g the signed distance to geom g of object o [m], negative inside. m_jo is the gradient
of φ_jo in the frame of the probe's link; it points out of the object. r_max is the range [m]. u_jo points from the probe to
the nearest point of the surface. There is no contact gate. Inactive probes (radius 0) read y = r_max and u = 0; the radius of
active probes has no effect.

Source: Chung et al., *Tactile Genesis*, appendix, "SurfaceDistanceProbe".

Departures: the range, beyond which the reading is constant, the negative sign inside and the vector u are ours.

Limits: inside overlapping geoms the magnitude is the deepest geom's alone, which is at most the true distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Generic, Literal

import numpy as np
import torch
from torch import Tensor

from tgdsl.fields.models import PositiveLength, Usual
from tgdsl.geometry import planes
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.contact_depth import ContactDepth
from tgdsl.quantities.reference import References
from tgdsl.sensors.base import (
    Array,
    Channel,
    Context,
    Kind,
    Lowered,
    ProbeSpec,
    ReferenceContext,
    ReferenceState,
    State,
    SurfaceOf,
    components,
    scalar,
    vector,
)
from tgdsl.sensors.noise import PROBE


class SurfaceDistanceSpec(ProbeSpec):
    """Distance of each probe to each object's surface [m]."""

    kind: Literal["surface_distance"]
    """Distance of each probe's centre to each object's surface, negative inside [m]."""
    max_range: Annotated[PositiveLength, Usual("length", high=5.0)] = 0.05
    """r_max, distance beyond which the reading is constant [m]."""
    nearest: bool = False
    """Whether to read the vectors from the probe to the nearest points, in the link's frame [m]."""


def reference(
    spec: SurfaceDistanceSpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return y of all objects, then u of all objects: (taxel, object) or (taxel, 4 object) [m]."""
    touch = gathered[ContactDepth]
    distance = np.minimum(touch.distance, spec.max_range)
    if not spec.nearest:
        return distance, {}
    in_range = (touch.distance <= spec.max_range)[..., None]
    vector = np.where(in_range, -distance[..., None] * touch.outward, 0.0)
    return np.concatenate([distance, vector.reshape(len(vector), -1)], axis=1), {}


@dataclass(frozen=True, eq=False)
class SurfaceDistanceConstants(Generic[Array]):
    """Largest distance that is read [m]."""

    max_range: Array


def lower(spec: SurfaceDistanceSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """One channel per object, and three more where the vector is wanted."""
    channels = [Channel(f"distance_{name}", "m") for name in spec.feels]
    if spec.nearest:
        channels += [channel for name in spec.feels for channel in vector(f"nearest_{name}", "m")]
    constants = SurfaceDistanceConstants(scalar(spec.max_range))
    request = ContactDepth(spec.objects, spec.is_gated, range=spec.max_range, distance=True)
    return Lowered(tuple(channels), constants, requests=(request,))


def forward(
    gathered: Gathered, context: Context, constants: SurfaceDistanceConstants[Tensor], state: State
) -> tuple[dict[str, Tensor], State]:
    """Return the distance planes, and the vectors' planes, by object [m]."""
    max_range = constants.max_range
    readings: dict[str, Tensor] = {}
    for name, (distance, gradient) in gathered[ContactDepth].distances.items():
        capped = torch.minimum(distance, max_range)
        readings[f"distance_{name}"] = capped
        reach = torch.where(distance > max_range, 0.0, -capped)
        to_surface = planes.scale(reach, gradient)
        readings |= components(f"nearest_{name}", to_surface)
    return readings, {}


SURFACE_DISTANCE = Kind(
    SurfaceDistanceSpec,
    lower,
    forward,
    reference,
    knobs=PROBE,
    idle_knobs=frozenset({"radius_noise"}),
    is_pointwise=True,
    constants=SurfaceDistanceConstants,
)

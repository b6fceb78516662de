"""Contact depth: how far each probe's sphere reaches into what it touches.

    d_j = max_g max(0, R_j − φ_g(q_j))                                                        [m]

with q_j = p_L + R_L x_j the probe's place in the world, R_j its radius [m], and φ_g the signed distance to geom g of the
objects felt [m]. Inactive probes (R_j = 0) read 0.

Source: Chung et al., *Tactile Genesis*, appendix, "Probe geometry and contact-depth query" (the `sdf` backend) and
"ContactDepthProbe".

Departures: distances are exact for every MuJoCo primitive, where the paper's implementation interpolates boxes, cylinders
and capsules on a grid. The gate is an option; the paper's is `contact_pair`. Under that gate a probe of radius R reads up to
R as soon as any point of its link touches the object: depth is measured from the sphere, not from the skin.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from torch import Tensor

from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.contact_depth import ContactDepth
from tgdsl.quantities.reference import References
from tgdsl.sensors.base import (
    Channel,
    Constants,
    ContactProbeSpec,
    Context,
    Kind,
    Lowered,
    ReferenceContext,
    ReferenceState,
    State,
    SurfaceOf,
)
from tgdsl.sensors.noise import TAXEL


class ContactDepthSpec(ContactProbeSpec):
    """Penetration depth of each probe [m]."""

    kind: Literal["contact_depth"]
    """How far each probe's sphere reaches into what it touches [m]."""


def reference(
    spec: ContactDepthSpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return d (taxel, 1) [m]."""
    return gathered[ContactDepth].depth[:, None], {}


def lower(spec: ContactDepthSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """Depth needs neither normals nor constants."""
    return Lowered((Channel("depth", "m"),), requests=(ContactDepth(spec.objects, spec.is_gated),))


def forward(gathered: Gathered, context: Context, constants: Constants, state: State) -> tuple[dict[str, Tensor], State]:
    """Return the depth plane [m]."""
    return {"depth": gathered[ContactDepth].depth}, {}


CONTACT_DEPTH = Kind(ContactDepthSpec, lower, forward, reference, knobs=TAXEL, is_pointwise=True)

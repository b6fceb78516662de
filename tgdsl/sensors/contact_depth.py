"""Contact depth: penetration depth of each probe's sphere into the objects that it senses.

    d_j = max_g max(0, R_j − φ_g(q_j)),    q_j = p_L + R_L x_j                                [m]

x_j is the probe's position in the frame of its link, p_L and R_L the link's world pose, q_j the probe's world position and R_j
its radius [m]. φ_g(q) is the signed distance to geom g [m], negative inside. g runs over all geoms of the sensed objects whose
gate is open. Inactive probes (R_j = 0) read 0.

Source: Chung et al., *Tactile Genesis*, appendix, "Probe geometry and contact-depth query" (the `sdf` backend) and
"ContactDepthProbe".

Departures: distances are exact for every MuJoCo primitive; the paper's implementation interpolates boxes, cylinders and
capsules on a grid. The gate is an option here; the paper's is `contact_pair`.

Limits: depth is measured from the probe's sphere, not from the link's surface. With the gate `contact_pair` a probe therefore
reads up to R_j as soon as any point of its link touches the object.
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
    """Penetration depth of each probe's sphere into the sensed objects [m]."""


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

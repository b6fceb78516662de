"""All operations that have a Triton kernel."""

from __future__ import annotations

from typing import Any

from tgdsl.quantities.contact_depth import DEEPEST
from tgdsl.quantities.moment_sums import FELT_MOMENTS
from tgdsl.quantities.patch import CONTACT_PATCH
from tgdsl.quantities.points import LINK_POINTS
from tgdsl.sensors.elastomer.point_anchors import POINT_SUM, SHEAR_LOADS
from tgdsl.sensors.force_taxel.footprint import SHARED_FORCES
from tgdsl.sensors.temperature_grid.step import HEAT_STEP
from tgdsl.tensors.link_products import LINK_PRODUCTS
from tgdsl.tensors.operations import Operation

OPERATIONS: tuple[Operation[..., Any], ...] = (
    DEEPEST,
    FELT_MOMENTS,
    SHEAR_LOADS,
    LINK_PRODUCTS,
    LINK_POINTS,
    POINT_SUM,
    SHARED_FORCES,
    HEAT_STEP,
    CONTACT_PATCH,
)

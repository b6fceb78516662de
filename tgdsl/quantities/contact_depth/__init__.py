"""Contact depth: how deep a probe is in which object, which way is out, how that moves; distances to surfaces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tgdsl.geometry.shapes import SHAPES
from tgdsl.quantities.base import Planning, Quantity, Use
from tgdsl.quantities.contact_depth.account import account, explain
from tgdsl.quantities.contact_depth.gathering import gather
from tgdsl.quantities.contact_depth.part import ContactDepthPart
from tgdsl.quantities.contact_depth.reference import reference
from tgdsl.quantities.contact_depth.request import ContactDepth, Distance, Penetration

__all__ = ["CONTACT_DEPTH", "ContactDepth", "Distance", "Penetration"]


def _plan(planning: Planning, uses: Sequence[Use]) -> ContactDepthPart[np.ndarray]:
    from tgdsl.quantities.contact_depth.planning import plan  # what bakes is wanted by compilers alone

    return plan(planning, uses)


def _fields(part: ContactDepthPart) -> set[str]:
    is_moving = any("motion" in use.wants for use in part.uses)
    is_gated = any(use.is_gated for use in part.uses)
    return {*(["body_linvel", "body_angvel"] if is_moving else []), *(["contact_found"] if is_gated else [])}


def _is_light(part: ContactDepthPart) -> bool:
    """Return whether primitives alone are asked for depths and distances alone."""
    shapes = {shape for table in part.geoms if table is not None for shape in table.shapes}
    return shapes <= SHAPES.keys() and all(set(use.wants) <= {"distance"} for use in part.uses)


CONTACT_DEPTH = Quantity(
    name="contact_depth",
    request=ContactDepth,
    part=ContactDepthPart,
    plan=_plan,
    gather=gather,
    reference=reference,
    fields=_fields,
    is_light=_is_light,
    explain=explain,
    account=account,
)

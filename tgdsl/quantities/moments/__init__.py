"""Moments: how much of each object's outer surface is near each probe, and where."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tgdsl.quantities.base import Planning, Quantity, Use
from tgdsl.quantities.moments.account import account, explain
from tgdsl.quantities.moments.gathering import gather
from tgdsl.quantities.moments.moments import Moments
from tgdsl.quantities.moments.part import MomentsPart
from tgdsl.quantities.moments.reference import reference
from tgdsl.quantities.moments.request import MomentsRequest, SurfaceMoments

__all__ = ["MOMENTS", "Moments", "MomentsRequest", "SurfaceMoments"]


def _plan(planning: Planning, uses: Sequence[Use]) -> MomentsPart[np.ndarray]:
    from tgdsl.quantities.moments.planning import plan  # what bakes is wanted by compilers alone

    return plan(planning, uses)


def _fields(part: MomentsPart) -> set[str]:
    return {"body_linvel", "body_angvel"} if any(use.motion for use in part.uses) else set()


MOMENTS = Quantity(
    name="moments",
    request=MomentsRequest,
    part=MomentsPart,
    plan=_plan,
    gather=gather,
    reference=reference,
    fields=_fields,
    explain=explain,
    account=account,
)

"""Points sampled on objects, and how deep they are in links' own surfaces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tgdsl.quantities.base import Planning, Quantity, Use
from tgdsl.quantities.geoms import tables
from tgdsl.quantities.pairs import PairedObject
from tgdsl.quantities.points.gathering import gather
from tgdsl.quantities.points.part import PointsPart
from tgdsl.quantities.points.points import LinkPoints, ObjectPoints
from tgdsl.quantities.points.reference import reference
from tgdsl.quantities.points.request import Points

__all__ = ["POINTS", "LinkPoints", "ObjectPoints", "Points"]


def _plan(planning: Planning, uses: Sequence[Use]) -> PointsPart[np.ndarray]:
    from tgdsl.quantities.points.planning import plan  # what bakes is wanted by compilers alone

    return plan(planning, uses)


def _fields(part: PointsPart) -> set[str]:
    return {"contact_found"} if any(use.is_gated for use in part.uses) else set()


def _num_rows(part: PointsPart, use: int) -> int:
    """Return the number of points of all objects, as all links see them."""
    return sum(part.clouds[met.cloud].points.shape[2] * len(met.links) for met in part.uses[use].objects)


def _explain(part: PointsPart, use: int, objects: Sequence[PairedObject]) -> list[str]:
    lines = []
    for met in part.uses[use].objects:
        cloud, links = part.clouds[met.cloud], ", ".join(part.links[i] for i in met.links)
        lines.append(f"{cloud.points.shape[2]} points of {objects[cloud.object].name} against {links}")
    return lines


def _account(part: PointsPart, objects: Sequence[PairedObject]) -> dict[str, list[str]]:
    lines = [] if part.surfaces is None else tables.account(part.surfaces, [f"link {name}" for name in part.links])
    return {"meshes": lines} if lines else {}


POINTS = Quantity(
    name="points",
    request=Points,
    part=PointsPart,
    plan=_plan,
    gather=gather,
    reference=reference,
    fields=_fields,
    num_rows=_num_rows,
    explain=_explain,
    account=_account,
)

"""Loads: how hard each body is pressed by each object, and how fast they slide on one another."""

from __future__ import annotations

from collections.abc import Sequence

from tgdsl.quantities.base import Quantity
from tgdsl.quantities.loads.gathering import gather
from tgdsl.quantities.loads.part import LoadsPart
from tgdsl.quantities.loads.planning import plan
from tgdsl.quantities.loads.reference import reference
from tgdsl.quantities.loads.request import Loads, PairLoads
from tgdsl.quantities.pairs import PairedObject

__all__ = ["LOADS", "Loads", "PairLoads"]

FIELDS = frozenset(
    {"body_linvel", "body_angvel", "contact_found", "contact_pos", "contact_force", "contact_normal", "contact_netforce"}
)


def _fields(part: LoadsPart) -> set[str]:
    return set(FIELDS)


def _num_rows(part: LoadsPart, use: int) -> int:
    return part.uses[use].pairs.size


def _explain(part: LoadsPart, use: int, objects: Sequence[PairedObject]) -> list[str]:
    return ["normal force and sliding speed of the solver's contacts"]


LOADS = Quantity(
    name="loads",
    request=Loads,
    part=LoadsPart,
    plan=plan,
    gather=gather,
    reference=reference,
    fields=_fields,
    num_rows=_num_rows,
    explain=_explain,
)

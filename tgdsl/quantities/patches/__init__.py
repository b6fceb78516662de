"""Contact patches: where and how widely links touch objects, and the heat that the objects hold."""

from __future__ import annotations

from collections.abc import Sequence

from tgdsl.quantities.base import Quantity, Use
from tgdsl.quantities.contacts.part import SLOT_FIELDS
from tgdsl.quantities.pairs import PairedObject
from tgdsl.quantities.patches.gathering import gather
from tgdsl.quantities.patches.part import PatchesPart
from tgdsl.quantities.patches.planning import plan
from tgdsl.quantities.patches.reference import reference
from tgdsl.quantities.patches.request import ContactPatch, ContactPatches, HeatOfObjects

__all__ = ["PATCHES", "ContactPatch", "ContactPatches", "HeatOfObjects"]


def _fields(part: PatchesPart) -> set[str]:
    wanted = (
        {"contact_found", "contact_netforce", *SLOT_FIELDS} if any(use.topology.num_objects for use in part.uses) else set()
    )
    if any(any(use.has_own_start) for use in part.uses):
        wanted.add("object_temperature")
    if any(count > 1 for use in part.uses for count in use.num_materials):
        wanted.add("object_material")
    return wanted


def _bodies(use: Use) -> tuple[str, ...]:
    return tuple(dict.fromkeys(link.body for link in use.links)) if use.request.objects else ()


def _num_cells(part: PatchesPart, use: int) -> int:
    """Return how many temperatures the objects have: each as many as the one with most cells."""
    cells = part.uses[use].topology.cells
    most = [max(own[axis] for own in cells) if cells else 1 for axis in range(3)]
    return len(cells) * most[0] * most[1] * most[2]


def _explain(part: PatchesPart, use: int, objects: Sequence[PairedObject]) -> list[str]:
    own = part.uses[use].topology
    return [f"contact patches with {own.num_objects} objects"] if own.num_objects else []


PATCHES = Quantity(
    name="patches",
    request=ContactPatches,
    part=PatchesPart,
    plan=plan,
    gather=gather,
    reference=reference,
    fields=_fields,
    bodies=_bodies,
    num_rows=_num_cells,
    explain=_explain,
    is_fused=True,
)

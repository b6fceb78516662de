"""Contacts: the solver's, on the bodies that carry a sensor."""

from __future__ import annotations

from collections.abc import Sequence

from tgdsl.quantities.base import Quantity
from tgdsl.quantities.contacts.gathering import gather
from tgdsl.quantities.contacts.part import SLOT_FIELDS, ContactsPart
from tgdsl.quantities.contacts.planning import plan
from tgdsl.quantities.contacts.reference import reference
from tgdsl.quantities.contacts.request import ContactPoints, Contacts
from tgdsl.quantities.pairs import PairedObject

__all__ = ["CONTACTS", "SLOT_FIELDS", "ContactPoints", "Contacts"]


def _fields(part: ContactsPart) -> set[str]:
    return {"contact_netforce", *(["contact_found", *SLOT_FIELDS] if part.slots else [])}


def _explain(part: ContactsPart, use: int, objects: Sequence[PairedObject]) -> list[str]:
    return ["the solver's contacts"]


def _is_light(part: ContactsPart) -> bool:
    return True


CONTACTS = Quantity(
    name="contacts",
    request=Contacts,
    part=ContactsPart,
    plan=plan,
    gather=gather,
    reference=reference,
    fields=_fields,
    is_light=_is_light,
    explain=_explain,
)

"""What the Plan holds for contacts.

Shapes: `body` bodies that carry the sensors, `object` felt objects.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Generic, TypeVar

from tgdsl.fields.indices import indices

Array = TypeVar("Array")

SLOT_FIELDS = ("contact_pos", "contact_force", "contact_torque", "contact_normal")
"""Fields of the state that are read contact by contact."""


@dataclass(frozen=True, eq=False)
class ContactsUse(Generic[Array]):
    """One request.

    Attributes:
        bodies: Indices of the sensors' bodies in the state, (body,).
        pairs: Whose contacts: indices into `inputs.pairs`, or their number for none, (body, object).
    """

    bodies: Array = field(metadata=indices(lambda use, part, plan: len(plan.inputs.bodies)))
    pairs: Array = field(metadata=indices(lambda use, part, plan: len(plan.inputs.pairs) + 1))


@dataclass(frozen=True, eq=False)
class ContactsPart(Generic[Array]):
    """All of it.

    Attributes:
        slots: Contacts per pair that are read; 0: the net force alone.
        uses: The uses.
    """

    slots: int
    uses: tuple[ContactsUse[Array], ...]

"""Contacts: the solver's, on the bodies that carry a sensor.

Shapes: `env` environments, `body` bodies that carry the sensor, `contact` contacts of one body: slot after slot of one object
after the other.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from tgdsl.geometry.planes import Vec
from tgdsl.quantities.base import Request


class ContactPoints(NamedTuple):
    """Contacts on each body, in its frame; planes (env, body, contact), but `net` (env, body). Unused slots are all zero.

    Contacts beyond the slots have no place of their own. What a pair's slots lack of its whole force, r = f_net − Σ_c f_c, acts
    at the centre of the contacts shown, weighted by their forces: each takes r |f_c| / Σ_c |f_c| on itself, or equal shares
    where none has a force. The forces then sum to the whole; the moment of r about that centre is not known, nor are torques
    beyond the slots. Where no contact is shown there is nowhere to act, and `net` alone has r.

    Attributes:
        pos: Contact points [m].
        force: Force on the body at each [N].
        torque: Torque on the body at each [N·m].
        normal: Unit normal out of the object at each; not-a-number where the state has none beside a force.
        net: Whole force on the body from the objects felt [N], contacts beyond the slots included.
    """

    pos: Vec
    force: Vec
    torque: Vec
    normal: Vec
    net: Vec


@dataclass(frozen=True, eq=False)
class Contacts(Request[ContactPoints]):
    """Asks for the solver's contacts.

    Attributes:
        slots: Contacts per body and object that are wanted; 0: the net force alone.
    """

    slots: int = 0
    wants_contacts: ClassVar[bool] = True

    @property
    def num_slots(self) -> int:
        """Contacts per body and object that are read."""
        return self.slots

    def key(self) -> tuple[Any, ...]:
        """Return what two requests at the same taxels have in common if they are one: the objects."""
        return type(self), self.objects

    def merged(self, other: Request) -> Contacts:
        """Return a request for as many slots as both want."""
        assert isinstance(other, Contacts)
        return dataclasses.replace(self, slots=max(self.slots, other.slots))

"""From requests for contacts to their part of the Plan."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tgdsl.quantities.base import Planning, Use
from tgdsl.quantities.contacts.part import ContactsPart, ContactsUse
from tgdsl.quantities.contacts.request import Contacts
from tgdsl.quantities.pairs import Pair


def plan(planning: Planning, uses: Sequence[Use]) -> ContactsPart[np.ndarray]:
    """Return the part of the Plan."""
    slots = max((use.request.slots for use in uses if isinstance(use.request, Contacts)), default=0)
    return ContactsPart(slots, tuple(_use(planning, use) for use in uses))


def _use(planning: Planning, use: Use) -> ContactsUse[np.ndarray]:
    objects = [name for name in use.request.objects if planning.object_id(name) is not None]
    counted = [name for name in objects if not is_counted(planning, name, use.request.objects)]
    bodies = tuple(dict.fromkeys(link.body for link in use.links))
    pairs = {pair: i for i, pair in enumerate(planning.contact_pairs)}
    table = [[pairs.get(Pair(body, name), len(pairs)) for name in counted] for body in bodies]
    # One that touches nothing has no pose in the state, and no contacts.
    places = [planning.bodies.index(body) if body in planning.bodies else 0 for body in bodies]
    return ContactsUse(np.array(places, dtype=np.int64), np.array(table, dtype=np.int64).reshape(len(bodies), len(counted)))


def is_counted(planning: Planning, name: str, felt: Sequence[str]) -> bool:
    """Return whether the contacts with an object are among those with another one that is felt too.

    Objects may be made of the same body, whose force is one. Of two that share all contacts the first one counts.
    """
    own, before = planning.sensed[name].touched, list(felt).index(name)
    others = [planning.sensed[other].touched for other in felt]
    return any(own < other or (own == other and i < before) for i, other in enumerate(others) if own)

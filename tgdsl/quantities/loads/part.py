"""What the Plan holds for loads.

Shapes: `body` bodies that carry the sensors, `object` felt objects.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Generic, Literal, TypeVar

from tgdsl.fields.indices import indices

Array = TypeVar("Array")


@dataclass(frozen=True, eq=False)
class LoadsUse(Generic[Array]):
    """One request.

    Attributes:
        bodies: Indices of the sensors' bodies in the state, (body,).
        objects: Indices of the objects' bodies in the state, (object,).
        pairs: Whose contacts: indices into `inputs.pairs`, or their number for none, (body, object).
        center: In whose frame the centre of the contacts is found; empty: it is not wanted.
    """

    bodies: Array = field(metadata=indices(lambda use, part, plan: len(plan.inputs.bodies)))
    objects: Array = field(metadata=indices(lambda use, part, plan: len(plan.inputs.bodies)))
    pairs: Array = field(metadata=indices(lambda use, part, plan: len(plan.inputs.pairs) + 1))
    center: Literal["", "link", "object"]


@dataclass(frozen=True, eq=False)
class LoadsPart(Generic[Array]):
    """All of it: the uses."""

    uses: tuple[LoadsUse[Array], ...]

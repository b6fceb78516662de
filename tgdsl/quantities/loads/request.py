"""Loads: how hard each body is pressed by each object, and how fast they slide on one another.

Shapes: `env` environments, `body` bodies that carry the sensor, `object` felt objects.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

from torch import Tensor

from tgdsl.geometry.planes import Vec
from tgdsl.quantities.base import Request


class PairLoads(NamedTuple):
    """What each body and object do to one another; planes (env, body, object), zero where they do not touch.

        F = Σ_c max(0, f_c · n_c),   W = Σ_c max(0, f_c · n_c) |v_c − (v_c · n_c) n_c|

    with the force f_c on the body and the unit normal n_c out of the object at each contact c, and the velocity v_c of the
    object's material there relative to the body's. What contacts beyond the slots carry is shared out over those shown, as
    `quantities.contacts` has it.

    Attributes:
        force: Sum of the contacts' normal forces, F [N].
        sliding: Normal force times sliding speed, W [W]; times a coefficient of friction it is the power of friction.
        center: Centre of the contacts weighted by F, in the frame of the body or object that was asked for [m]; zero where they
            do not touch. None if it was not asked for.
        along: Mean of the contacts' normals weighted by F, in that frame, into this body or object; zero where they do not
            touch. None if the centre was not asked for.
    """

    force: Tensor
    sliding: Tensor
    center: Vec | None
    along: Vec | None = None


@dataclass(frozen=True, eq=False)
class Loads(Request[PairLoads]):
    """Asks how hard each body is pressed by each object, and how fast they slide on one another.

    Attributes:
        slots: Contacts per body and object that are read.
        of: Whose loads they are to be summed up for: geoms that two objects share load a link once, but both objects.
        has_center: Whether the centre and the mean normal of the contacts are wanted, in the frame of what they are of.
    """

    slots: int = 4
    of: Literal["link", "object"] = "link"
    has_center: bool = False
    wants_contacts: ClassVar[bool] = True

    @property
    def num_slots(self) -> int:
        """Contacts per body and object that are read."""
        return self.slots

    def key(self) -> tuple[Any, ...]:
        """Return what two requests at the same links have in common if they are one: the objects, and whose loads they are."""
        return type(self), self.objects, self.of

    def merged(self, other: Request) -> Loads:
        """Return a request for as many slots as both want, and for the centre if either wants it."""
        assert isinstance(other, Loads)
        return dataclasses.replace(self, slots=max(self.slots, other.slots), has_center=self.has_center or other.has_center)

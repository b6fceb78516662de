"""A scene in float64, one environment at a time, as the input of quantities' references."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from tgdsl.layout.layout import Layout
from tgdsl.quantities.pairs import Pair, PairedObject

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class ReferenceBody:
    """A body at one instant, in the world frame."""

    pos: Float[Array, " 3"]  # position of its frame [m]
    quat: Float[Array, " 4"]  # orientation, w, x, y, z
    linvel: Float[Array, " 3"]  # velocity of the frame's origin [m/s]
    angvel: Float[Array, " 3"]  # angular velocity [rad/s]

    @cached_property
    def rotation(self) -> Float[Array, "3 3"]:
        """Rotates body vectors into the world."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_quat(self.quat, scalar_first=True).as_matrix()

    def velocity_at(self, point: Float[Array, " 3"]) -> Float[Array, " 3"]:
        """Velocity [m/s] of the body's material at a world point."""
        return self.linvel + np.cross(self.angvel, point - self.pos)


@dataclass(frozen=True, eq=False)
class ReferenceScene:
    """One environment at one instant."""

    layout: Layout  # the taxels of the sensor, or its links if it has none
    rows: slice  # which taxels of a use are the sensor's
    objects: tuple[PairedObject, ...]  # the Plan's objects
    bodies: tuple[str, ...]  # bodies of the state, by name in order
    contact_pairs: tuple[Pair, ...]  # pairs of the state
    fields: Mapping[str, Array]  # fields of the state in float64, without `env`
    shift: Float[Array, " 3"]  # by how much all objects are moved [m]

    def body(self, name: str) -> ReferenceBody:
        """Return a body where the state has it."""
        i, names = self.bodies.index(name), ("body_pos", "body_quat", "body_linvel", "body_angvel")
        pos, quat, linvel, angvel = (self.fields[n][i] if n in self.fields else np.zeros(3) for n in names)
        return ReferenceBody(pos, quat, linvel, angvel)

    def object_body(self, target: PairedObject) -> ReferenceBody:
        """Return an object's body, shifted."""
        body = self.body(target.body)
        return ReferenceBody(body.pos + self.shift, body.quat, body.linvel, body.angvel)

    def is_touching(self, link: str, target: str) -> bool:
        """Return whether the simulator has a link's body in contact with an object."""
        counts, pair = self.fields.get("contact_found"), Pair(link, target)
        return counts is not None and pair in self.contact_pairs and bool(counts[self.contact_pairs.index(pair)] > 0)

    def variant(self, target: PairedObject) -> int:
        """Return which of its variants an object has."""
        return int(self.fields["variant"][target.varied]) if target.num_variants > 1 else 0

    def size(self, target: PairedObject) -> Float[Array, " 3"] | None:
        """Return an object's size [m], if that is part of the state."""
        return self.fields["object_size"][target.varied] if target.is_sized else None


class References(dict[type, Any]):
    """What a sensor asked for, by the type of the request, as the quantities' references return it."""

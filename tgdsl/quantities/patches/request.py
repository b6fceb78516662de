"""Contact patches: where and how widely links touch objects, and the heat that the objects hold.

Shapes: `env` environments, or 1 where all are alike, `body` bodies that carry the sensor, `object` objects that are felt, in
the order of the request.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from torch import Tensor

from tgdsl.geometry.planes import Vec
from tgdsl.quantities.base import Request
from tgdsl.quantities.patches.topology import Topology


class HeatOfObjects(NamedTuple):
    """What objects are made of, planes (env, object).

    Attributes:
        start: Temperature at which an episode begins [°C]; without meaning where the object has none of its own.
        has_start: 1 where it has.
        conductivity: k [W/(m·K)].
        volumetric_heat: ρc [J/(m³·K)].
        emissivity: ε [1].
        compliance: (1 − ν²)/E [1/Pa].
        volume: [m³]; infinite for what keeps its temperature, such as a plane.
        area: Outer surface [m²].
        curvature: 1/R of the surface where it is touched [1/m]; 0 for what is flat.
        size: Sides of the box of one that is divided into cells, planes (object,) each [m].
        corner: Lowest corner of that box in the object's frame [m].
    """

    start: Tensor
    has_start: Tensor
    conductivity: Tensor
    volumetric_heat: Tensor
    emissivity: Tensor
    compliance: Tensor
    volume: Tensor
    area: Tensor
    curvature: Tensor
    size: Vec
    corner: Vec


# A function, not a float of the module: under dynamic shapes torch.compile makes that an input of the graph.
def cancelled() -> float:
    """Return the length of the mean of unit normals below which it has no direction."""
    return 1e-3


class ContactPatch(NamedTuple):
    """Patches between each body and each object, planes (env, body, object); all zero where they do not touch.

    Contacts count where their normal force is positive. The centre is that of these contacts, and the normal the direction of
    the sum of their normals, both weighted by normal force; where the normals cancel, as of a link that is pinched from two
    sides, that of the first of them.

    Attributes:
        force: Sum of the contacts' normal forces [N].
        area: Area of the contact points' convex hull in the plane across the normal [m²]; 0 for fewer than three.
        pos: Centre in the link's frame [m].
        normal: Unit normal out of the object, in the link's frame.
        object_pos: Centre in the object's frame [m]; None if no object there is divided into cells.
        object_normal: Normal in the object's frame.
        objects: What the objects are made of.
        topology: Which patch joins what.
        sides: `topology`'s tables.
        cells: What a step needs of the boxes of objects with cells, see `cells.tables`.
        boxes: Lowest and highest corner of each body's box, (body, 2, 3) in its frame [m].
    """

    force: Tensor
    area: Tensor
    pos: Vec
    normal: Vec
    object_pos: Vec | None
    object_normal: Vec | None
    objects: HeatOfObjects
    topology: Topology
    sides: Mapping[str, Tensor]
    cells: Mapping[str, Tensor]
    boxes: Float[Tensor, "body 2 3"]


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactPatches(Request[ContactPatch]):
    """Asks for the patches.

    Attributes:
        slots: Contacts per body and object that make a patch.
        boxes: Lowest and highest corner of each body's box in its frame, handed on (body, 2, 3) [m].
        is_star: Whether the area is that of the paper's polygon, through all points in the order of their angles about the
            centre, in place of their convex hull.
        needs_stiffness: Whether each object has to be of a material whose Young's modulus is known.
    """

    slots: int
    boxes: Float[np.ndarray, "body 2 3"]
    is_star: bool
    needs_stiffness: bool

    @property
    def wants_contacts(self) -> bool:  # type: ignore[override]
        """Whether contacts are read: where there are objects."""
        return bool(self.objects)

    @property
    def num_slots(self) -> int:
        """Contacts per body and object that are read."""
        return self.slots if self.objects else 0

    def key(self) -> tuple[Any, ...]:
        """Return what two requests have in common if they are one: each sensor has its own."""
        return (type(self), self.objects, self.slots, self.is_star, self.boxes.tobytes())

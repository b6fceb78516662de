"""What the Plan holds for contact patches.

Shapes: `body` bodies that carry the sensor, `object` objects, `choice` materials that one may have, `variant` its variants.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from tgdsl.fields.indices import indices
from tgdsl.quantities.patches.topology import Topology

Array = TypeVar("Array")


@dataclass(frozen=True, eq=False)
class PatchesUse(Generic[Array]):
    """One request.

    Attributes:
        topology: Which patch joins what.
        is_star: See `ContactPatches`.
        bodies: Indices of the sensor's bodies in the state, (body,); empty without objects.
        pairs: Whose contacts: indices into `inputs.pairs`, or their number for none, (body, object).
        relations: The same pair among those of the Plan, or their number, (body, object).
        boxes: Lowest and highest corner of each body's box (body, 2, 3) [m].
        start: Temperature at which each object begins (object,) [°C], and `has_start` 1 where it has one.
        has_start: See `start`.
        materials: Conductivity [W/(m·K)], ρc [J/(m³·K)], emissivity [1] and compliance [1/Pa], (object, choice, 4).
        shapes: Volume [m³], area [m²] and curvature [1/m], (object, variant, 3).
        grids: Lowest corner of each object's box and its sides (object, 2, 3) [m].
        variants: Where each object's variant is in the state's field; −1: all alike.
        heated: Where each object is in the state's fields of heat; −1: it is not there.
        has_own_start: Whether the state says at which temperature it begins.
        num_materials: How many materials it may have.
        sides: The tables of `topology`.
        cells: What a step needs of the boxes of objects with cells, see `cells.tables`; empty if there are none.
    """

    topology: Topology
    is_star: bool
    bodies: Array = field(metadata=indices(lambda use, part, plan: len(plan.inputs.bodies)))
    pairs: Array = field(metadata=indices(lambda use, part, plan: len(plan.inputs.pairs) + 1))
    relations: Array = field(metadata=indices(lambda use, part, plan: len(plan.pairs.link) + 1))
    boxes: Array
    start: Array
    has_start: Array
    materials: Array
    shapes: Array
    grids: Array
    variants: tuple[int, ...] = field(metadata=indices(lambda use, part, plan: len(plan.inputs.objects), least=-1))
    heated: tuple[int, ...] = field(metadata=indices(lambda use, part, plan: len(plan.inputs.heated), least=-1))
    has_own_start: tuple[bool, ...]
    num_materials: tuple[int, ...]
    sides: Mapping[str, Array]
    cells: Mapping[str, Array]


@dataclass(frozen=True, eq=False)
class PatchesPart(Generic[Array]):
    """All of it."""

    uses: tuple[PatchesUse[Array], ...]

"""What the Plan holds for moments.

Shapes: `object` objects of a use, `taxel` probes, `variant` variants of an object, `table` its tables: by variant and radius.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from tgdsl.fields.indices import indices

Array = TypeVar("Array")


@dataclass(frozen=True, eq=False)
class FieldTable(Generic[Array]):
    """Fields of moments, one after the other: see `moments.MomentField`.

    Attributes:
        values: At the nodes, float32, (node, channel).
        first: Index of each field's node (0, 0, 0), (table,).
        num: Number of its nodes along each axis, (table, 3).
        origin: Place of its node (0, 0, 0) [m], (table, 3).
        cell: Spacing of its nodes [m], (table,).
        counts: Nodes of the first field: numbers that become part of compiled code.
        is_smooth: Whether fields are sums of quadratic B-splines.
    """

    values: Array
    first: Array = field(
        metadata=indices(lambda fields, part, plan: len(fields.values) + 1 - np.prod(fields.num, axis=1, dtype=float))
    )
    num: Array = field(metadata=indices(None, least=2))
    origin: Array
    cell: Array
    counts: tuple[int, int, int]
    is_smooth: bool


@dataclass(frozen=True, eq=False)
class CloudTable(Generic[Array]):
    """Points and lists of those within reach, one cloud after the other: see `moments.PointCloud`.

    Attributes:
        points: Places [m], (3, row); the last one is out of reach of everything.
        weight: Surface that each point stands for [m²], (variant,).
        lists: Rows of `points`, (bin, slot).
        first: Index of each cloud's first cube, (variant,).
        num: Number of its cubes along each axis, (variant, 3).
        origin: Lower corner of its lattice [m], (variant, 3).
        cell: Side of a cube [m], (variant,).
        counts: Cubes of the first cloud: numbers that become part of compiled code.
    """

    points: Array
    weight: Array
    lists: Array = field(metadata=indices(lambda clouds, part, plan: clouds.points.shape[1]))
    first: Array = field(
        metadata=indices(lambda clouds, part, plan: len(clouds.lists) + 1 - np.prod(clouds.num, axis=1, dtype=float))
    )
    num: Array = field(metadata=indices(None, least=1))
    origin: Array
    cell: Array
    counts: tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class MomentTable(Generic[Array]):
    """The moments of one object, found in one way.

    Attributes:
        object: The object: its place in the Plan.
        radii: Radii that there are fields of [m].
        area: Area of its outer surface, planes left out [m²], (variant,).
        plane_pos: Places of its planes in its body's frame [m], (plane, 3).
        plane_rotation: Rotates their vectors into it, (plane, 9).
        surface: The rest of its surface; None if there is no more to it.
        accuracy: What was measured of each field, variant after variant, radius by radius: see `fields.FieldErrors`.
    """

    object: int = field(metadata=indices(lambda table, part, plan: len(plan.objects)))
    radii: tuple[float, ...]
    area: Array
    plane_pos: Array
    plane_rotation: Array
    surface: FieldTable[Array] | CloudTable[Array] | None
    accuracy: tuple[Mapping[str, float], ...]


@dataclass(frozen=True, eq=False)
class MomentUse(Generic[Array]):
    """One request.

    Attributes:
        tables: Number of the table of each of its objects.
        pos: Where the probes are in their links' bodies' frames [m], (3, taxel).
        pair: Index of each probe's pair with each object among that object's pairs, (object, taxel).
        reach: Sensing radius of each probe towards each object [m], (object, taxel); 0 where it has none.
        radius_id: Which of the table's radii that is, (object, taxel).
        radius_noise: The sensor whose noise disturbs the radii, if any.
        motion: Whether the objects' motions are asked for.
    """

    tables: tuple[int, ...] = field(metadata=indices(lambda use, part, plan: len(part.tables)))
    pos: Array
    pair: Array = field(
        metadata=indices(lambda use, part, plan: [[plan.objects[part.tables[i].object].num_pairs] for i in use.tables])
    )
    reach: Array
    radius_id: Array = field(metadata=indices(lambda use, part, plan: [[len(part.tables[i].radii)] for i in use.tables]))
    radius_noise: str
    motion: bool


@dataclass(frozen=True, eq=False)
class MomentsPart(Generic[Array]):
    """All of it."""

    tables: tuple[MomentTable[Array], ...]
    uses: tuple[MomentUse[Array], ...]

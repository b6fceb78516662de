"""What the Plan holds for points of objects and the links that they meet.

Shapes: `variant` variants of an object, `point` points of it, `link` links that may meet it, `tile` groups of taxels.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Generic, TypeVar

from tgdsl.fields.indices import indices
from tgdsl.quantities.geoms.tables import GeomTable

Array = TypeVar("Array")


@dataclass(frozen=True, eq=False)
class CloudPart(Generic[Array]):
    """The points of one object.

    Attributes:
        object: The object: its place in the Plan.
        points: Places in its body's frame [m], (3, variant, point).
        area: Surface that each stands for [m²], (variant,).
    """

    object: int = field(metadata=indices(lambda cloud, part, plan: len(plan.objects)))
    points: Array
    area: Array


@dataclass(frozen=True, eq=False)
class MetObject(Generic[Array]):
    """An object of a use, and the links that may meet it.

    Attributes:
        cloud: Number of its cloud.
        links: The links: indices into `PointsPart.links`.
        taxels: First of each link's taxels among the use's, and one beyond the last.
        pair: Index of the pair of each link and the object among all pairs, (link,).
        link: `links` as an array, (link,).
        tiles: What `points.point_tiles` returns of the taxels, (tile, 3).
    """

    cloud: int = field(metadata=indices(lambda met, part, plan: len(part.clouds)))
    links: tuple[int, ...] = field(metadata=indices(lambda met, part, plan: len(part.links)))
    taxels: tuple[tuple[int, int], ...] = field(metadata=indices(lambda met, part, plan: plan.layout.num_taxels + 1))
    pair: Array = field(metadata=indices(lambda met, part, plan: len(plan.pairs.link)))
    link: Array = field(metadata=indices(lambda met, part, plan: len(part.links)))
    tiles: Array = field(
        metadata=indices(lambda met, part, plan: [len(met.links), *[plan.layout.num_taxels + 1] * 2], least=-1)
    )


@dataclass(frozen=True, eq=False)
class PointsUse(Generic[Array]):
    """One request: its objects, and whether they are felt only in contact."""

    is_gated: bool
    objects: tuple[MetObject[Array], ...]


@dataclass(frozen=True, eq=False)
class PointsPart(Generic[Array]):
    """All of it.

    Attributes:
        links: Names of the links whose own surfaces points are measured against.
        surfaces: Their geoms: a case for each link; None if there is none.
        clouds: The objects' points.
        uses: The uses.
    """

    links: tuple[str, ...]
    surfaces: GeomTable[Array] | None
    clouds: tuple[CloudPart[Array], ...]
    uses: tuple[PointsUse[Array], ...]

"""What the Plan holds for contact depths.

Shapes: `object` objects of a use or query, `taxel` probes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Generic, TypeVar

from tgdsl.fields.indices import indices
from tgdsl.quantities.geoms.tables import GeomTable

Array = TypeVar("Array")


@dataclass(frozen=True, eq=False)
class SearchPart(Generic[Array]):
    """What a GPU's search for the deepest geom is given that is the same at all calls: see `search.Tables`.

    Attributes:
        pair: Index of each probe's pair with each object among all pairs, (object, taxel).
        spheres: Bounds of the objects, (1, object, 2); None where they differ between environments.
        geoms: Their geoms, (1, geom, row); None likewise.
    """

    pair: Array = field(metadata=indices(lambda search, part, plan: len(plan.pairs.link)))
    spheres: Array | None
    geoms: Array | None


@dataclass(frozen=True, eq=False)
class ProbeQuery(Generic[Array]):
    """Probes whose distances are found once, whatever number of uses are made of them.

    Attributes:
        objects: The objects that they are measured against: indices into the Plan's.
        pos: Where the probes are in their links' bodies' frames [m], (3, taxel).
        pair: Index of each probe's pair with each object among that object's pairs, (object, taxel).
    """

    objects: tuple[int, ...] = field(metadata=indices(lambda query, part, plan: len(plan.objects)))
    pos: Array
    pair: Array = field(metadata=indices(lambda query, part, plan: [[plan.objects[i].num_pairs] for i in query.objects]))


@dataclass(frozen=True, eq=False)
class DepthUse(Generic[Array]):
    """One request: which of a query's objects are felt, and how.

    Attributes:
        query: Number of its query.
        objects: Which of that one's objects.
        is_gated: Whether they are felt only in contact.
        wants: What is asked for beside the depth: "distance", "frame", "motion", "normal".
        radius_noise: The sensor whose noise disturbs the radii, if any.
        reach: How far each probe feels each object [m], (object, taxel); −∞ where it does not.
        search: What a search by a kernel is given; None where it is of no use.
    """

    query: int = field(metadata=indices(lambda use, part, plan: len(part.queries)))
    objects: tuple[int, ...] = field(metadata=indices(lambda use, part, plan: len(part.queries[use.query].objects)))
    is_gated: bool
    wants: tuple[str, ...]
    radius_noise: str
    reach: Array
    search: SearchPart[Array] | None


@dataclass(frozen=True, eq=False)
class ContactDepthPart(Generic[Array]):
    """All of it.

    Attributes:
        geoms: Geoms of the Plan's objects; None of one that nothing is measured against.
        queries: The queries.
        uses: The uses.
    """

    geoms: tuple[GeomTable[Array] | None, ...]
    queries: tuple[ProbeQuery[Array], ...]
    uses: tuple[DepthUse[Array], ...]

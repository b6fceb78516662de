"""Points that are sampled on objects, where links see them, and how deep they are in the links' own surfaces.

Shapes: `env` environments, `link` links that may meet one object, `point` points of it, `case` 1, or `env` if the object
differs between environments.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.fusion import stored, takes_kernel
from tgdsl.geometry import planes
from tgdsl.geometry.grid import Grid
from tgdsl.geometry.query import Felt, FeltObject, MetPoints, Pairs, body_distance, united


class PointSource(NamedTuple):
    """The points of one object, and the links that they may meet.

    Attributes:
        object: The object's name.
        pair: Index of the pair of each link and the object.
        taxels: First of each link's taxels, and one beyond the last.
        points: Places in the object's frame [m].
        area: Surface that each stands for [m²].
        links: The links' own surfaces, each in the frame of its body: an object whose cases are links.
    """

    object: str
    pair: Int[Tensor, " link"]
    taxels: tuple[tuple[int, int], ...]
    points: tuple[Float[Tensor, "case 1 point"], Float[Tensor, "case 1 point"], Float[Tensor, "case 1 point"]]
    area: Float[Tensor, "case 1"]
    links: FeltObject


def with_points(felt: Felt, pairs: Pairs, sources: Sequence[PointSource]) -> Felt:
    """Return an answer with the points of objects added, gated as the pairs are."""
    return felt._replace(points={source.object: _met(pairs, source) for source in sources})


def _met(pairs: Pairs, source: PointSource) -> MetPoints:
    """Return the points of one object."""
    links = source.links
    are_grids = all(isinstance(surface, Grid) for surface in links.surfaces)
    if are_grids and takes_kernel(*pairs.rotation, *pairs.offset, *source.points, links.pos, links.rotation):
        return _met_by_kernel(pairs, source)
    rotation = planes.rot(part[:, source.pair, None] for part in pairs.rotation)
    offset = planes.vec(part[:, source.pair, None] for part in pairs.offset)
    pos = planes.rotate_back(rotation, planes.sub(source.points, offset))
    distance, gradient = body_distance(pos, links)
    if pairs.gate is not None:
        distance = torch.where(pairs.gate[:, source.pair, None] < 0, torch.inf, distance)
    return MetPoints(source.taxels, planes.vec(map(stored, pos)), distance, gradient, source.area)


def _met_by_kernel(pairs: Pairs, source: PointSource) -> MetPoints:
    """Return the points of one object where all geoms of the links are grids, one geom after the other."""
    from tgdsl.geometry.skin_kernel import meet

    found = [meet(pairs, source.pair, source.points, source.links, g) for g in range(len(source.links.shapes))]
    distance, gradient = united([geom[1:] for geom in found], source.links.is_absent)
    return MetPoints(source.taxels, found[0][0], distance, gradient, source.area)

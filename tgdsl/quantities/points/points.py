"""Points that are sampled on objects, where links see them, and how deep they are in the links' own surfaces.

Shapes: `env` environments, `link` links that may meet one object, `point` points of it, `case` 1, or `env` if the object
differs between environments, `tile` groups of taxels that a GPU's kernel takes at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.grid import Grid
from tgdsl.geometry.planes import Vec
from tgdsl.quantities.geoms.distance import Geoms, body_distance, united
from tgdsl.quantities.pairs import Pairs
from tgdsl.tensors.fusion import materialised
from tgdsl.tensors.operations import Operation

SMALLEST_TILE, LARGEST_TILE = 32, 128
"""Numbers of taxels of a tile."""


class PointSource(NamedTuple):
    """The points of one object, and the links that they may meet.

    Attributes:
        object: The object's name.
        pair: Index of the pair of each link and the object.
        taxels: First of each link's taxels, and one beyond the last.
        tiles: What `point_tiles` returns of them.
        points: Places in the object's frame [m].
        area: Surface that each stands for [m²].
        links: The links' own surfaces, each in the frame of its body: an object whose cases are links.
    """

    object: str
    pair: Int[Tensor, " link"]
    taxels: tuple[tuple[int, int], ...]
    tiles: Int[Tensor, "tile 3"]
    points: tuple[Float[Tensor, "case 1 point"], Float[Tensor, "case 1 point"], Float[Tensor, "case 1 point"]]
    area: Float[Tensor, "case 1"]
    links: Geoms


class LinkPoints(NamedTuple):
    """Points sampled on one object, as the links that they may meet see them; planes (env, link, point), in each link's frame.

    Attributes:
        taxels: First of each link's taxels, and one beyond the last.
        tiles: What `points.point_tiles` returns of them.
        pos: Where they are now [m]; a compiler stores them.
        distance: Signed distance to the link's own surface [m]; +∞ where the gate is closed, and maybe where it is beyond what
            the sensors asked for.
        gradient: Its unit gradient.
        area: Surface of the object that each stands for [m²], (case, 1).
    """

    taxels: tuple[tuple[int, int], ...]
    tiles: Int[Tensor, "tile 3"]
    pos: Vec
    distance: Tensor
    gradient: Vec
    area: Tensor


class ObjectPoints(NamedTuple):
    """The points of one object, and the pairs by which links see them, gated as these are."""

    pairs: Pairs
    source: PointSource


def link_points(own: ObjectPoints) -> LinkPoints:
    """Return where the points are, and how deep in the links' surfaces."""
    pairs, source = own
    rotation = planes.rot(part[:, source.pair, None] for part in pairs.rotation)
    offset = planes.vec(part[:, source.pair, None] for part in pairs.offset)
    pos = planes.rotate_back(rotation, planes.sub(source.points, offset))
    distance, gradient = body_distance(pos, source.links)
    if pairs.gate is not None:
        distance = torch.where(pairs.gate[:, source.pair, None] < 0, torch.inf, distance)
    return LinkPoints(source.taxels, source.tiles, planes.vec(map(materialised, pos)), distance, gradient, source.area)


def point_tiles(taxels: Sequence[tuple[int, int]], num_taxels: int) -> list[tuple[int, int, int]]:
    """Return tiles that cover all taxels of a query: the number of a link, −1 for none, its first taxel, one beyond the last.

    Args:
        taxels: First of each link's taxels, and one beyond the last.
        num_taxels: Number of the query's taxels.
    """
    size, found, end = tile_size(taxels), [], 0
    owners = sorted((first, last, link) for link, (first, last) in enumerate(taxels))
    for first, last, link in [*owners, (num_taxels, num_taxels, -1)]:
        found += [(-1, start, min(start + size, first)) for start in range(end, first, size)]
        found += [(link, start, min(start + size, last)) for start in range(first, last, size)]
        end = last
    return found


def tile_size(taxels: Sequence[tuple[int, int]]) -> int:
    """Return the largest number of taxels of a tile, a power of two."""
    most = max([1, *[last - first for first, last in taxels]])
    return min(max(1 << (most - 1).bit_length(), SMALLEST_TILE), LARGEST_TILE)


def _by_kernel(own: ObjectPoints) -> LinkPoints:
    """One geom of the links after the other."""
    from tgdsl.quantities.points.depth_kernel import meet

    pairs, source = own
    found = [meet(pairs, source.pair, source.points, source.links, g) for g in range(len(source.links.shapes))]
    distance, gradient = united([geom[1:] for geom in found], source.links.is_absent)
    return LinkPoints(source.taxels, source.tiles, found[0][0], distance, gradient, source.area)


def _inputs(own: ObjectPoints) -> list[Tensor]:
    (rotation, offset, _, _), source = own
    return [*rotation, *offset, *source.points, source.links.pos, source.links.rotation]


def are_grids(own: ObjectPoints) -> bool:
    """Return whether all geoms of the links are grids."""
    return all(isinstance(surface, Grid) for surface in own.source.links.surfaces)


LINK_POINTS = Operation("meet", link_points, _by_kernel, _inputs, are_grids)

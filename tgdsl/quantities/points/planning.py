"""From requests for points to their part of the Plan: objects sampled, links' own surfaces baked, who may meet whom."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tgdsl.errors import BakeError, LowerError
from tgdsl.layout.layout import Link
from tgdsl.quantities.base import Planning, Use
from tgdsl.quantities.geoms.baking import GeomDistance, geom_distance, geom_table
from tgdsl.quantities.moments.clouds import sample_points
from tgdsl.quantities.pairs import Pair
from tgdsl.quantities.points.part import CloudPart, MetObject, PointsPart, PointsUse
from tgdsl.quantities.points.points import point_tiles
from tgdsl.quantities.points.request import Points
from tgdsl.surfaces.sensed import DistanceOptions, SensedObject

LINKS = DistanceOptions()
"""How the distance to links' own surfaces is found."""


def plan(planning: Planning, uses: Sequence[Use]) -> PointsPart[np.ndarray]:
    """Return the part of the Plan; an object or a link without a surface is a mistake."""
    clouds = _clouds(planning, uses)
    links = _links(planning, uses)
    numbers = {key: i for i, key in enumerate(clouds)}
    return PointsPart(
        links=tuple(links),
        surfaces=geom_table(list(links.values())) if links else None,
        clouds=tuple(clouds.values()),
        uses=tuple(_use(planning, use, numbers, list(links)) for use in uses),
    )


def _request(use: Use) -> Points:
    assert isinstance(use.request, Points)
    return use.request


def _clouds(planning: Planning, uses: Sequence[Use]) -> dict[tuple[int, str], CloudPart[np.ndarray]]:
    """Return the points of all objects, by their number and the object."""
    found: dict[tuple[int, str], CloudPart[np.ndarray]] = {}
    for use in uses:
        num_points = _request(use).num_points
        for i, name in enumerate(use.request.objects):
            number = planning.object_id(name)
            if (num_points, name) in found or number is None:
                continue
            planning.progress(f"object {name}: points on its surface")
            try:
                found[num_points, name] = cloud(planning.sensed[name], num_points, number)
            except LowerError as error:
                planning.report(("sensors", use.sensors[0], "feels", i), error.what, error.hint)
    return found


def cloud(sensed: SensedObject, num_points: int, number: int) -> CloudPart[np.ndarray]:
    """Return the points of an object.

    Raises:
        LowerError: If it has no surface of a fixed size to sample ("feels").
    """
    if sensed.is_sized:
        what = f'the size of body "{sensed.body}" is given per environment, and points are sampled beforehand'
        raise LowerError(what, "feels", "use `variants` for the sizes that it has, or `anchors: taxels`")
    if any(geom.shape == "plane" for geoms in sensed.variants for geom in geoms):
        what = f'body "{sensed.body}" has a plane, which has no end, so no points can be sampled on it'
        raise LowerError(what, "feels", "use `anchors: taxels`, which take hold of any surface, or a box instead of the plane")
    try:
        sampled = [sample_points(geoms, num_points) for geoms in sensed.variants]
    except BakeError as error:
        raise LowerError(f'body "{sensed.body}": {error}', "feels") from error
    points = np.stack([pos.T for pos, _ in sampled], axis=1)
    return CloudPart(number, points, np.array([area / num_points for _, area in sampled]))


def _links(planning: Planning, uses: Sequence[Use]) -> dict[str, list[GeomDistance]]:
    """Return how the distance to each link's own surface is found."""
    found: dict[str, list[GeomDistance]] = {}
    for use in uses:
        for link in use.links:
            if link.name in found:
                continue
            planning.progress(f"link {link.name}: distances")
            try:
                margin = _margin(planning, link, uses)
                geoms = planning.geoms_of(link.name)
                found[link.name] = [geom_distance(geom, LINKS, margin, f"link {link.name}") for geom in geoms]
            except BakeError as error:
                place = ("sensors", use.sensors[0], "links")
                planning.report(place, f'link "{link.name}": {error}', "or use `anchors: taxels`")
    return found


def _margin(planning: Planning, link: Link, uses: Sequence[Use]) -> float:
    """Return the largest distance from a link's own surface that any sensor on it asks for [m].

    Where sensors tell nothing apart outside the surface, the probes' radii say how deep points come.
    """
    found = []
    for use in uses:
        if link in use.links:
            found += [_request(use).range, float(planning.layout.radius[use.taxels].max())]
    return max(found)


def _use(planning: Planning, use: Use, clouds: dict[tuple[int, str], int], links: Sequence[str]) -> PointsUse[np.ndarray]:
    request, layout = _request(use), planning.layout.take(use.taxels)
    active = [i for i in range(len(layout.links)) if (layout.radius[layout.link_id == i] > 0).any()]
    allowed, found = planning.allowed(request), []
    for name in request.objects:
        own = [i for i in active if Pair(layout.links[i].body, name) in allowed and layout.links[i].name in links]
        number = clouds.get((request.num_points, name))
        if not own or number is None:
            continue
        pair = [planning.pairs.index(Pair(layout.links[i].body, name)) for i in own]
        places = [np.flatnonzero(layout.link_id == i) for i in own]
        taxels = tuple((int(part[0]), int(part[-1]) + 1) for part in places)
        met = tuple(links.index(layout.links[i].name) for i in own)
        tiles = np.array(point_tiles(taxels, len(use.taxels)), dtype=np.int32).reshape(-1, 3)
        found.append(MetObject(number, met, taxels, np.array(pair), np.array(met), tiles))
    return PointsUse(request.is_gated, tuple(found))

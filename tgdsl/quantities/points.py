"""Points that are sampled on objects, where links see them, and how deep they are in the links' own surfaces.

Shapes: `env` environments, `link` links that may meet one object, `point` points of it, `case` 1, or `env` if the object
differs between environments, `tile` groups of taxels that a GPU's kernel takes at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.errors import BakeError, LowerError
from tgdsl.geometry import planes
from tgdsl.geometry.grid import Grid
from tgdsl.geometry.planes import Vec, vec
from tgdsl.quantities.base import Planning, Quantity, Request, Scene, Use, pairs_for, variant_of
from tgdsl.quantities.geoms import (
    Geoms,
    GeomTable,
    account_of_geoms,
    body_distance,
    distance_to,
    geoms_of,
    geoms_of_cases,
    united,
)
from tgdsl.quantities.pairs import Pair, PairedObject, Pairs
from tgdsl.quantities.reference import ReferenceScene
from tgdsl.surfaces.sensed import DistanceOptions, SensedObject
from tgdsl.tensors.fusion import materialised
from tgdsl.tensors.operations import Operation

LINKS = DistanceOptions()  # how the distance to links' own surfaces is computed
SMALLEST_TILE, LARGEST_TILE = 32, 128  # numbers of taxels of a tile


class PointSource(NamedTuple):
    """The points of one object, and the links that they may meet."""

    object: str
    pair: Int[Tensor, " link"]  # index of the pair of each link and the object
    taxels: tuple[tuple[int, int], ...]  # first of each link's taxels, and one beyond the last
    tiles: Int[Tensor, "tile 3"]  # what `point_tiles` returns of them
    # places in the object's frame [m]
    points: tuple[Float[Tensor, "case 1 point"], Float[Tensor, "case 1 point"], Float[Tensor, "case 1 point"]]
    area: Float[Tensor, "case 1"]  # surface that each stands for [m²]
    links: Geoms  # the links' own surfaces, each in the frame of its body: an object whose cases are links


class LinkPoints(NamedTuple):
    """Points sampled on one object, in the frames of the links that they may meet; planes (env, link, point)."""

    taxels: tuple[tuple[int, int], ...]  # first of each link's taxels, and one beyond the last
    tiles: Int[Tensor, "tile 3"]  # what `point_tiles` returns of them
    pos: Vec  # where they are now [m]; a compiler stores them
    # signed distance to the link's own surface [m]; +∞ where the gate is closed, and possibly beyond the requested distance
    distance: Tensor
    gradient: Vec  # its unit gradient
    area: Tensor  # surface of the object that each stands for [m²], (case, 1)


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

    `taxels` has the first of each link's taxels, and one beyond the last.
    """
    size, result, end = tile_size(taxels), [], 0
    owners = sorted((first, last, link) for link, (first, last) in enumerate(taxels))
    for first, last, link in [*owners, (num_taxels, num_taxels, -1)]:
        result += [(-1, start, min(start + size, first)) for start in range(end, first, size)]
        result += [(link, start, min(start + size, last)) for start in range(first, last, size)]
        end = last
    return result


def tile_size(taxels: Sequence[tuple[int, int]]) -> int:
    """Return the largest number of taxels of a tile, a power of two."""
    most = max([1, *[last - first for first, last in taxels]])
    return min(max(1 << (most - 1).bit_length(), SMALLEST_TILE), LARGEST_TILE)


def _by_kernel(own: ObjectPoints) -> LinkPoints:
    from tgdsl.quantities.depth_kernel import meet

    pairs, source = own
    results = [meet(pairs, source.pair, source.points, source.links, g) for g in range(len(source.links.shapes))]
    distance, gradient = united([geom[1:] for geom in results], source.links.is_absent)
    return LinkPoints(source.taxels, source.tiles, results[0][0], distance, gradient, source.area)


def _inputs(own: ObjectPoints) -> list[Tensor]:
    (rotation, offset, _, _), source = own
    return [*rotation, *offset, *source.points, source.links.pos, source.links.rotation]


def are_grids(own: ObjectPoints) -> bool:
    """Return whether all geoms of the links are grids."""
    return all(isinstance(surface, Grid) for surface in own.source.links.surfaces)


LINK_POINTS = Operation("meet", link_points, _by_kernel, _inputs, are_grids)
Array = TypeVar("Array")


@dataclass(frozen=True, eq=False)
class Points(Request[dict[str, ObjectPoints]]):
    """Asks for points of objects. Where a gate is closed they are nowhere: their distance is +∞."""

    num_points: int = 5000  # points of each object
    range: float = 0.0  # distance from a link's surface up to which it is needed [m]


@dataclass(frozen=True, eq=False)
class CloudPart(Generic[Array]):
    """The points of one object."""

    object: int  # the object: its place in the Plan
    points: Array  # places in its body's frame [m], (3, variant, point)
    area: Array  # surface that each stands for [m²], (variant,)


@dataclass(frozen=True, eq=False)
class MetObject(Generic[Array]):
    """An object of a use, and the links that may meet it."""

    cloud: int
    links: tuple[int, ...]  # the links: indices into `PointsPart.links`
    taxels: tuple[tuple[int, int], ...]  # first of each link's taxels among the use's, and one beyond the last
    pair: Array  # index of the pair of each link and the object among all pairs, (link,)
    link: Array  # `links` as an array, (link,)
    tiles: Array  # what `point_tiles` returns of the taxels, (tile, 3)


@dataclass(frozen=True, eq=False)
class PointsUse(Generic[Array]):
    """One request: its objects, and whether they count only in contact."""

    is_gated: bool
    objects: tuple[MetObject[Array], ...]


@dataclass(frozen=True, eq=False)
class PointsPart(Generic[Array]):
    """All of it."""

    links: tuple[str, ...]  # names of the links whose own surfaces points are measured against
    surfaces: GeomTable[Array] | None  # their geoms: a case for each link; None if there is none
    clouds: tuple[CloudPart[Array], ...]  # the objects' points
    uses: tuple[PointsUse[Array], ...]  # the uses


@dataclass(frozen=True, eq=False)
class ReferencePoints:
    """Points sampled on one object, in the frame of one link that they may meet: a row of `points.LinkPoints` as arrays."""

    taxels: Int[np.ndarray, " own"]  # the link's taxels
    pos: Float[np.ndarray, "point 3"]  # where they are [m]
    distance: Float[np.ndarray, " point"]  # signed distance to the link's own surface [m]; +∞ where the gate is closed
    gradient: Float[np.ndarray, "point 3"]  # its unit gradient
    area: float  # surface that each stands for [m²]


class _Points(Quantity):
    name, request, part = "points", Points, PointsPart
    has_rows = True

    def plan(self, planning: Planning, uses: Sequence[Use]) -> PointsPart[np.ndarray]:
        """Return the part of the Plan; an object or a link without a surface is a mistake."""
        from tgdsl.quantities.bake import geom_table  # compilers alone bake meshes

        clouds, links = _clouds(planning, uses), _links(planning, uses)
        return PointsPart(
            links=tuple(links),
            surfaces=geom_table(list(links.values())) if links else None,
            clouds=tuple(clouds.values()),
            uses=tuple(_use(planning, use, list(clouds), list(links)) for use in uses),
        )

    def gather(self, part: PointsPart[Tensor], scene: Scene) -> tuple[dict[str, ObjectPoints], ...]:
        results = []
        for use in part.uses:
            pairs, points_of = pairs_for(scene, use.is_gated), {}
            if pairs.gate is not None:
                lost = pairs.gate.clamp(min=0.0)  # zero where it is a number: else the points are nowhere
                pairs = pairs._replace(offset=planes.vec(part + lost for part in pairs.offset))
            for met in use.objects:
                cloud = part.clouds[met.cloud]
                target = scene.objects[cloud.object]
                points, area, variant = cloud.points, cloud.area, variant_of(scene, target)
                if variant is not None:
                    points, area = points[:, variant], area[variant]
                assert part.surfaces is not None
                where, links = vec(points[:, :, None].unbind()), geoms_of_cases(part.surfaces, met.link)
                source = PointSource(target.name, met.pair, met.taxels, met.tiles, where, area[:, None], links)
                points_of[target.name] = ObjectPoints(pairs, source)
            results.append(points_of)
        return tuple(results)

    def reference(self, part: PointsPart[np.ndarray], use: int, scene: ReferenceScene) -> tuple[ReferencePoints, ...]:
        use_part, layout = part.uses[use], scene.layout
        numbers = {link.name: (i, link.body) for i, link in enumerate(layout.links)}
        results = []
        for met in use_part.objects:
            cloud = part.clouds[met.cloud]
            target = scene.objects[cloud.object]
            body, variant = scene.object_body(target), scene.variant(target)
            world = cloud.points[:, variant].T @ body.rotation.T + body.pos
            area = float(cloud.area[variant])
            for row in met.links:
                assert part.surfaces is not None
                i, name = numbers[part.links[row]]
                link, geoms = scene.body(name), geoms_of(part.surfaces, row)
                pos = (world - link.pos) @ link.rotation
                phi, gradient = (np.array(one) for one in zip(*(distance_to(geoms, z) for z in pos), strict=True))
                if use_part.is_gated and not scene.is_touching(name, target.name):
                    phi = np.full(len(pos), np.inf)
                results.append(ReferencePoints(np.flatnonzero(layout.link_id == i), pos, phi, gradient, area))
        return tuple(results)

    def fields(self, part: PointsPart) -> set[str]:
        return {"contact_found"} if any(use.is_gated for use in part.uses) else set()

    def num_rows(self, part: PointsPart, use: int) -> int:
        return sum(part.clouds[met.cloud].points.shape[2] * len(met.links) for met in part.uses[use].objects)

    def explain(self, part: PointsPart, use: int, objects: Sequence[PairedObject]) -> list[str]:
        lines = []
        for met in part.uses[use].objects:
            cloud, links = part.clouds[met.cloud], ", ".join(part.links[i] for i in met.links)
            lines.append(f"{cloud.points.shape[2]} points of {objects[cloud.object].name} against {links}")
        return lines

    def account(self, part: PointsPart, objects: Sequence[PairedObject]) -> dict[str, list[str]]:
        lines = [] if part.surfaces is None else account_of_geoms(part.surfaces, [f"link {name}" for name in part.links])
        return {"meshes": lines} if lines else {}


POINTS = _Points()


def _clouds(planning: Planning, uses: Sequence[Use]) -> dict[tuple[int, str], CloudPart[np.ndarray]]:
    """Return the points of all objects, by their number and the object."""
    result: dict[tuple[int, str], CloudPart[np.ndarray]] = {}
    for use in uses:
        num_points = use.request.num_points
        for i, name in enumerate(use.request.objects):
            number = planning.object_id(name)
            if (num_points, name) in result or number is None:
                continue
            planning.progress(f"object {name}: points on its surface")
            try:
                result[num_points, name] = _cloud(planning.sensed[name], num_points, number)
            except LowerError as error:
                planning.report(("sensors", use.sensors[0], "feels", i), error.what, error.hint)
    return result


def _cloud(sensed: SensedObject, num_points: int, number: int) -> CloudPart[np.ndarray]:
    """Return the points of an object; a LowerError says why it has no surface of a fixed size to sample."""
    from tgdsl.quantities.moment_fields import sample_points

    if sensed.is_sized:
        problem = f'the size of body "{sensed.body}" is given per environment, and points are sampled beforehand'
        raise LowerError(problem, "feels", "use `variants` for the sizes that it has, or `anchors: taxels`")
    if any(geom.shape == "plane" for geoms in sensed.variants for geom in geoms):
        problem = f'body "{sensed.body}" has a plane, which has no end, so no points can be sampled on it'
        hint = "use `anchors: taxels`, which take hold of any surface, or a box instead of the plane"
        raise LowerError(problem, "feels", hint)
    try:
        sampled = [sample_points(geoms, num_points) for geoms in sensed.variants]
    except BakeError as error:
        raise LowerError(f'body "{sensed.body}": {error}', "feels") from error
    points = np.stack([pos.T for pos, _ in sampled], axis=1)
    return CloudPart(number, points, np.array([area / num_points for _, area in sampled]))


def _links(planning: Planning, uses: Sequence[Use]) -> dict[str, list[Any]]:
    """Return how the distance to each link's own surface is computed."""
    from tgdsl.quantities.bake import geom_distance

    result: dict[str, list[Any]] = {}
    for use in uses:
        for link in use.links:
            if link.name in result:
                continue
            planning.progress(f"link {link.name}: distances")
            try:
                users = [other for other in uses if link in other.links]
                # Where sensors tell nothing apart outside the surface, the probes' radii say how deep points come.
                radii = [planning.layout.radius[other.taxels].max() for other in users]
                margin = float(max([*radii, *(other.request.range for other in users)]))
                geoms = planning.geoms_of(link.name)
                result[link.name] = [geom_distance(geom, LINKS, margin, f"link {link.name}") for geom in geoms]
            except BakeError as error:
                place = ("sensors", use.sensors[0], "links")
                planning.report(place, f'link "{link.name}": {error}', "or use `anchors: taxels`")
    return result


def _use(planning: Planning, use: Use, clouds: list[tuple[int, str]], links: list[str]) -> PointsUse[np.ndarray]:
    layout, allowed, result = planning.layout.take(use.taxels), planning.allowed(use.request), []
    for name in use.request.objects:
        rows = [
            (link, places)
            for i, link in enumerate(layout.links)
            if (layout.radius[places := np.flatnonzero(layout.link_id == i)] > 0).any()
            and Pair(link.body, name) in allowed
            and link.name in links
        ]
        if not rows or (use.request.num_points, name) not in clouds:
            continue
        pair = [planning.pairs.index(Pair(link.body, name)) for link, _ in rows]
        taxels = tuple((int(places[0]), int(places[-1]) + 1) for _, places in rows)
        met = tuple(links.index(link.name) for link, _ in rows)
        tiles = np.array(point_tiles(taxels, len(use.taxels)), dtype=np.int32).reshape(-1, 3)
        number = clouds.index((use.request.num_points, name))
        result.append(MetObject(number, met, taxels, np.array(pair), np.array(met), tiles))
    return PointsUse(use.request.is_gated, tuple(result))

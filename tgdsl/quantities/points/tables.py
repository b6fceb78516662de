"""Points of objects that meet links, as the Plan holds them: the points themselves, and which object's which link may meet."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from tgdsl.compiler.felt import FeltBody, Settled
from tgdsl.compiler.resolve import Resolved
from tgdsl.errors import BakeError, LowerError
from tgdsl.layout.layout import Layout
from tgdsl.plan.plan import Pair, PlannedPoints, PlannedSkin
from tgdsl.quantities.contact_depth.geom_tables import Placed, accuracy, is_centred, placed_geoms
from tgdsl.quantities.moments.clouds import sample_points
from tgdsl.sensors.base import PointsRequest
from tgdsl.surfaces.geom import SurfaceGeom

Skin = tuple[tuple[SurfaceGeom, ...], tuple[Settled, ...]]
"""A link's own geoms, and how the distance to each is found."""


def cloud(felt: FeltBody, num_points: int) -> dict[str, np.ndarray]:
    """Return the points of an object (3, variant, point) [m], and the area that each stands for (variant,) [m²].

    Raises:
        LowerError: If it has no surface of a fixed size to sample ("feels").
    """
    if felt.is_sized:
        what = f'the size of body "{felt.body}" is given per environment, and points are sampled beforehand'
        raise LowerError(what, "feels", "use `variants` for the sizes that it has, or `anchors: taxels`")
    if any(geom.shape == "plane" for geoms in felt.variants for geom in geoms):
        what = f'body "{felt.body}" has a plane, which has no end, so no points can be sampled on it'
        raise LowerError(what, "feels", "use `anchors: taxels`, which take hold of any surface, or a box instead of the plane")
    try:
        sampled = [sample_points(geoms, num_points) for geoms in felt.variants]
    except BakeError as error:
        raise LowerError(f'body "{felt.body}": {error}', "feels") from error
    return {
        "points": np.stack([pos.T for pos, _ in sampled], axis=1),
        "area": np.array([area / num_points for _, area in sampled]),
    }


def own_geoms(resolved: Resolved, link: str) -> tuple[SurfaceGeom, ...]:
    """Return the geoms that a link's taxels sit on: meshes as they are, not their convex hulls."""
    geoms = resolved.patches[link].geoms
    return tuple(SurfaceGeom(geom, resolved.robot.mesh(geom) if geom.shape == "mesh" else None) for geom in geoms)


def skin_rows(skins: Mapping[str, Skin]) -> tuple[tuple[str, ...], list[list[Placed | None]]]:
    """Return how the distance to each geom of links is found, and the geoms that each link has there."""
    return placed_geoms([geoms for geoms, _ in skins.values()], [settled for _, settled in skins.values()])


def planned_skin(skins: Mapping[str, Skin]) -> PlannedSkin | None:
    """Return the links' own surfaces as the Plan holds them; None if there are none."""
    if not skins:
        return None
    shapes, rows = skin_rows(skins)
    return PlannedSkin(tuple(skins), shapes, is_centred(rows), accuracy(rows))


def pack_points(
    request: PointsRequest,
    reachable: Sequence[str],
    layout: Layout,
    pairs: Sequence[Pair],
    allowed: Collection[Pair],
    names: Sequence[str],
    skins: Sequence[str],
    path: str,
    arrays: dict[str, np.ndarray],
) -> PlannedPoints:
    """Write which links of an answer may meet which of its objects into the arrays.

    Args:
        request: Which points.
        reachable: Names of the answer's objects.
        layout: Its taxels.
        pairs: All pairs.
        allowed: Those of them that the answer may feel.
        names: Names of all objects, in the Plan's order.
        skins: Names of the links whose own surfaces the Plan holds.
        path: Of the answer's points.
        arrays: The Plan's arrays.
    """
    active = [i for i in range(len(layout.links)) if (layout.radius[layout.link_id == i] > 0).any()]
    met: dict[str, tuple[int, ...]] = {}
    taxels = []
    for name in reachable:
        links = [i for i in active if Pair(layout.links[i].body, name) in allowed]
        if not links:
            continue
        here = f"{path}/{len(met)}"
        arrays[f"{here}/pair"] = np.array([pairs.index(Pair(layout.links[i].body, name)) for i in links])
        met[name] = tuple(skins.index(layout.links[i].name) for i in links)
        arrays[f"{here}/link"] = np.array(met[name])
        own = [np.flatnonzero(layout.link_id == i) for i in links]
        taxels.append(tuple((int(part[0]), int(part[-1]) + 1) for part in own))
    return PlannedPoints(request.num_points, tuple(names.index(name) for name in met), tuple(met.values()), tuple(taxels))

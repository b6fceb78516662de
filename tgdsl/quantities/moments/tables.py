"""The moments of an object as the Plan holds them: one table per variant and radius.

Shapes: `taxel` probes of a query, `variant` variants of an object.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tgdsl.compiler.felt import FeltBody
from tgdsl.errors import BakeError, LowerError
from tgdsl.plan.plan import Pair, PlannedMoments
from tgdsl.quantities.moments.clouds import sample_cloud
from tgdsl.quantities.moments.fields import FieldErrors, bake_field, surface_area
from tgdsl.sensors.base import MomentsRequest
from tgdsl.surfaces.geom import SurfaceGeom


@dataclass(frozen=True, eq=False)
class MomentTables:
    """An object's moments.

    Attributes:
        radii: Radii that there are fields of [m], ascending.
        area: Area of each variant, planes left out [m²].
        arrays: What the Plan holds of them, by name.
        accuracy: What was measured of each field, variant after variant, radius by radius.
    """

    radii: tuple[float, ...]
    area: Float[np.ndarray, " variant"]
    arrays: Mapping[str, np.ndarray]
    accuracy: tuple[Mapping[str, float], ...]


def moment_tables(felt: FeltBody, request: MomentsRequest, radii: Sequence[float]) -> MomentTables:
    """Compute the moments of an object beforehand.

    Args:
        felt: The object.
        request: How they are to be found.
        radii: The sensing radii of its probes [m], ascending, each above 0.

    Raises:
        LowerError: If its size is part of the state ("feels"), or the tolerance takes more than the budget.
    """
    if felt.is_sized:
        what = f'the size of body "{felt.body}" is given per environment, and moments are computed beforehand'
        raise LowerError(what, field="feels", hint="use `variants` for the sizes that it has, or feel other objects")
    solid = [tuple(geom for geom in geoms if geom.shape != "plane") for geoms in felt.variants]
    arrays = _planes([geom for geom in felt.variants[0] if geom.shape == "plane"])
    area = np.array([surface_area(geoms) if geoms else 0.0 for geoms in solid])
    arrays["area"] = area
    accuracy: list[Mapping[str, float]] = []
    try:
        if any(solid) and request.backend == "field":
            tables, accuracy = _fields(solid, request, radii)
            arrays |= tables
        elif any(solid):
            arrays |= _clouds(solid, request, radii[-1])
    except BakeError as error:
        raise LowerError(f'body "{felt.body}": {error}') from error
    return MomentTables(tuple(radii), area, arrays, tuple(accuracy))


def _planes(geoms: Sequence[SurfaceGeom]) -> dict[str, np.ndarray]:
    pos, rotation = [part.geom.pos for part in geoms], [part.geom.rotation for part in geoms]
    return {"plane_pos": np.reshape(pos, (-1, 3)), "plane_rotation": np.reshape(rotation, (-1, 9))}


def _fields(
    variants: Sequence[tuple[SurfaceGeom, ...]], request: MomentsRequest, radii: Sequence[float]
) -> tuple[dict[str, np.ndarray], list[Mapping[str, float]]]:
    """Return the fields of all variants and radii, one after the other, and their accuracy."""
    baked, left = [], request.max_bytes
    for geoms in variants:
        for radius in radii:
            with_slope = request.radius_noise > 0
            limits = (request.tolerance, request.gradient_tolerance)
            baked.append(bake_field(geoms, radius, *limits, request.max_bytes, with_slope))
            left -= baked[-1].values.nbytes
    if left < 0:
        needed = request.max_bytes - left
        raise BakeError(
            f"fields of {len(variants)} variants at {len(radii)} radii need {needed / 2**20:.3g} MiB ({needed} bytes), and the"
            f" budget is {request.max_bytes / 2**20:.3g} MiB ({request.max_bytes} bytes); raise the tolerance or the budget,"
            " or use fewer radii"
        )
    num = np.array([field.values.shape[:3] for field in baked])
    tables = {
        "values": np.concatenate([field.values.reshape(-1, field.values.shape[-1]) for field in baked]),
        "first": np.cumsum([0, *num.prod(axis=1)[:-1]]),
        "num": num,
        "origin": np.array([field.origin for field in baked]),
        "cell": np.array([field.cell for field in baked]),
    }
    pairs = zip(baked, [*radii] * len(variants), strict=True)
    return tables, [{**_measured(field.errors), "radius": radius, "cell": field.cell} for field, radius in pairs]


def _measured(errors: FieldErrors) -> dict[str, float]:
    """Return the errors that were measured, by name."""
    return {name: value for name, value in dataclasses.asdict(errors).items() if value is not None}


def _clouds(variants: Sequence[tuple[SurfaceGeom, ...]], request: MomentsRequest, radius: float) -> dict[str, np.ndarray]:
    """Return the points of all variants and their lists; the last row is out of reach of everything."""
    budget, noise = request.max_bytes // len(variants), request.radius_noise
    clouds = [sample_cloud(geoms, radius, request.num_points, budget, noise) for geoms in variants]
    slots, none = max(cloud.lists.shape[1] for cloud in clouds), sum(len(cloud.points) for cloud in clouds)
    lists, before = [], 0
    for cloud in clouds:
        rows = np.where(cloud.lists < len(cloud.points), cloud.lists + before, none)
        lists.append(np.pad(rows, ((0, 0), (0, slots - rows.shape[1])), constant_values=none))
        before += len(cloud.points)
    return {
        "points": np.concatenate([*(cloud.points for cloud in clouds), np.full((1, 3), FAR)]).T,
        "weight": np.array([cloud.weight for cloud in clouds]),
        "lists": np.concatenate(lists),
        "first": np.cumsum([0, *(len(own) for own in lists[:-1])]),
        "num": np.array([cloud.num for cloud in clouds]),
        "origin": np.array([cloud.origin for cloud in clouds]),
        "cell": np.array([cloud.cell for cloud in clouds]),
    }


FAR = 1e6
"""Coordinates of the point that fills lists [m]: out of reach of everything, its square still a float32."""


def pack_moments(
    request: MomentsRequest,
    reachable: Sequence[str],
    radius: Float[np.ndarray, " taxel"],
    bodies: Sequence[str],
    pairs: Sequence[Pair],
    names: Sequence[str],
    tables: Mapping[tuple[MomentsRequest, str], MomentTables],
    path: str,
    arrays: dict[str, np.ndarray],
) -> PlannedMoments:
    """Write the tables of an answer's objects, and which of them each probe asks, into the arrays.

    Args:
        request: How moments are found.
        reachable: Names of the answer's objects.
        radius: How far from each taxel objects are felt [m]; −∞ for inactive ones.
        bodies: The body of each taxel.
        pairs: All pairs, sorted by object.
        names: Names of all objects, in the Plan's order.
        tables: The moments of all objects.
        path: Of the answer's arrays.
        arrays: The Plan's arrays.
    """
    number = list(dict.fromkeys(own for own, _ in tables)).index(request) if tables else 0
    chosen = [name for name in reachable if (request, name) in tables]
    index, reach, radius_id = np.zeros((3, len(chosen), len(bodies)))
    for o, name in enumerate(chosen):
        own, found = [pair for pair in pairs if pair.object == name], tables[request, name]
        arrays |= {f"objects/{name}/moments/{number}/{key}": value for key, value in found.arrays.items()}
        for t, body in enumerate(bodies):
            if Pair(body, name) in own and radius[t] > 0:
                index[o, t], reach[o, t] = own.index(Pair(body, name)), radius[t]
                radius_id[o, t] = found.radii.index(radius[t])
    arrays[f"{path}/pair"], arrays[f"{path}/radius_id"] = index.astype(np.int64), radius_id.astype(np.int64)
    arrays[f"{path}/reach"] = reach
    return PlannedMoments(
        request=number,
        backend=request.backend,
        objects=tuple(names.index(name) for name in chosen),
        radii=tuple(tables[request, name].radii for name in chosen),
        accuracy=tuple(tables[request, name].accuracy for name in chosen),
        is_smooth=request.gradient_tolerance is not None,
    )

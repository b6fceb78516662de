"""From requests for moments to their part of the Plan: one table per object and way to find them, of all variants and radii."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tgdsl.errors import BakeError, LowerError
from tgdsl.quantities.base import Planning, Use
from tgdsl.quantities.moments.clouds import sample_cloud
from tgdsl.quantities.moments.fields import FieldErrors, bake_field, surface_area
from tgdsl.quantities.moments.part import CloudTable, FieldTable, MomentsPart, MomentTable, MomentUse
from tgdsl.quantities.moments.request import MomentsRequest
from tgdsl.quantities.pairs import Pair
from tgdsl.surfaces.geom import SurfaceGeom
from tgdsl.surfaces.sensed import SensedObject

FAR = 1e6
"""Coordinates of the point that fills lists [m]: out of reach of everything, its square still a float32."""
Solid = Sequence[tuple[SurfaceGeom, ...]]
Number = dict[tuple[Any, ...], int]
"""Number of a table, by the way in which moments are found and the object."""


def plan(planning: Planning, uses: Sequence[Use]) -> MomentsPart[np.ndarray]:
    """Return the part of the Plan; an object that has no moments, or too large ones, is a mistake."""
    tables: list[MomentTable[np.ndarray]] = []
    numbers: Number = {}
    for use in uses:
        request = _request(use)
        for i, name in enumerate(request.objects):
            key = *_way(use), name
            radii = _radii(planning, uses, use, name)
            if key in numbers or not radii or planning.object_id(name) is None:
                continue
            try:
                planning.progress(f"object {name}: moments of its surface")
                tables.append(moment_table(planning.sensed[name], request, radii, use.largest_shift, planning.object_id(name)))
                numbers[key] = len(tables) - 1
            except LowerError as error:
                place = ["feels", i] if error.field else []
                planning.report(("sensors", use.sensors[0], *place), error.what, error.hint)
        _check_area(planning, use, tables, numbers)
    return MomentsPart(tuple(tables), tuple(_use(planning, use, tables, numbers) for use in uses))


def _request(use: Use) -> MomentsRequest:
    assert isinstance(use.request, MomentsRequest)
    return use.request


def _way(use: Use) -> tuple[Any, ...]:
    """Return what tables have in common that serve several uses: how moments are found, whatever of and by whom."""
    own = _request(use)
    found = own.backend, own.num_points, own.tolerance, own.gradient_tolerance, own.max_bytes, own.with_area
    return *found, use.largest_shift


def _radii(planning: Planning, uses: Sequence[Use], use: Use, name: str) -> list[float]:
    """Return the radii of all probes whose tables are this use's [m], ascending."""
    own = [other for other in uses if _way(other) == _way(use) and name in other.request.objects]
    return sorted({float(r) for other in own for r in planning.layout.radius[other.taxels] if r > 0})


def _check_area(planning: Planning, use: Use, tables: Sequence[MomentTable], numbers: Number) -> None:
    request = _request(use)
    own = [numbers[key] for name in request.objects if (key := (*_way(use), name)) in numbers]
    if request.with_area and len(own) == len(request.objects) and not sum(tables[i].area.min() for i in own) > 0:
        what = f"{', '.join(request.objects)}: planes alone have no area to share the density among"
        planning.report(("sensors", use.sensors[0]), what, "give `reference_area`, or feel an object that is no plane")


def _use(planning: Planning, use: Use, tables: Sequence[MomentTable[np.ndarray]], numbers: Number) -> MomentUse[np.ndarray]:
    names = [name for name in use.request.objects if (*_way(use), name) in numbers]
    bodies, radius = planning.bodies_of(use.taxels), planning.layout.radius[use.taxels]
    number = [numbers[(*_way(use), name)] for name in names]
    index, reach, radius_id = np.zeros((3, len(names), len(bodies)))
    for o, name in enumerate(names):
        own, radii = planning.own_pairs(name), tables[number[o]].radii
        for t, body in enumerate(bodies):
            if Pair(body, name) in own and radius[t] > 0:
                index[o, t], reach[o, t] = own.index(Pair(body, name)), radius[t]
                radius_id[o, t] = radii.index(radius[t])
    ids = index.astype(np.int64), reach, radius_id.astype(np.int64)
    return MomentUse(tuple(number), use.pos, *ids, use.radius_noise, _request(use).motion)


def moment_table(
    sensed: SensedObject, request: MomentsRequest, radii: Sequence[float], radius_noise: float = 0.0, number: int | None = 0
) -> MomentTable[np.ndarray]:
    """Compute the moments of an object beforehand.

    Args:
        sensed: The object.
        request: How they are to be found.
        radii: The sensing radii of its probes [m], ascending, each above 0.
        radius_noise: By how much radii may differ from these [m].
        number: The object's place in the Plan.

    Raises:
        LowerError: If its size is part of the state ("feels"), or the tolerance takes more than the budget.
    """
    if sensed.is_sized:
        what = f'the size of body "{sensed.body}" is given per environment, and moments are computed beforehand'
        raise LowerError(what, field="feels", hint="use `variants` for the sizes that it has, or feel other objects")
    solid = [tuple(geom for geom in geoms if geom.shape != "plane") for geoms in sensed.variants]
    planes = [part.geom for part in sensed.variants[0] if part.shape == "plane"]
    area = np.array([surface_area(geoms) if geoms else 0.0 for geoms in solid])
    accuracy: list[Mapping[str, float]] = []
    surface: FieldTable[np.ndarray] | CloudTable[np.ndarray] | None = None
    try:
        if any(solid) and request.backend == "field":
            surface, accuracy = _fields(solid, request, radii, radius_noise > 0)
        elif any(solid):
            surface = _clouds(solid, request, radii[-1], radius_noise)
    except BakeError as error:
        raise LowerError(f'body "{sensed.body}": {error}') from error
    return MomentTable(
        object=number or 0,
        radii=tuple(radii),
        area=area,
        plane_pos=np.reshape([plane.pos for plane in planes], (-1, 3)),
        plane_rotation=np.reshape([plane.rotation for plane in planes], (-1, 9)),
        surface=surface,
        accuracy=tuple(accuracy),
    )


def _fields(
    variants: Solid, request: MomentsRequest, radii: Sequence[float], with_slope: bool
) -> tuple[FieldTable[np.ndarray], list[Mapping[str, float]]]:
    """Return the fields of all variants and radii, one after the other, and their accuracy."""
    baked, left = [], request.max_bytes
    for geoms in variants:
        for radius in radii:
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
    table = FieldTable(
        values=np.concatenate([field.values.reshape(-1, field.values.shape[-1]) for field in baked]),
        first=np.cumsum([0, *num.prod(axis=1)[:-1]]),
        num=num,
        origin=np.array([field.origin for field in baked]),
        cell=np.array([field.cell for field in baked]),
        counts=_counts(num),
        is_smooth=request.gradient_tolerance is not None,
    )
    pairs = zip(baked, [*radii] * len(variants), strict=True)
    return table, [{**_measured(field.errors), "radius": radius, "cell": field.cell} for field, radius in pairs]


def _measured(errors: FieldErrors) -> dict[str, float]:
    """Return the errors that were measured, by name."""
    return {name: value for name, value in dataclasses.asdict(errors).items() if value is not None}


def _clouds(variants: Solid, request: MomentsRequest, radius: float, radius_noise: float) -> CloudTable[np.ndarray]:
    """Return the points of all variants and their lists; the last row is out of reach of everything."""
    budget = request.max_bytes // len(variants)
    clouds = [sample_cloud(geoms, radius, request.num_points, budget, radius_noise) for geoms in variants]
    slots, none = max(cloud.lists.shape[1] for cloud in clouds), sum(len(cloud.points) for cloud in clouds)
    lists, before = [], 0
    for cloud in clouds:
        rows = np.where(cloud.lists < len(cloud.points), cloud.lists + before, none)
        lists.append(np.pad(rows, ((0, 0), (0, slots - rows.shape[1])), constant_values=none))
        before += len(cloud.points)
    num = np.array([cloud.num for cloud in clouds])
    return CloudTable(
        points=np.concatenate([*(cloud.points for cloud in clouds), np.full((1, 3), FAR)]).T,
        weight=np.array([cloud.weight for cloud in clouds]),
        lists=np.concatenate(lists),
        first=np.cumsum([0, *(len(own) for own in lists[:-1])]),
        num=num,
        origin=np.array([cloud.origin for cloud in clouds]),
        cell=np.array([cloud.cell for cloud in clouds]),
        counts=_counts(num),
    )


def _counts(num: np.ndarray) -> tuple[int, int, int]:
    x, y, z = num[0].tolist()
    return x, y, z

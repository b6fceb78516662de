"""Moments: how much of each object's outer surface is near each probe, and where; of points or fields made at compile time.

Shapes: `object` objects of a use, `taxel` probes, `variant` variants of an object, `table` its tables: by variant and radius.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.errors import BakeError, LowerError
from tgdsl.geometry.planes import rot, split, vec
from tgdsl.quantities.base import Planning, Quantity, Scene, Use, pairs_for, variant_of
from tgdsl.quantities.moment_sums import (
    FELT_MOMENTS,
    MomentField,
    MomentSource,
    MomentsRequest,
    Plane,
    PointCloud,
    SurfaceMoments,
)
from tgdsl.quantities.pairs import Motion, Pair, PairedObject, gathered
from tgdsl.quantities.reference import ReferenceScene
from tgdsl.surfaces.geom import SurfaceGeom
from tgdsl.surfaces.sensed import SensedObject

FAR = 1e6  # coordinates of the point that fills lists [m]: out of reach of everything, its square still a float32
Solid = Sequence[tuple[SurfaceGeom, ...]]
Number = dict[tuple[Any, ...], int]  # number of a table, by method and object


Array = TypeVar("Array")


@dataclass(frozen=True, eq=False)
class FieldTable(Generic[Array]):
    """Fields of moments, one after the other: see `MomentField`."""

    values: Array  # at the nodes, float32, (node, channel)
    first: Array  # index of each field's node (0, 0, 0), (table,)
    num: Array  # number of its nodes along each axis, (table, 3)
    origin: Array  # place of its node (0, 0, 0) [m], (table, 3)
    cell: Array  # spacing of its nodes [m], (table,)
    counts: tuple[int, int, int]  # nodes of the first field: numbers that become part of compiled code
    is_smooth: bool  # whether fields are sums of quadratic B-splines


@dataclass(frozen=True, eq=False)
class CloudTable(Generic[Array]):
    """Points and lists of those within reach, one cloud after the other: see `PointCloud`."""

    points: Array  # places [m], (3, row); the last one is out of reach of everything
    weight: Array  # surface that each point stands for [m²], (variant,)
    lists: Array  # rows of `points`, (bin, slot)
    first: Array  # index of each cloud's first cube, (variant,)
    num: Array  # number of its cubes along each axis, (variant, 3)
    origin: Array  # lower corner of its lattice [m], (variant, 3)
    cell: Array  # side of a cube [m], (variant,)
    counts: tuple[int, int, int]  # cubes of the first cloud: numbers that become part of compiled code


@dataclass(frozen=True, eq=False)
class MomentTable(Generic[Array]):
    """The moments of one object, found in one way."""

    object: int  # the object: its place in the Plan
    radii: tuple[float, ...]  # radii that there are fields of [m]
    area: Array  # area of its outer surface, planes left out [m²], (variant,)
    plane_pos: Array  # places of its planes in its body's frame [m], (plane, 3)
    plane_rotation: Array  # rotates their vectors into it, (plane, 9)
    surface: FieldTable[Array] | CloudTable[Array] | None  # the rest of its surface; None if there is no more to it
    # measured errors of each field, variant after variant, radius by radius: see `FieldErrors`
    accuracy: tuple[Mapping[str, float], ...]


@dataclass(frozen=True, eq=False)
class MomentUse(Generic[Array]):
    """One request."""

    tables: tuple[int, ...]  # number of the table of each of its objects
    pos: Array  # where the probes are in their links' bodies' frames [m], (3, taxel)
    pair: Array  # index of each probe's pair with each object among that object's pairs, (object, taxel)
    reach: Array  # sensing radius of each probe towards each object [m], (object, taxel); 0 where it has none
    radius_id: Array  # which of the table's radii that is, (object, taxel)
    radius_noise: str  # the sensor whose noise disturbs the radii, if any
    motion: bool  # whether the objects' motions are asked for


@dataclass(frozen=True, eq=False)
class MomentsPart(Generic[Array]):
    """All of it."""

    tables: tuple[MomentTable[Array], ...]
    uses: tuple[MomentUse[Array], ...]


def _source(table: MomentTable[Tensor], use: MomentUse[Tensor], k: int, scene: Scene) -> MomentSource:
    """Return an object of a use, and the table of its moments."""
    target = scene.objects[table.object]
    shift = scene.radius_shifts[use.radius_noise] if use.radius_noise else None
    variant, reach = variant_of(scene, target), use.reach[k]
    rows = zip(table.plane_rotation, table.plane_pos, strict=True)
    return MomentSource(
        target=target,
        pair=use.pair[k],
        radius=reach if shift is None else torch.where(reach > 0, torch.clamp(reach + shift, min=0), 0.0),
        shift=None if shift is None else torch.maximum(shift, -reach),
        surface=_surface(table, variant, use.radius_id[k]),
        planes=tuple(Plane(rot(rotation.unbind()), vec(at.unbind())) for rotation, at in rows),
        area=(table.area if variant is None else table.area[variant])[:, None],
    )


def _surface(table: MomentTable[Tensor], variant: Tensor | None, radius_id: Tensor) -> MomentField | PointCloud | None:
    """Return the table that each probe asks: one for all, or by variant (env, 1), by radius (taxel,), or by both."""
    surface, num_radii = table.surface, len(table.radii)
    if surface is None:
        return None
    which = None if variant is None else variant[:, None]
    if isinstance(surface, FieldTable) and num_radii > 1:
        which = radius_id if which is None else num_radii * which + radius_id
    lattice: Any = (0, surface.counts, split(surface.origin[0]), surface.cell[0])
    if which is not None:
        lattice = (surface.first[which], *(split(part[which]) for part in (surface.num, surface.origin)), surface.cell[which])
    if isinstance(surface, FieldTable):
        return MomentField(surface.values, *lattice, is_smooth=surface.is_smooth)
    weight = surface.weight[0 if which is None else which]
    return PointCloud(vec(surface.points.unbind()), weight, surface.lists, *lattice)


@dataclass(frozen=True, eq=False)
class ReferenceMoments:
    """Moments of objects' surfaces and the objects' motion, in the links' frames: `SurfaceMoments` as arrays."""

    mass: Float[np.ndarray, "taxel object"]  # S0 [m³]
    first: Float[np.ndarray, "taxel object 3"]  # S1 about the probe [m⁴]
    velocity: Float[np.ndarray, "taxel object 3"]  # velocity of each object's material at the probe relative to the probe [m/s]
    angular: Float[np.ndarray, "taxel object 3"]  # angular velocity of each object relative to the link [rad/s]
    turn: Float[np.ndarray, "taxel 3"]  # the link's own angular velocity [rad/s]
    area: Float[np.ndarray, " object"]  # area of each object's outer surface, planes left out [m²]


def _reference(table: MomentTable[np.ndarray], variant: int, point: np.ndarray, radius: float) -> np.ndarray:
    """Return S0 [m³] and S1 [m⁴] at a point in the object's frame [m]: by SciPy, a sum over all points, or in closed form."""
    from scipy.ndimage import map_coordinates  # a compiled module needs no SciPy

    total, surface = np.zeros(4), table.surface
    if isinstance(surface, FieldTable):
        i = variant * len(table.radii) + table.radii.index(radius)
        first, num = surface.first[i], surface.num[i]
        values = surface.values[first : first + num.prod()].reshape(*num, 4)
        place = (point - surface.origin[i]) / surface.cell[i]
        # Quadratic B-splines about nodes end half a cell within the border; a linear field is zero beyond it.
        place, order, mode = (np.clip(place, 0.5, num - 1.5), 2, "nearest") if surface.is_smooth else (place, 1, "constant")
        options = {"output": np.float64, "order": order, "prefilter": False, "mode": mode}
        total += [map_coordinates(values[..., c], place[:, None], **options)[0] for c in range(4)]
    elif isinstance(surface, CloudTable):
        end = surface.first[variant + 1] if variant + 1 < len(surface.first) else len(surface.lists)
        rows, filler = np.unique(surface.lists[surface.first[variant] : end]), surface.points.shape[1] - 1
        way = surface.points.T[rows[rows != filler]] - point
        weight = np.maximum(radius - np.linalg.norm(way, axis=1), 0.0) * float(table.area[variant]) / len(way)
        total += [weight.sum(), *(weight @ way)]
    for pos, rotation in zip(table.plane_pos, table.plane_rotation, strict=True):
        normal = rotation.reshape(3, 3)[:, 2]
        height = float(normal @ (point - pos))
        d = min(abs(height), radius)
        s0 = 2 * np.pi * (radius**3 / 6 - radius * d**2 / 2 + d**3 / 3)
        total += [s0, *(-height * normal * s0)] if d < radius else np.zeros(4)
    return total


class _Moments(Quantity):
    name, request, part = "moments", MomentsRequest, MomentsPart

    def plan(self, planning: Planning, uses: Sequence[Use]) -> MomentsPart[np.ndarray]:
        """Return the part of the Plan; an object that has no moments, or too large ones, is a mistake."""
        tables: list[MomentTable[np.ndarray]] = []
        numbers: Number = {}
        for use in uses:
            for i, name in enumerate(use.request.objects):
                key = _way(use), name
                radii = _radii(planning, uses, use, name)
                if key in numbers or not radii or planning.object_id(name) is None:
                    continue
                try:
                    planning.progress(f"object {name}: moments of its surface, kept for the next time")
                    number = planning.object_id(name)
                    tables.append(moment_table(planning.sensed[name], use.request, radii, use.largest_shift, number))
                    numbers[key] = len(tables) - 1
                except LowerError as error:
                    place = ["feels", i] if error.field else []
                    planning.report(("sensors", use.sensors[0], *place), error.what, error.hint)
            _check_area(planning, use, tables, numbers)
        return MomentsPart(tuple(tables), tuple(_use(planning, use, tables, numbers) for use in uses))

    def gather(self, part: MomentsPart[Tensor], scene: Scene) -> tuple[SurfaceMoments, ...]:
        results, pairs = [], pairs_for(scene, is_gated=False)
        for use in part.uses:
            moments, motions, areas, pos = {}, {}, {}, vec(use.pos.unbind())
            for k, i in enumerate(use.tables):
                source = _source(part.tables[i], use, k, scene)
                name, own_pairs = source.target.name, source.target.pairs
                moments[name], areas[name] = FELT_MOMENTS(pairs, own_pairs, pos, source), source.area
                if use.motion and pairs.motion is not None:
                    motions[name] = Motion(*(gathered(part, own_pairs, source.pair) for part in pairs.motion))
            none = pairs.offset[0].new_zeros((pairs.offset[0].shape[0], pos[0].shape[0]))
            results.append(SurfaceMoments(pos, none, moments, motions, areas))
        return tuple(results)

    def reference(self, part: MomentsPart[np.ndarray], use: int, scene: ReferenceScene) -> ReferenceMoments:
        use_part, layout = part.uses[use], scene.layout
        num = len(use_part.tables)
        mass, (first, velocity, angular) = np.zeros((layout.num_taxels, num)), np.zeros((3, layout.num_taxels, num, 3))
        turn, area = np.zeros((layout.num_taxels, 3)), np.zeros(num)
        for k, table in enumerate(part.tables[i] for i in use_part.tables):
            target = scene.objects[table.object]
            variant, body = scene.variant(target), scene.object_body(target)
            area[k] = table.area[variant]
            for t, link_id in enumerate(layout.link_id):
                name = layout.links[link_id].body
                if use_part.reach[k, t] <= 0 or name == target.body:
                    continue
                link = scene.body(name)
                q = link.pos + link.rotation @ layout.pos[t]
                near = _reference(table, variant, body.rotation.T @ (q - body.pos), float(use_part.reach[k, t]))
                mass[t, k], first[t, k] = near[0], link.rotation.T @ body.rotation @ near[1:]
                velocity[t, k] = link.rotation.T @ (body.velocity_at(q) - link.velocity_at(q))
                angular[t, k] = link.rotation.T @ (body.angvel - link.angvel)
                turn[t] = link.rotation.T @ link.angvel
        return ReferenceMoments(mass, first, velocity, angular, turn, area)

    def fields(self, part: MomentsPart) -> set[str]:
        return {"body_linvel", "body_angvel"} if any(use.motion for use in part.uses) else set()

    def explain(self, part: MomentsPart[np.ndarray], use: int, objects: Sequence[PairedObject]) -> list[str]:
        names = [objects[part.tables[i].object].name for i in part.uses[use].tables]
        return [f"moments of {', '.join(names)}" + (" with motion" if part.uses[use].motion else "")]

    def account(self, part: MomentsPart[np.ndarray], objects: Sequence[PairedObject]) -> dict[str, list[str]]:
        lines = []
        for table in part.tables:
            field, num_radii = table.surface, len(table.radii)
            for i, accuracy in enumerate(table.accuracy if isinstance(field, FieldTable) else ()):
                assert isinstance(field, FieldTable)
                size = field.values[0].nbytes * int(field.num[i].prod())
                which = f"variant {i // num_radii}, " if len(table.area) > 1 else ""
                nodes = f"{' × '.join(map(str, field.num[i]))} nodes every {1e3 * accuracy['cell']:.3g} mm, {size} bytes"
                percents = {key: percent(value) for key, value in accuracy.items()}
                lines += [
                    f"{objects[table.object].name}, {which}radius {1e3 * accuracy['radius']:.3g} mm: {nodes}",
                    f"  RMS error of S0 {percents['mass_rms']} of full scale (largest {percents['mass_max']}), of S1"
                    f" {percents['first_rms']} (largest {percents['first_max']})",
                ]
                if "gradient_p999" in accuracy:
                    p999, largest = percents["gradient_p999"], f"(largest error {percents['gradient_max']})"
                    lines.append(
                        f"  gradients: 99.9 % of S0's within {p999} of the largest {largest}, of S1's within"
                        f" {percents['first_gradient_p999']}"
                    )
        return {"fields of moments": lines} if lines else {}


MOMENTS = _Moments()


def percent(share: float) -> str:
    """Return a share as a percentage with two significant digits, and no exponent."""
    return f"{np.format_float_positional(100 * share, precision=2, fractional=False, trim='-')} %"


def _way(use: Use) -> tuple[Any, ...]:
    """Return the method of a request: uses with equal methods share a table."""
    return dataclasses.replace(use.request, objects=(), is_gated=False, motion=False).key(), use.largest_shift


def _radii(planning: Planning, uses: Sequence[Use], use: Use, name: str) -> list[float]:
    alike = [other for other in uses if _way(other) == _way(use) and name in other.request.objects]
    return sorted({float(r) for other in alike for r in _radius(planning, other) if r > 0})


def _radius(planning: Planning, use: Use) -> Float[np.ndarray, " taxel"]:
    radius, of_all = planning.layout.radius[use.taxels], use.request.radius
    return radius if of_all is None else np.where(radius > 0, of_all, radius)


def _check_area(planning: Planning, use: Use, tables: Sequence[MomentTable], numbers: Number) -> None:
    request = use.request
    counts = [numbers[key] for name in request.objects if (key := (_way(use), name)) in numbers]
    if request.with_area and len(counts) == len(request.objects) and not sum(tables[i].area.min() for i in counts) > 0:
        problem = f"{', '.join(request.objects)}: planes alone have no area to share the density among"
        planning.report(("sensors", use.sensors[0]), problem, "give `reference_area`, or feel an object that is no plane")


def _use(planning: Planning, use: Use, tables: Sequence[MomentTable[np.ndarray]], numbers: Number) -> MomentUse[np.ndarray]:
    names = [name for name in use.request.objects if (_way(use), name) in numbers]
    bodies, radius = planning.bodies_of(use.taxels), _radius(planning, use)
    number = [numbers[(_way(use), name)] for name in names]
    index, reach, radius_id = np.zeros((3, len(names), len(bodies)))
    for o, name in enumerate(names):
        pairs, radii = planning.own_pairs(name), tables[number[o]].radii
        for t, body in enumerate(bodies):
            if Pair(body, name) in pairs and radius[t] > 0:
                index[o, t], reach[o, t] = pairs.index(Pair(body, name)), radius[t]
                radius_id[o, t] = radii.index(radius[t])
    ids = index.astype(np.int64), reach, radius_id.astype(np.int64)
    return MomentUse(tuple(number), use.pos, *ids, use.radius_noise, use.request.motion)


def moment_table(
    sensed: SensedObject, request: MomentsRequest, radii: Sequence[float], radius_noise: float = 0.0, number: int | None = 0
) -> MomentTable[np.ndarray]:
    """Compute the moments of an object, the Plan's `number`-th, beforehand.

    They are for sensing radii [m], ascending, which noise may change by `radius_noise` [m].

    Raises:
        LowerError: If its size is part of the state ("feels"), or the tolerance takes more than the budget.
    """
    from tgdsl.quantities.moment_fields import surface_area  # compilers alone bake meshes

    if sensed.is_sized:
        problem = f'the size of body "{sensed.body}" is given per environment, and moments are computed beforehand'
        raise LowerError(problem, field="feels", hint="use `variants` for the sizes that it has, or feel other objects")
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
    from tgdsl.quantities.moment_fields import bake_field

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
    accuracy: list[Mapping[str, float]] = []
    for field, radius in pairs:
        measured = {name: value for name, value in dataclasses.asdict(field.errors).items() if value is not None}
        accuracy.append({**measured, "radius": radius, "cell": field.cell})
    return table, accuracy


def _clouds(variants: Solid, request: MomentsRequest, radius: float, radius_noise: float) -> CloudTable[np.ndarray]:
    """Return the points of all variants and their lists; the last row is out of reach of everything."""
    from tgdsl.quantities.moment_fields import sample_cloud

    budget = request.max_bytes // len(variants)
    clouds = [sample_cloud(geoms, radius, request.num_points, budget, radius_noise) for geoms in variants]
    slots, none = max(cloud.lists.shape[1] for cloud in clouds), sum(len(cloud.points) for cloud in clouds)
    lists, first = [], 0
    for cloud in clouds:
        rows = np.where(cloud.lists < len(cloud.points), cloud.lists + first, none)
        lists.append(np.pad(rows, ((0, 0), (0, slots - rows.shape[1])), constant_values=none))
        first += len(cloud.points)
    num = np.array([cloud.num for cloud in clouds])
    return CloudTable(
        points=np.concatenate([*(cloud.points for cloud in clouds), np.full((1, 3), FAR)]).T,
        weight=np.array([cloud.weight for cloud in clouds]),
        lists=np.concatenate(lists),
        first=np.cumsum([0, *(len(points) for points in lists[:-1])]),
        num=num,
        origin=np.array([cloud.origin for cloud in clouds]),
        cell=np.array([cloud.cell for cloud in clouds]),
        counts=_counts(num),
    )


def _counts(num: np.ndarray) -> tuple[int, int, int]:
    x, y, z = num[0].tolist()
    return x, y, z

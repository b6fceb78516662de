"""Moments: how much of each object's outer surface is near each probe, and where; of points or fields made at compile time.

Shapes: `object` objects of a use, `taxel` probes, `variant` variants of an object, `table` its tables: by variant and radius.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.errors import BakeError, LowerError
from tgdsl.geometry.grid import Count
from tgdsl.geometry.planes import rot, split, vec
from tgdsl.quantities.base import Planning, Quantity, Scene, Use, pairs_for, variant_of
from tgdsl.quantities.moment_sums import MomentField, PointCloud
from tgdsl.quantities.nearby import MomentSource, MomentsRequest, Plane, SurfaceMoments, surface_moments
from tgdsl.quantities.pairs import Pair, PairedObject
from tgdsl.quantities.reference import ReferenceScene
from tgdsl.surfaces.geom import SurfaceGeom
from tgdsl.surfaces.sensed import SensedObject

FAR = 1e6  # coordinates of the point that fills lists [m]: out of reach of everything, its square still a float32
Solid = Sequence[tuple[SurfaceGeom, ...]]
Number = dict[tuple[Any, ...], int]  # number of a table, by method and object


Array = TypeVar("Array")


@dataclass(frozen=True, eq=False)
class FieldTable(Generic[Array]):
    """Fields of moments, one after the other: see `moments.MomentField`."""

    values: Array  # at the nodes, float32, (node, channel)
    first: Array  # index of each field's node (0, 0, 0), (table,)
    num: Array  # number of its nodes along each axis, (table, 3)
    origin: Array  # place of its node (0, 0, 0) [m], (table, 3)
    cell: Array  # spacing of its nodes [m], (table,)
    counts: tuple[int, int, int]  # nodes of the first field: numbers that become part of compiled code
    is_smooth: bool  # whether fields are sums of quadratic B-splines


@dataclass(frozen=True, eq=False)
class CloudTable(Generic[Array]):
    """Points and lists of those within reach, one cloud after the other: see `moments.PointCloud`."""

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
    return MomentSource(
        target=target,
        pair=use.pair[k],
        radius=reach if shift is None else torch.where(reach > 0, torch.clamp(reach + shift, min=0), 0.0),
        shift=None if shift is None else torch.maximum(shift, -reach),
        surface=_surface(table, variant, use.radius_id[k]),
        planes=tuple(
            Plane(rot(rotation.unbind()), vec(at.unbind()))
            for rotation, at in zip(table.plane_rotation, table.plane_pos, strict=True)
        ),
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
    start: Count = 0
    if which is None:
        counts: tuple[Count, Count, Count] = surface.counts
        place, side = split(surface.origin[0]), surface.cell[0]
    else:
        start, counts, place, side = (
            surface.first[which],
            split(surface.num[which]),
            split(surface.origin[which]),
            surface.cell[which],
        )
    if isinstance(surface, FieldTable):
        return MomentField(surface.values, start, counts, place, side, surface.is_smooth)
    weight = surface.weight[0] if which is None else surface.weight[which]
    return PointCloud(vec(surface.points.unbind()), weight, surface.lists, start, counts, place, side)


@dataclass(frozen=True, eq=False)
class ReferenceMoments:
    """Moments of objects' surfaces and the objects' motion, in the links' frames: `request.SurfaceMoments` as arrays."""

    mass: Float[np.ndarray, "taxel object"]  # S0 [m³]
    first: Float[np.ndarray, "taxel object 3"]  # S1 about the probe [m⁴]
    velocity: Float[np.ndarray, "taxel object 3"]  # velocity of each object's material at the probe relative to the probe [m/s]
    angular: Float[np.ndarray, "taxel object 3"]  # angular velocity of each object relative to the link [rad/s]
    turn: Float[np.ndarray, "taxel 3"]  # the link's own angular velocity [rad/s]
    area: Float[np.ndarray, " object"]  # area of each object's outer surface, planes left out [m²]


def _splines(factors: np.ndarray, place: np.ndarray) -> float:
    """Return a sum of quadratic B-splines about nodes at a place in cells, clamped to half a cell within the border."""
    from scipy.ndimage import map_coordinates

    place = np.clip(place, 0.5, np.array(factors.shape) - 1.5)
    return float(map_coordinates(factors, place[:, None], order=2, prefilter=False, mode="nearest")[0])


class ReferenceTable:
    """One object's moments by other means than the module's: SciPy's interpolation, a sum over all points, closed form."""

    def __init__(self, table: MomentTable[np.ndarray], variant: int):
        """Take the tables of a variant of an object."""
        self.table, self.variant = table, variant
        self.area = float(table.area[variant])
        self.fields: dict[float, Callable[[np.ndarray], np.ndarray]] = {}

    def at(self, point: np.ndarray, radius: float) -> tuple[float, np.ndarray]:
        """Return S0 [m³] and S1 [m⁴] at a point in the object's frame [m]."""
        total = np.zeros(4)
        surface, radii = self.table.surface, self.table.radii
        if isinstance(surface, FieldTable):
            if radius not in self.fields:
                self.fields[radius] = self._field(surface, self.variant * len(radii) + radii.index(radius))
            total += self.fields[radius](point)[0]
        elif isinstance(surface, CloudTable):
            total += self._summed(surface, point, radius)
        for pos, rotation in zip(self.table.plane_pos, self.table.plane_rotation, strict=True):
            normal = rotation.reshape(3, 3)[:, 2]
            height = float(normal @ (point - pos))
            d = min(abs(height), radius)
            s0 = 2 * np.pi * (radius**3 / 6 - radius * d**2 / 2 + d**3 / 3)
            total += [s0, *(-height * normal * s0)] if d < radius else np.zeros(4)
        return float(total[0]), total[1:]

    def _field(self, field: FieldTable[np.ndarray], i: int) -> Callable[[np.ndarray], np.ndarray]:
        first, num, origin, cell = field.first[i], field.num[i], field.origin[i], field.cell[i]
        values = field.values[first : first + num.prod()].reshape(*num, 4).astype(np.float64)
        if field.is_smooth:
            return lambda point: np.array([_splines(part, (point - origin) / cell) for part in np.moveaxis(values, 3, 0)])[None]
        from scipy.interpolate import RegularGridInterpolator

        axes = [start + cell * np.arange(count) for start, count in zip(origin, num, strict=True)]
        return RegularGridInterpolator(axes, values, bounds_error=False, fill_value=0.0)

    def _summed(self, cloud: CloudTable[np.ndarray], point: np.ndarray, radius: float) -> np.ndarray:
        first = cloud.first
        end = first[self.variant + 1] if self.variant + 1 < len(first) else len(cloud.lists)
        rows, filler = np.unique(cloud.lists[first[self.variant] : end]), cloud.points.shape[1] - 1
        way = cloud.points.T[rows[rows != filler]] - point
        weight = np.maximum(radius - np.linalg.norm(way, axis=1), 0.0) * self.area / len(way)
        return np.array([weight.sum(), *(weight @ way)])


def _gradients(accuracy: Mapping[str, float]) -> list[str]:
    """Return the measured errors of a field's gradients by place, if there are any."""
    if "gradient_p999" not in accuracy:
        return []
    p999, largest, first = (f"{100 * accuracy[key]:.2g} %" for key in ("gradient_p999", "gradient_max", "first_gradient_p999"))
    return [f"  gradients: 99.9 % of S0's within {p999} of the largest (largest error {largest}), of S1's within {first}"]


class _Moments(Quantity):
    name, request, part = "moments", MomentsRequest, MomentsPart

    def plan(self, planning: Planning, uses: Sequence[Use]) -> MomentsPart[np.ndarray]:
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
                    tables.append(
                        moment_table(planning.sensed[name], request, radii, use.largest_shift, planning.object_id(name))
                    )
                    numbers[key] = len(tables) - 1
                except LowerError as error:
                    place = ["feels", i] if error.field else []
                    planning.report(("sensors", use.sensors[0], *place), error.what, error.hint)
            _check_area(planning, use, tables, numbers)
        return MomentsPart(tuple(tables), tuple(_use(planning, use, tables, numbers) for use in uses))

    def gather(self, part: MomentsPart[Tensor], scene: Scene) -> tuple[SurfaceMoments, ...]:
        results = []
        for use in part.uses:
            sources = [_source(part.tables[i], use, k, scene) for k, i in enumerate(use.tables)]
            pairs = pairs_for(scene, is_gated=False)
            results.append(
                surface_moments(pairs if use.motion else pairs._replace(motion=None), vec(use.pos.unbind()), sources)
            )
        return tuple(results)

    def reference(self, part: MomentsPart[np.ndarray], use: int, scene: ReferenceScene) -> ReferenceMoments:
        use_part, layout = part.uses[use], scene.layout
        num = len(use_part.tables)
        mass, (first, velocity, angular) = np.zeros((layout.num_taxels, num)), np.zeros((3, layout.num_taxels, num, 3))
        turn, area = np.zeros((layout.num_taxels, 3)), np.zeros(num)
        for k, table in enumerate(part.tables[i] for i in use_part.tables):
            target = scene.objects[table.object]
            moments, body = ReferenceTable(table, scene.variant(target)), scene.object_body(target)
            area[k] = moments.area
            for t, link_id in enumerate(layout.link_id):
                name = layout.links[link_id].body
                if use_part.reach[k, t] <= 0 or name == target.body:
                    continue
                link = scene.body(name)
                q = link.pos + link.rotation @ layout.pos[t]
                mass[t, k], about_q = moments.at(body.rotation.T @ (q - body.pos), float(use_part.reach[k, t]))
                first[t, k] = link.rotation.T @ body.rotation @ about_q
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
                s0, s0_max, s1, s1_max = (
                    f"{100 * accuracy[key]:.2g} %" for key in ("mass_rms", "mass_max", "first_rms", "first_max")
                )
                lines += [
                    f"{objects[table.object].name}, {which}radius {1e3 * accuracy['radius']:.3g} mm: {nodes}",
                    f"  RMS error of S0 {s0} of full scale (largest {s0_max}), of S1 {s1} (largest {s1_max})",
                    *_gradients(accuracy),
                ]
        return {"fields of moments": lines} if lines else {}


MOMENTS = _Moments()


def _request(use: Use) -> MomentsRequest:
    assert isinstance(use.request, MomentsRequest)
    return use.request


def _way(use: Use) -> tuple[Any, ...]:
    """Return the method of a request: uses with equal methods share a table."""
    request = _request(use)
    result = (
        request.radius,
        request.backend,
        request.num_points,
        request.tolerance,
        request.gradient_tolerance,
        request.max_bytes,
        request.with_area,
    )
    return *result, use.largest_shift


def _radii(planning: Planning, uses: Sequence[Use], use: Use, name: str) -> list[float]:
    alike = [other for other in uses if _way(other) == _way(use) and name in other.request.objects]
    return sorted({float(r) for other in alike for r in _radius(planning, other) if r > 0})


def _radius(planning: Planning, use: Use) -> Float[np.ndarray, " taxel"]:
    radius, of_all = planning.layout.radius[use.taxels], _request(use).radius
    return radius if of_all is None else np.where(radius > 0, of_all, radius)


def _check_area(planning: Planning, use: Use, tables: Sequence[MomentTable], numbers: Number) -> None:
    request = _request(use)
    counts = [numbers[key] for name in request.objects if (key := (*_way(use), name)) in numbers]
    if request.with_area and len(counts) == len(request.objects) and not sum(tables[i].area.min() for i in counts) > 0:
        problem = f"{', '.join(request.objects)}: planes alone have no area to share the density among"
        planning.report(("sensors", use.sensors[0]), problem, "give `reference_area`, or feel an object that is no plane")


def _use(planning: Planning, use: Use, tables: Sequence[MomentTable[np.ndarray]], numbers: Number) -> MomentUse[np.ndarray]:
    names = [name for name in use.request.objects if (*_way(use), name) in numbers]
    bodies, radius = planning.bodies_of(use.taxels), _radius(planning, use)
    number = [numbers[(*_way(use), name)] for name in names]
    index, reach, radius_id = np.zeros((3, len(names), len(bodies)))
    for o, name in enumerate(names):
        pairs, radii = planning.own_pairs(name), tables[number[o]].radii
        for t, body in enumerate(bodies):
            if Pair(body, name) in pairs and radius[t] > 0:
                index[o, t], reach[o, t] = pairs.index(Pair(body, name)), radius[t]
                radius_id[o, t] = radii.index(radius[t])
    ids = index.astype(np.int64), reach, radius_id.astype(np.int64)
    return MomentUse(tuple(number), use.pos, *ids, use.radius_noise, _request(use).motion)


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

"""Moments in float64 by other means than the module's: SciPy's interpolation, a sum over all points, closed form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tgdsl.quantities.moments.part import CloudTable, FieldTable, MomentsPart, MomentTable
from tgdsl.quantities.reference import ReferenceScene

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class ReferenceMoments:
    """Moments of objects' surfaces and the objects' motion, in the links' frames: `request.SurfaceMoments` as arrays.

    Attributes:
        mass: S0 [m³].
        first: S1 about the probe [m⁴].
        velocity: Velocity of each object's material at the probe relative to the probe [m/s].
        angular: Angular velocity of each object relative to the link [rad/s].
        turn: The link's own angular velocity [rad/s].
        area: Area of each object's outer surface, planes left out [m²].
    """

    mass: Float[Array, "taxel object"]
    first: Float[Array, "taxel object 3"]
    velocity: Float[Array, "taxel object 3"]
    angular: Float[Array, "taxel object 3"]
    turn: Float[Array, "taxel 3"]
    area: Float[Array, " object"]


def reference(part: MomentsPart[np.ndarray], use: int, scene: ReferenceScene) -> ReferenceMoments:
    """Return the moments of a use's objects at a sensor's taxels, by way of the world frame."""
    own, layout = part.uses[use], scene.layout
    num = len(own.tables)
    mass, (first, velocity, angular) = np.zeros((layout.num_taxels, num)), np.zeros((3, layout.num_taxels, num, 3))
    turn, area = np.zeros((layout.num_taxels, 3)), np.zeros(num)
    for k, table in enumerate(part.tables[i] for i in own.tables):
        target = scene.objects[table.object]
        moments, body = ReferenceTable(table, scene.variant(target)), scene.object_body(target)
        area[k] = moments.area
        for t, link_id in enumerate(layout.link_id):
            name = layout.links[link_id].body
            if layout.radius[t] <= 0 or name == target.body:
                continue
            link = scene.body(name)
            q = link.pos + link.rotation @ layout.pos[t]
            mass[t, k], about_q = moments.at(body.rotation.T @ (q - body.pos), float(layout.radius[t]))
            first[t, k] = link.rotation.T @ body.rotation @ about_q
            velocity[t, k] = link.rotation.T @ (body.velocity_at(q) - link.velocity_at(q))
            angular[t, k] = link.rotation.T @ (body.angvel - link.angvel)
            turn[t] = link.rotation.T @ link.angvel
    return ReferenceMoments(mass, first, velocity, angular, turn, area)


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

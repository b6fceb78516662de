"""Volume, surface area, bounding box and curvature of geoms: primitives exactly, meshes by their triangles.

Shapes: `n` geoms.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf, pi
from types import MappingProxyType

import numpy as np
from jaxtyping import Float
from scipy.special import elliprg

from tgdsl.surfaces.geom import Geom, SurfaceGeom
from tgdsl.surfaces.holes import hole_caps, merged
from tgdsl.surfaces.surface import Surface


@dataclass(frozen=True, eq=False)
class Bulk:
    """What geoms are together. Those that overlap count fully: volumes and areas are sums."""

    volume: float  # volume [m³]
    area: float  # area of the surface [m²]
    low: Float[np.ndarray, " 3"]  # lower corner of the bounding box, in the body's frame [m]
    high: Float[np.ndarray, " 3"]  # upper corner
    # mean curvature where something touches it, averaged over the area [1/m]: of a sphere 1/r, along the side of a cylinder or
    # capsule 1/2r, of an ellipsoid that of the sphere of its volume, of flat faces and meshes 0
    curvature: float

    @property
    def center(self) -> Float[np.ndarray, " 3"]:
        """Centre of the bounding box [m]; the origin of what is unbounded."""
        return (self.low + self.high) / 2 if np.isfinite(self.high - self.low).all() else np.zeros(3)


def bulk(geoms: Sequence[SurfaceGeom]) -> Bulk:
    """Return volume, area, box and curvature of a body's geoms; a hull stands for its mesh, whose holes are closed.

    Args:
        geoms: At least one; a plane is a half-space, whose volume is infinite.
    """
    each = [_of_mesh(geom) if geom.shape == "mesh" else _of_primitive(geom.geom) for geom in geoms]
    area = sum(one.area for one in each)
    return Bulk(
        volume=sum(one.volume for one in each),
        area=area,
        low=np.min([one.low for one in each], axis=0),
        high=np.max([one.high for one in each], axis=0),
        curvature=sum(one.area * one.curvature for one in each) / area if area else 0.0,
    )


def _of_primitive(geom: Geom) -> Bulk:
    a, b, c = geom.size.tolist()
    volume, area, curvature, half = PRIMITIVES[geom.shape](a, b, c, geom.rotation)
    return Bulk(volume, area, geom.pos - half, geom.pos + half, curvature)


def _of_mesh(mesh_geom: SurfaceGeom) -> Bulk:
    surface = mesh_geom.surface if mesh_geom.mesh is None else mesh_geom.mesh
    assert surface is not None
    volume, area = _enclosed(surface)
    placed = surface.vertices @ mesh_geom.geom.rotation.T + mesh_geom.geom.pos
    return Bulk(volume, area, placed.min(axis=0), placed.max(axis=0), 0.0)


def _enclosed(surface: Surface) -> tuple[float, float]:
    """Return volume and area within and of a surface whose holes are closed by triangles, by the divergence theorem."""
    vertices, faces, _ = merged(surface)
    vertices, caps = hole_caps(vertices, faces)
    a, b, c = (vertices - vertices.mean(axis=0))[np.concatenate([faces, caps])].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    return abs(float((a * normals).sum())) / 6.0, float(np.linalg.norm(normals, axis=1).sum()) / 2.0


Measured = tuple[float, float, float, Float[np.ndarray, " 3"]]
"""Volume [m³], area [m²], curvature [1/m], and half-lengths of the bounding box in the body's frame [m]."""
Measure = Callable[[float, float, float, Float[np.ndarray, "3 3"]], Measured]
"""Called with a primitive's size as MuJoCo defines it [m], and the rotation of its frame into the body's."""


def _sphere(r: float, _h: float, _c: float, _rotation: np.ndarray) -> Measured:
    return 4 / 3 * pi * r**3, 4 * pi * r**2, 1 / r, np.full(3, r)


def _capsule(r: float, h: float, _c: float, rotation: np.ndarray) -> Measured:
    volume, area = 2 * pi * r**2 * h + 4 / 3 * pi * r**3, 4 * pi * r * (h + r)
    return volume, area, 1 / (2 * r), np.abs(rotation[:, 2]) * h + r


def _cylinder(r: float, h: float, _c: float, rotation: np.ndarray) -> Measured:
    half = np.abs(rotation[:, 2]) * h + r * np.hypot(rotation[:, 0], rotation[:, 1])
    return 2 * pi * r**2 * h, 2 * pi * r * (2 * h + r), 1 / (2 * r), half


def _ellipsoid(a: float, b: float, c: float, rotation: np.ndarray) -> Measured:
    volume = 4 / 3 * pi * a * b * c
    area = 3 * volume * float(elliprg(a**-2, b**-2, c**-2))
    return volume, area, (a * b * c) ** (-1 / 3), np.linalg.norm(rotation * [a, b, c], axis=1)


def _box(x: float, y: float, z: float, rotation: np.ndarray) -> Measured:
    return 8 * x * y * z, 8 * (x * y + y * z + z * x), 0.0, np.abs(rotation) @ [x, y, z]


def _plane(_x: float, _y: float, _z: float, _rotation: np.ndarray) -> Measured:
    return inf, 0.0, 0.0, np.full(3, inf)


PRIMITIVES: Mapping[str, Measure] = MappingProxyType(
    {"plane": _plane, "sphere": _sphere, "capsule": _capsule, "cylinder": _cylinder, "ellipsoid": _ellipsoid, "box": _box}
)
"""Primitives, by MuJoCo's name."""

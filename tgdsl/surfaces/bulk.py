"""Volume, surface area, bounding box and curvature of geoms: primitives exactly, meshes by their triangles.

Shapes: `n` geoms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, pi

import numpy as np
from jaxtyping import Float
from scipy.special import elliprg

from tgdsl.surfaces.geom import Geom, SurfaceGeom
from tgdsl.surfaces.surface import Surface, hole_caps, merged

PRIMITIVES = ("plane", "sphere", "capsule", "cylinder", "ellipsoid", "box")  # by MuJoCo's name


@dataclass(frozen=True, eq=False)
class Bulk:
    """Volume, area, box and curvature of several geoms: volumes and areas are sums, overlaps count twice."""

    volume: float  # volume [m³]
    area: float  # area of the surface [m²]
    low: Float[np.ndarray, " 3"]  # lower corner of the bounding box, in the body's frame [m]
    high: Float[np.ndarray, " 3"]  # upper corner
    # mean curvature at points of contact, averaged over the area [1/m]: a sphere 1/r, the side of a cylinder or capsule 1/2r,
    # an ellipsoid as the sphere of its volume, flat faces and meshes 0
    curvature: float

    @property
    def center(self) -> Float[np.ndarray, " 3"]:
        """Centre of the bounding box [m]; the origin if the box is unbounded."""
        return (self.low + self.high) / 2 if np.isfinite(self.high - self.low).all() else np.zeros(3)


def bulk(geoms: Sequence[SurfaceGeom]) -> Bulk:
    """Return volume, area, box and curvature of a body's geoms, at least one; a plane is a half-space of infinite volume.

    A hull stands for its mesh, whose holes are closed.
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
    x, y, z = np.abs(geom.rotation).T
    match geom.shape:
        case "plane":  # its surface does not count
            return Bulk(inf, 0.0, np.full(3, -inf), np.full(3, inf), 0.0)
        case "sphere":
            volume, curvature, half = 4 / 3 * pi * a**3, 1 / a, np.full(3, a)
        case "capsule":
            volume, curvature, half = 2 * pi * a**2 * b + 4 / 3 * pi * a**3, 1 / (2 * a), z * b + a
        case "cylinder":
            volume, curvature, half = 2 * pi * a**2 * b, 1 / (2 * a), z * b + a * np.hypot(x, y)
        case "ellipsoid":
            volume, curvature = 4 / 3 * pi * a * b * c, (a * b * c) ** (-1 / 3)
            half = np.linalg.norm(geom.rotation * [a, b, c], axis=1)
        case _:
            volume, curvature, half = 8 * a * b * c, 0.0, np.abs(geom.rotation) @ [a, b, c]
    return Bulk(volume, primitive_area(geom.shape, geom.size), geom.pos - half, geom.pos + half, curvature)


def primitive_area(shape: str, size: Float[np.ndarray, " 3"]) -> float:
    """Return the area of a primitive of a size as in MuJoCo [m²]; of an ellipsoid by Carlson's integral R_G (DLMF 19.33.2)."""
    a, b, c = map(float, size)
    match shape:
        case "box":
            return 8.0 * (a * b + b * c + c * a)
        case "sphere":
            return 4.0 * pi * a**2
        case "capsule":
            return 4.0 * pi * a * (a + b)
        case "cylinder":
            return 2.0 * pi * a * (a + 2.0 * b)
        case _:
            return float(4.0 * pi * elliprg((a * b) ** 2, (b * c) ** 2, (c * a) ** 2))


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

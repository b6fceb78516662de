"""Signed distance of points to the union of an object's geoms, and its gradient.

Shapes: `case` 1, or `env` if the object differs between environments, or the links of a table of links; `geom` its geoms.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.bvh import TriangleMesh, nearest
from tgdsl.geometry.grid import METHODS, Grid
from tgdsl.geometry.planes import Rot, Vec
from tgdsl.geometry.shapes import SHAPES


class RaycastSurface(NamedTuple):
    """Triangles that are queried at run time, one mesh per variant, and the distance [m] up to which they are told apart."""

    meshes: tuple[TriangleMesh, ...]
    max_distance: float


class Frame(NamedTuple):
    """How an object sees points: a point, rotated and shifted, is in the object's frame; planes that broadcast with points.

    Attributes:
        rotation: Rotates the points' vectors into the object's frame.
        offset: The points' origin in the object's frame [m].
    """

    rotation: Rot
    offset: Vec


class Geoms(NamedTuple):
    """An object's geoms in its body's frame, as each environment has it.

    Attributes:
        shapes: How the distance to each geom is found: see `tables.GeomTable`.
        is_centred: Whether each geom's frame is the body's.
        size: Size of each geom as MuJoCo defines it [m].
        pos: Origin of each geom in the body frame [m].
        rotation: Rotates geom vectors into the body frame, row by row.
        is_absent: Which geoms a case lacks; None if none does.
        variant: Which variant each environment has; None if all are alike.
        surfaces: Grid or triangles of each geom that is no primitive.
    """

    shapes: tuple[str, ...]
    is_centred: tuple[bool, ...]
    size: Float[Tensor, "case geom 3"]
    pos: Float[Tensor, "case geom 3"]
    rotation: Float[Tensor, "case geom 9"]
    is_absent: Bool[Tensor, "case geom"] | None
    variant: Int[Tensor, " env"] | None
    surfaces: tuple[Grid | RaycastSurface | None, ...]


def body_distance(point: Vec, geoms: Geoms) -> tuple[Tensor, Vec]:
    """Return signed distance [m] of points in a body's own frame to the union of its geoms, and its gradient there."""
    frames = []
    for g, is_centred in enumerate(geoms.is_centred):
        turn = planes.rot(geoms.rotation[:, g, None].unbind(-1))
        xx, xy, xz, yx, yy, yz, zx, zy, zz = turn
        offset = planes.vec(-part for part in planes.rotate_back(turn, planes.split(geoms.pos[:, g, None])))
        frames.append(None if is_centred else Frame((xx, yx, zx, xy, yy, zy, xz, yz, zz), offset))
    return union_distance(point, frames, geoms)


def union_distance(point: Vec, frames: Sequence[Frame | None], geoms: Geoms) -> tuple[Tensor, Vec]:
    """Return signed distance [m] to the nearest geom, the first among equals, and its gradient in the points' frame.

    `frames` say how each geom sees the points; None: they are in its frame already.
    """
    return united((_in_frame(point, frame, geoms, g) for g, frame in enumerate(frames)), geoms.is_absent)


def united(geoms: Iterable[tuple[Tensor, Vec]], is_absent: Bool[Tensor, "case geom"] | None) -> tuple[Tensor, Vec]:
    """Return the least of the distances to an object's geoms [m], the first among equals, and its gradient.

    Args:
        geoms: Signed distance to each geom [m] and its gradient, planes (case, …, point).
        is_absent: Which geoms a case lacks; None if none does.
    """
    least, outward = None, None
    for g, (distance, gradient) in enumerate(geoms):
        if is_absent is not None:
            distance = torch.where(is_absent[:, g, None], torch.inf, distance)
        if least is None or outward is None:
            least, outward = distance, gradient
        else:
            outward = planes.where(distance < least - planes.tie(), gradient, outward)
            least = torch.minimum(least, distance)
    assert least is not None and outward is not None
    return least, outward


def _in_frame(point: Vec, frame: Frame | None, geoms: Geoms, g: int) -> tuple[Tensor, Vec]:
    """Return signed distance [m] of points to a geom that sees them as a frame says, and its gradient in the points' frame."""
    if frame is None:
        return _to_geom(point, geoms, g)
    distance, gradient = _to_geom(planes.add(planes.rotate(frame.rotation, point), frame.offset), geoms, g)
    return distance, planes.rotate_back(frame.rotation, gradient)


def _to_geom(point: Vec, geoms: Geoms, g: int) -> tuple[Tensor, Vec]:
    """Return signed distance [m] of points in a geom's frame to it, and its gradient there."""
    shape, surface = geoms.shapes[g], geoms.surfaces[g]
    if isinstance(surface, Grid):
        return METHODS[shape](point, surface)
    if isinstance(surface, RaycastSurface):
        which = geoms.variant[:, None] if geoms.variant is not None and len(surface.meshes) > 1 else None
        return nearest(point, surface.meshes, surface.max_distance, which)
    return SHAPES[shape](point, planes.split(geoms.size[:, g, None]))

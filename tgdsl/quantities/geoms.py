"""Signed distance to the union of geoms, of an object or of links: as the Plan holds it, at run time, and in float64.

Shapes: `case` 1, or `env` if the object differs between environments, or variants, or the links of a table of links; `geom` its
geoms, columns of a table; `node` nodes of all grids of a column.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Generic, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.bvh import TriangleMesh, nearest
from tgdsl.geometry.grid import METHODS, Grid
from tgdsl.geometry.planes import Rot, Vec, split
from tgdsl.geometry.reference import TIE, signed_distance
from tgdsl.geometry.shapes import SHAPES
from tgdsl.quantities.base import Scene, variant_of
from tgdsl.quantities.pairs import PairedObject
from tgdsl.tensors.env_ids import is_cheap_to_read


class RaycastSurface(NamedTuple):
    """Triangles that are queried at run time, one mesh per variant, and the distance [m] below which they count as one."""

    meshes: tuple[TriangleMesh, ...]
    max_distance: float


class Frame(NamedTuple):
    """How an object sees points: a point, rotated and shifted, is in the object's frame; planes that broadcast with points."""

    rotation: Rot  # rotates the points' vectors into the object's frame
    offset: Vec  # the points' origin in the object's frame [m]


class Geoms(NamedTuple):
    """An object's geoms in its body's frame, as each environment has it."""

    shapes: tuple[str, ...]  # method of the distance to each geom: see `GeomTable`
    is_centred: tuple[bool, ...]  # whether each geom's frame is the body's
    size: Float[Tensor, "case geom 3"]  # size of each geom as MuJoCo defines it [m]
    pos: Float[Tensor, "case geom 3"]  # origin of each geom in the body frame [m]
    rotation: Float[Tensor, "case geom 9"]  # rotates geom vectors into the body frame, row by row
    is_absent: Bool[Tensor, "case geom"] | None  # which geoms a case lacks; None if none does
    variant: Int[Tensor, " env"] | None  # which variant each environment has; None if all are alike
    surfaces: tuple[Grid | RaycastSurface | None, ...]  # grid or triangles of each geom that is no primitive


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
    results = []
    for g, frame in enumerate(frames):
        here = point if frame is None else planes.add(planes.rotate(frame.rotation, point), frame.offset)
        distance, gradient = _to_geom(here, geoms, g)
        results.append((distance, gradient if frame is None else planes.rotate_back(frame.rotation, gradient)))
    return united(results, geoms.is_absent)


def united(geoms: Iterable[tuple[Tensor, Vec]], is_absent: Bool[Tensor, "case geom"] | None) -> tuple[Tensor, Vec]:
    """Return the least of the distances to an object's geoms [m], the first among equals, and its gradient."""
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


def _to_geom(point: Vec, geoms: Geoms, g: int) -> tuple[Tensor, Vec]:
    """Return signed distance [m] of points in a geom's frame to it, and its gradient there."""
    shape, surface = geoms.shapes[g], geoms.surfaces[g]
    if isinstance(surface, Grid):
        return METHODS[shape](point, surface)
    if isinstance(surface, RaycastSurface):
        which = geoms.variant[:, None] if geoms.variant is not None and len(surface.meshes) > 1 else None
        return nearest(point, surface.meshes, surface.max_distance, which)
    return SHAPES[shape](point, planes.split(geoms.size[:, g, None]))


Array = TypeVar("Array")


@dataclass(frozen=True, eq=False)
class GridTable(Generic[Array]):
    """The grids of one column, one after the other."""

    values: Array  # signed distance at the nodes [m], float32, (node,)
    first: Array  # index of each case's node (0, 0, 0), (case,)
    num: Array  # number of its nodes along each axis, (case, 3)
    origin: Array  # place of its node (0, 0, 0) in the geom's frame [m], (case, 3)
    cell: Array  # spacing of its nodes [m], (case,)
    counts: tuple[int, int, int]  # nodes of the first case's grid: numbers that become part of compiled code


@dataclass(frozen=True, eq=False)
class TriangleTable:
    """The triangles of one column, which are queried at run time; they stay on the host."""

    stays_on_host: ClassVar[bool] = True
    vertices: tuple[np.ndarray, ...]  # of each case [m], (vertex, 3)
    faces: tuple[np.ndarray, ...]  # of each case, (face, 3)
    max_distance: float  # how far a query looks [m]

    @cached_property
    def prepared(self) -> RaycastSurface:
        """Geoms that are queried; cases with the same triangles share a mesh."""
        meshes: dict[tuple[bytes, bytes], TriangleMesh] = {}
        results = []
        for vertices, faces in zip(self.vertices, self.faces, strict=True):
            key = vertices.tobytes(), faces.tobytes()
            if key not in meshes:
                meshes[key] = TriangleMesh(vertices, faces)
            results.append(meshes[key])
        return RaycastSurface(tuple(results), self.max_distance)


@dataclass(frozen=True, eq=False)
class GeomTable(Generic[Array]):
    """The geoms of an object.

    A column stands for the geoms of one type that the cases have in its place; a case may lack it.
    """

    # method of the distance to each column: a primitive's type, an interpolation of a grid, or `raycast`
    shapes: tuple[str, ...]
    is_centred: tuple[bool, ...]  # which of them share the body's frame in all cases
    size: Array  # size of each as MuJoCo defines it [m], (case, geom, 3)
    pos: Array  # its origin in the body's frame [m], (case, geom, 3)
    rotation: Array  # rotates its vectors into the body's frame, row by row, (case, geom, 9)
    is_absent: Array | None  # 1 where a case lacks it, (case, geom); None if there is one case
    surfaces: tuple[GridTable[Array] | TriangleTable | None, ...]  # grids or triangles of each that is no primitive
    # measured errors of each case's geoms, see `bake.Errors`; empty where distances are exact
    accuracy: tuple[tuple[Mapping[str, float], ...], ...]


def account_of_geoms(table: GeomTable[np.ndarray], names: Sequence[str]) -> list[str]:
    """Return the measured errors of a table's grids for users, who know each case by a name."""
    lines = []
    for case, (name, row) in enumerate(zip(names, table.accuracy, strict=True)):
        for i, accuracy in enumerate(row):
            surface = table.surfaces[i]
            if not accuracy or not isinstance(surface, GridTable):
                continue
            num = surface.num[case]
            lines += [
                f"{name}, geom {i}: {table.shapes[i]} grid of {' × '.join(map(str, num))} nodes every "
                f"{1e3 * accuracy['cell']:.3g} mm, {4 * int(num.prod())} bytes",
                f"  distance: 99 % within {1e3 * accuracy['p99']:.3g} mm (asked: {1e3 * accuracy['tolerance']:.3g} "
                f"mm), largest error {1e3 * accuracy['max']:.3g} mm; near sharp edges "
                f"{1e3 * accuracy['edge_max']:.3g} mm",
            ]
    return lines


def object_geoms(table: GeomTable[Tensor], target: PairedObject, scene: Scene) -> Geoms:
    """Return an object's geoms as each environment has them: its variant, its size. What none of them has may be left out."""
    geoms = geoms_of_cases(table, variant_of(scene, target))
    size, is_absent = geoms.size, geoms.is_absent
    if target.is_sized:
        sizes = scene.tensors["object_size"][:, target.varied, None].to(size.dtype).expand(-1, size.shape[1], -1)
        geoms = geoms._replace(size=sizes if is_absent is None else torch.where(is_absent[..., None], size, sizes))
    return geoms if is_absent is None or not is_cheap_to_read(is_absent) else _had_by_some(geoms, is_absent)


def _had_by_some(geoms: Geoms, is_absent: Bool[Tensor, "env geom"]) -> Geoms:
    """Return those geoms that some environment has."""
    present = [g for g, is_missing in enumerate(is_absent.all(dim=0).tolist()) if not is_missing]
    if len(present) == len(geoms.shapes) or not present:
        return geoms
    ids = torch.tensor(present, device=is_absent.device)
    return geoms._replace(
        **{name: tuple(getattr(geoms, name)[g] for g in present) for name in ("shapes", "is_centred", "surfaces")},
        **{name: getattr(geoms, name).index_select(1, ids) for name in ("size", "pos", "rotation", "is_absent")},
    )


def geoms_of_cases(table: GeomTable[Tensor], case: Tensor | None) -> Geoms:
    """Return the geoms of some cases: of links, or of the variant that each environment has; None: of the only one."""
    size, pos, rotation = (part if case is None else part[case] for part in (table.size, table.pos, table.rotation))
    is_absent = None if case is None or table.is_absent is None else table.is_absent[case] > 0
    surfaces = tuple(_surface(surface, case) for surface in table.surfaces)
    return Geoms(table.shapes, table.is_centred, size, pos, rotation, is_absent, case, surfaces)


def _surface(
    table: GridTable[Tensor] | TriangleTable | RaycastSurface | None, case: Tensor | None
) -> Grid | RaycastSurface | None:
    if isinstance(table, TriangleTable):
        return table.prepared
    if not isinstance(table, GridTable):
        return table
    if case is None:
        return Grid(table.values, 0, table.counts, split(table.origin[:, None]), table.cell[:, None])
    num, origin = (split(part[case][:, None]) for part in (table.num, table.origin))
    return Grid(table.values, table.first[case][:, None], num, origin, table.cell[case][:, None])


@dataclass(frozen=True, eq=False)
class ReferenceGeom:
    """A geom in its body's frame: MuJoCo's type name and size [m], position [m], rotation matrix."""

    shape: str
    size: Float[np.ndarray, " 3"]
    pos: Float[np.ndarray, " 3"]
    rotation: Float[np.ndarray, "3 3"]


def geoms_of(table: GeomTable[np.ndarray], case: int, size: Float[np.ndarray, " 3"] | None = None) -> list[ReferenceGeom]:
    """Return the geoms of a case of a table; `size` replaces its only geom's size [m]."""
    results = []
    for g, shape in enumerate(table.shapes):
        if table.is_absent is None or not table.is_absent[case, g]:
            lengths = np.asarray(table.size[case, g]) if size is None else size
            results.append(ReferenceGeom(shape, lengths, table.pos[case, g], table.rotation[case, g].reshape(3, 3)))
    return results


def distance_to(geoms: Sequence[ReferenceGeom], point: Float[np.ndarray, " 3"]) -> tuple[float, Float[np.ndarray, " 3"]]:
    """Return the signed distance [m] of a point in a body's frame to its geoms, and its gradient; the first of equals wins."""
    least, outward = np.inf, np.zeros(3)
    for geom in geoms:
        phi, gradient = signed_distance(geom.shape, geom.size, geom.rotation.T @ (point - geom.pos))
        if phi < least - TIE:
            outward = geom.rotation @ gradient
        least = min(phi, least)
    return least, outward

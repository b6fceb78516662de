"""The geoms of an object, or of links, as the Plan holds them: a row per variant (or link), a column per geom.

Shapes: `case` variants of an object, or links; `geom` columns; `node` nodes of all grids of a column.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, Generic, TypeVar

import numpy as np

from tgdsl.fields.indices import indices
from tgdsl.geometry.bvh import TriangleMesh
from tgdsl.quantities.geoms.distance import RaycastSurface

Array = TypeVar("Array")


@dataclass(frozen=True, eq=False)
class GridTable(Generic[Array]):
    """The grids of one column, one after the other.

    Attributes:
        values: Signed distance at the nodes [m], float32, (node,).
        first: Index of each case's node (0, 0, 0), (case,).
        num: Number of its nodes along each axis, (case, 3).
        origin: Place of its node (0, 0, 0) in the geom's frame [m], (case, 3).
        cell: Spacing of its nodes [m], (case,).
        counts: Nodes of the first case's grid: numbers that become part of compiled code.
    """

    values: Array
    first: Array = field(
        metadata=indices(lambda grids, part, plan: len(grids.values) + 1 - np.prod(grids.num, axis=1, dtype=float))
    )
    num: Array = field(metadata=indices(None, least=2))
    origin: Array
    cell: Array
    counts: tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class TriangleTable:
    """The triangles of one column, which are queried at run time; they stay on the host.

    Attributes:
        vertices: Of each case [m], (vertex, 3).
        faces: Of each case, (face, 3).
        max_distance: How far a query looks [m].
    """

    stays_on_host: ClassVar[bool] = True
    vertices: tuple[np.ndarray, ...]
    faces: tuple[np.ndarray, ...] = field(metadata=indices(lambda table, part, plan: tuple(map(len, table.vertices))))
    max_distance: float

    @cached_property
    def prepared(self) -> RaycastSurface:
        """What is queried; cases with the same triangles share a mesh."""
        meshes: dict[tuple[bytes, bytes], TriangleMesh] = {}
        found = []
        for vertices, faces in zip(self.vertices, self.faces, strict=True):
            key = vertices.tobytes(), faces.tobytes()
            if key not in meshes:
                meshes[key] = TriangleMesh(vertices, faces)
            found.append(meshes[key])
        return RaycastSurface(tuple(found), self.max_distance)


@dataclass(frozen=True, eq=False)
class GeomTable(Generic[Array]):
    """The geoms of an object.

    A column stands for the geoms of one type that the cases have in its place; a case may lack it.

    Attributes:
        shapes: How the distance to each column is found: a primitive's type, an interpolation of a grid, or `raycast`.
        is_centred: Which of them share the body's frame in all cases.
        size: Size of each as MuJoCo defines it [m], (case, geom, 3).
        pos: Its origin in the body's frame [m], (case, geom, 3).
        rotation: Rotates its vectors into the body's frame, row by row, (case, geom, 9).
        is_absent: 1 where a case lacks it, (case, geom); None if there is one case.
        surfaces: Grids or triangles of each that is no primitive.
        accuracy: What was measured of each case's geoms: see `bake.Errors`; empty where distances are exact.
    """

    shapes: tuple[str, ...]
    is_centred: tuple[bool, ...]
    size: Array
    pos: Array
    rotation: Array
    is_absent: Array | None = field(metadata=indices(lambda table, part, plan: 2))
    surfaces: tuple[GridTable[Array] | TriangleTable | None, ...]
    accuracy: tuple[tuple[Mapping[str, float], ...], ...]


def account(table: GeomTable[np.ndarray], names: Sequence[str]) -> list[str]:
    """Return what was measured of a table's grids, for users.

    Args:
        table: The table.
        names: What to call each case.
    """
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

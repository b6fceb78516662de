"""From geoms to their table: the outer surfaces of meshes become grids of signed distance, or stay triangles.

Primitives need neither.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import igl
import numpy as np

from tgdsl.files import cache
from tgdsl.quantities.geoms.bake import bake
from tgdsl.quantities.geoms.tables import GeomTable, GridTable, TriangleTable
from tgdsl.surfaces.geom import SurfaceGeom
from tgdsl.surfaces.outer import Outer, outer
from tgdsl.surfaces.sensed import DistanceOptions
from tgdsl.surfaces.surface import Surface

OUTER_FORMAT = b"tgdsl outer surface 1"
HULL_POINTS = 2000
"""Points of a convex hull whose distance to the mesh is looked at."""


@dataclass(frozen=True, eq=False)
class GeomDistance:
    """How the distance to a geom is found.

    Attributes:
        geom: The geom.
        shape: What computes it: a primitive's type, an interpolation of a grid, or `raycast`.
        arrays: What that needs besides the geom's size and pose, by name.
        accuracy: What a grid costs, by name; empty for what is exact.
    """

    geom: SurfaceGeom
    shape: str
    arrays: Mapping[str, np.ndarray]
    accuracy: Mapping[str, float]


def geom_distance(felt: SurfaceGeom, options: DistanceOptions, margin: float, name: str) -> GeomDistance:
    """Bake a mesh, or keep its triangles, as its options say; a primitive needs neither.

    Args:
        felt: The geom.
        options: How the distance to triangles is found.
        margin: Largest distance from the surface that any sensor asks for [m].
        name: What warnings call the object or link: "object cube".

    Raises:
        BakeError: If no face has an area, or no grid within the budget holds the tolerance.
    """
    if felt.surface is None:
        return GeomDistance(felt, felt.shape, {}, {})
    _warn_of_hull(felt, margin, name)
    if options.query == "raycast":
        triangles = _outer(felt.surface)
        _warn_of_flaws(triangles.flaws, felt, name)
        arrays = {"vertices": triangles.vertices, "faces": triangles.faces, "max_distance": np.asarray(2.0 * margin)}
        return GeomDistance(felt, "raycast", arrays, {})
    baked = bake(felt.surface, margin, options.tolerance, options.max_bytes)
    _warn_of_flaws(baked.flaws, felt, name)
    arrays = {"values": baked.values, "origin": baked.origin, "cell": np.asarray(baked.cell)}
    accuracy = {key: float(value) for key, value in dataclasses.asdict(baked.errors).items()}
    return GeomDistance(felt, baked.method, arrays, {**accuracy, "tolerance": options.tolerance, "cell": baked.cell})


def geom_table(cases: Sequence[Sequence[GeomDistance]]) -> GeomTable[np.ndarray]:
    """Return the table of an object's variants, or of links: geoms of one shape share a column, in their order."""
    shapes, places = aligned([[part.shape for part in case] for case in cases])
    rows = [[None if i is None else own[i] for i in table] for own, table in zip(cases, places, strict=True)]
    columns = list(zip(*rows, strict=True))
    of_geom = {}
    for key, absent in (("size", np.ones(3)), ("pos", np.zeros(3)), ("rotation", np.eye(3))):
        found = [[absent if part is None else getattr(part.geom.geom, key) for part in row] for row in rows]
        of_geom[key] = np.array(found).reshape(len(rows), len(rows[0]), -1)
    is_absent = np.array([[part is None for part in row] for row in rows]) if len(rows) > 1 else None
    return GeomTable(
        shapes=shapes,
        is_centred=tuple(all(part is None or part.geom.geom.is_centred for part in column) for column in columns),
        **of_geom,
        is_absent=is_absent,
        surfaces=tuple(_surface(column) for column in columns),
        accuracy=tuple(tuple({} if part is None else dict(part.accuracy) for part in row) for row in rows),
    )


def aligned(rows: Sequence[Sequence[str]]) -> tuple[tuple[str, ...], list[list[int | None]]]:
    """Give the members of several rows common columns, each for one kind, the order within each row kept.

    Args:
        rows: The kinds of each row's members.

    Returns:
        The kind of each column; and for each row the index of its member in each column, None where it has none.
    """
    columns: list[str] = []
    tables: list[list[int | None]] = []
    for row in rows:
        table: list[int | None] = [None] * len(columns)
        after = 0
        for member, kind in enumerate(row):
            place = next((i for i in range(after, len(columns)) if columns[i] == kind), None)
            if place is None:
                place = len(columns)
                columns.append(kind)
                for other in (*tables, table):
                    other.append(None)
            table[place], after = member, place + 1
        tables.append(table)
    return tuple(columns), tables


def _surface(column: Sequence[GeomDistance | None]) -> GridTable[np.ndarray] | TriangleTable | None:
    """Return the grids or triangles of a column, case after case; a case that lacks it has another's."""
    like = next(part.arrays for part in column if part is not None)
    owned = [like if part is None else part.arrays for part in column]
    if "vertices" in like:
        vertices, faces = (tuple(own[key] for own in owned) for key in ("vertices", "faces"))
        return TriangleTable(vertices, faces, float(like["max_distance"]))
    if "values" not in like:
        return None
    distinct = list({id(own): own for own in owned}.values())
    place = [next(i for i, own in enumerate(distinct) if own is found) for found in owned]
    starts = np.cumsum([0, *(own["values"].size for own in distinct)])
    x, y, z = owned[0]["values"].shape
    return GridTable(
        values=np.concatenate([own["values"].reshape(-1) for own in distinct]),
        first=starts[place],
        num=np.array([own["values"].shape for own in owned]),
        origin=np.array([own["origin"] for own in owned]),
        cell=np.array([own["cell"] for own in owned]),
        counts=(x, y, z),
    )


def _outer(surface: Surface) -> Outer:
    """Return the outer surface of a mesh; it is kept in the user's cache folder."""

    def unpacked(found: Mapping[str, np.ndarray]) -> Outer:
        return Outer(found["vertices"], found["faces"], found["uncut"], tuple(found["flaws"].tolist()))

    arrays = [np.asarray(surface.vertices, np.float64), np.asarray(surface.faces, np.int64)]
    key = cache.digest(OUTER_FORMAT, arrays)
    return cache.cached(key, lambda: outer(surface), lambda made: {k: np.asarray(v) for k, v in vars(made).items()}, unpacked)


def _warn_of_flaws(flaws: Sequence[str], felt: SurfaceGeom, name: str) -> None:
    for flaw in flaws:
        warnings.warn(f"{name}: {felt.geom.shown} {flaw}", stacklevel=3)


def _warn_of_hull(felt: SurfaceGeom, margin: float, name: str) -> None:
    """MuJoCo collides convex hulls: say so where a hull stands further off the mesh than any probe reaches."""
    hull = felt.surface
    if hull is None or felt.mesh is None:
        return
    import trimesh

    whole = trimesh.Trimesh(hull.vertices, hull.faces, process=False)
    sampled = trimesh.sample.sample_surface(whole, HULL_POINTS, seed=0)[0]
    squared, *_ = igl.point_mesh_squared_distance(np.asarray(sampled), felt.mesh.vertices, felt.mesh.faces)
    depth = float(np.sqrt(np.max(squared)))
    if depth > margin:
        warnings.warn(
            f"{name}: MuJoCo collides the convex hull of {felt.geom.shown}, up to {1e3 * depth:.1f} mm off the mesh, "
            "and that hull is felt; `surface` names what to feel instead",
            stacklevel=2,
        )

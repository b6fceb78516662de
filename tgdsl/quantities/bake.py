"""Geoms for the Plan: meshes cleaned, their signed distance baked into grids or kept as triangles, in a cache."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import igl
import numpy as np
import torch
from jaxtyping import Float

from tgdsl.errors import BakeError
from tgdsl.files import cache
from tgdsl.geometry.grid import METHODS, one_grid
from tgdsl.quantities.geoms import GeomTable, GridTable, TriangleTable
from tgdsl.surfaces.geom import SurfaceGeom
from tgdsl.surfaces.outer import Outer, outer
from tgdsl.surfaces.sensed import DistanceOptions
from tgdsl.surfaces.solid import Lattice, Solid
from tgdsl.surfaces.surface import Surface

FORMAT = b"tgdsl grid 4"
CHOICE_POINTS, REPORT_POINTS = 4096, 16384
HEADROOM, CHOICE_PERCENTILE = 0.95, 99.3
"""The choice holds the tolerance with something to spare, nearly two standard deviations of a percentile of so few points, so
that as a rule the 99th percentile of the held-back points holds it too."""
EDGE_FACTOR = 5.0  # how many times the tolerance the 99th percentile of the error near sharp edges may be
COARSEST = 16  # cells along the longest side of the first grid that is tried


@dataclass(frozen=True)
class Errors:
    """Errors at random points of the band, which took no part in the choice of the grid.

    Points nearer to a sharp edge than one cell are counted apart: there no grid does better than O(cell).
    """

    count: int  # points away from sharp edges; the tolerance holds for their `p99`
    p99: float  # 99th percentile of the distance error [m]
    max: float  # largest distance error [m]
    rms: float  # root mean square of the distance error [m]
    angle_p99: float  # 99th percentile of the angle between the gradient and the true one [rad]
    edge_count: int  # points near sharp edges
    edge_p99: float  # 99th percentile of their distance error [m]; 0 if there are none, as the next
    edge_max: float  # largest distance error among them [m]


@dataclass(frozen=True, eq=False)
class Baked:
    """A grid of signed distances in the surface's frame."""

    values: Float[np.ndarray, "x y z"]  # signed distance at the nodes [m], negative inside
    origin: Float[np.ndarray, " 3"]  # place of node (0, 0, 0) [m]
    cell: float  # spacing of the nodes [m]
    method: str  # name of the function of `tgdsl.geometry.grid` that interpolates: trilinear or tricubic
    errors: Errors  # errors of the grid
    flaws: tuple[str, ...]  # what of the surface its user should know: see `Outer`


def bake(surface: Surface, margin: float, tolerance: float = 5e-5, budget: int = 64 * 2**20) -> Baked:
    """Return the coarsest grid found that holds a surface's signed distance to a tolerance.

    The tolerance bounds the 99th percentile of the error at random points of the band |distance| ≤ margin, denser near the
    surface. An edge is sharp where its faces' normals differ by more than 30°, or where it does not join two faces: points
    nearer to one than a cell are reported apart and held to five times the tolerance (their error is a fraction of a cell).
    At each cell size the cheaper trilinear lookup is tried first. Results are cached on disk.

    Args:
        surface: The surface, in the frame that the grid is to have.
        margin: Width of the band and of the grid's rim around the surface [m]: the radius of the largest probe.
        tolerance: Largest distance error [m], in the sense above.
        budget: Largest size of the values [bytes].

    Raises:
        BakeError: Nothing to bake, or the tolerance needs more than the budget.
    """
    if not (np.isfinite(surface.vertices).all() and len(surface.faces) and 0 < margin < np.inf and 0 < tolerance < np.inf):
        raise BakeError("a surface to bake needs faces, finite vertices, and a margin and a tolerance above 0")
    limits = np.array([margin, tolerance, budget], float)
    arrays = [limits, np.asarray(surface.vertices, np.float64), np.asarray(surface.faces, np.int64)]
    key = cache.digest(FORMAT, arrays)
    return cache.cached_record(key, lambda: _bake(Solid(surface), margin, tolerance, budget), Baked)


@dataclass(frozen=True, eq=False)
class _Points:
    """Random points of the band with their true distance [m], its gradient, and their distance to a sharp edge [m]."""

    pos: Float[np.ndarray, "n 3"]
    distance: Float[np.ndarray, " n"]
    gradient: Float[np.ndarray, "n 3"]
    to_edge: Float[np.ndarray, " n"]

    @staticmethod
    def around(solid: Solid, margin: float, count: int, seed: int) -> _Points:
        """Return points of balls of radius `margin` around uniformly random points of the surface."""
        rng = np.random.default_rng(seed)
        corners = solid.corners
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        face = rng.choice(len(corners), count, p=area / area.sum())
        weight = rng.dirichlet((1.0, 1.0, 1.0), count)
        way = rng.normal(size=(count, 3))
        way *= margin * np.cbrt(rng.uniform(size=(count, 1))) / np.linalg.norm(way, axis=1, keepdims=True)
        pos = (weight[:, :, None] * corners[face]).sum(axis=1) + way
        return _Points(pos, *solid.distance(pos), solid.edge_distance(pos))


def _bake(solid: Solid, margin: float, tolerance: float, budget: int) -> Baked:
    points = _Points.around(solid, margin, CHOICE_POINTS, seed=1)
    lattice, method = _choose(solid, points, margin, tolerance, budget)
    values = solid.node_distance(lattice)
    held_back = _Points.around(solid, margin, REPORT_POINTS, seed=2)
    errors = _errors(held_back, values, lattice, method)
    return Baked(values, lattice.origin, lattice.cell, method, errors, solid.flaws)


def _choose(solid: Solid, points: _Points, margin: float, tolerance: float, budget: int) -> tuple[Lattice, str]:
    """Return the first grid, from coarse to fine, and the first method that hold the tolerance."""
    longest = float(np.ptp(solid.corners.reshape(-1, 3), axis=0).max()) + 2 * margin
    lattice = Lattice.around(solid, margin, longest / COARSEST)
    needed = lattice.num_bytes
    while lattice.num_bytes <= budget:
        nodes = lattice.nodes_around(points.pos)
        values = np.zeros(lattice.shape, np.float32)
        values.reshape(-1)[nodes] = solid.distance(lattice.pos(nodes))[0]
        worst = np.inf
        for method in METHODS:
            errors = _errors(points, values, lattice, method, CHOICE_PERCENTILE)
            error = max(errors.p99, errors.edge_p99 / EDGE_FACTOR) / (HEADROOM * tolerance)
            error = error if errors.count >= CHOICE_POINTS // 10 else np.inf
            if error <= 1:
                return lattice, method
            worst = min(worst, error)
        # Creases of the distance decide fine grids: there the error falls like the cell.
        needed = Lattice.around(solid, margin, lattice.cell / min(worst, COARSEST)).num_bytes
        lattice = Lattice.around(solid, margin, lattice.cell / float(np.clip(np.cbrt(worst), 1.2, 1.6)))
    needed = max(needed, lattice.num_bytes)
    raise BakeError(
        f"a grid of a tolerance of {tolerance * 1e3:g} mm needs about {needed / 2**20:.3g} MiB ({needed} bytes), and the"
        f" budget is {budget / 2**20:.3g} MiB ({budget} bytes); raise the tolerance or the budget"
    )


def _errors(points: _Points, values: np.ndarray, lattice: Lattice, method: str, percentile: float = 99.0) -> Errors:
    """Return the errors of a grid, in float64, at points all of whose nodes are there."""
    grid = one_grid(torch.from_numpy(values), torch.from_numpy(lattice.origin), torch.tensor(lattice.cell, dtype=torch.float64))
    x, y, z = (torch.from_numpy(np.ascontiguousarray(part)) for part in points.pos.T)
    distance, gradient = METHODS[method]((x, y, z), grid)
    error = np.abs(distance.numpy() - points.distance)
    cosine = (torch.stack(gradient, dim=1).numpy() * points.gradient).sum(axis=1)
    is_edge = points.to_edge < lattice.cell
    away, near = error[~is_edge], error[is_edge]
    # On the surface itself the true gradient is not known: a cosine of 0 exactly.
    angle = np.arccos(np.clip(cosine[~is_edge & points.gradient.any(axis=1)], -1, 1))
    return Errors(
        count=len(away),
        p99=float(np.percentile(away, percentile)) if len(away) else 0.0,
        max=float(away.max(initial=0)),
        rms=float(np.sqrt(np.mean(away**2))) if len(away) else 0.0,
        angle_p99=float(np.percentile(angle, percentile)) if len(angle) else 0.0,
        edge_count=len(near),
        edge_p99=float(np.percentile(near, percentile)) if len(near) else 0.0,
        edge_max=float(near.max(initial=0)),
    )


OUTER_FORMAT = b"tgdsl outer surface 1"
HULL_POINTS = 2000  # points of a convex hull whose distance to the mesh is looked at


@dataclass(frozen=True, eq=False)
class GeomDistance:
    """How the distance to a geom is computed."""

    geom: SurfaceGeom  # the geom
    shape: str  # what computes it: a primitive's type, an interpolation of a grid, or `raycast`
    arrays: Mapping[str, np.ndarray]  # further arrays that the method needs, by name
    accuracy: Mapping[str, float]  # errors of a grid, by name; empty for exact distances


def geom_distance(felt: SurfaceGeom, options: DistanceOptions, margin: float, name: str) -> GeomDistance:
    """Bake a mesh to the largest distance that any sensor asks for [m], or keep its triangles, as its options say.

    A primitive needs neither. `name` is what warnings call the object or link: "object cube".
    """
    surface = felt.surface
    if surface is None:
        return GeomDistance(felt, felt.shape, {}, {})
    _warn_of_hull(felt, margin, name)
    if options.query == "raycast":
        mesh = np.asarray(surface.vertices, np.float64), np.asarray(surface.faces, np.int64)
        baked = cache.cached_record(cache.digest(OUTER_FORMAT, mesh), lambda: outer(surface), Outer)
        arrays = {"vertices": baked.vertices, "faces": baked.faces, "max_distance": np.asarray(2.0 * margin)}
        result = GeomDistance(felt, "raycast", arrays, {})
    else:
        baked = bake(surface, margin, options.tolerance, options.max_bytes)
        arrays = {"values": baked.values, "origin": baked.origin, "cell": np.asarray(baked.cell)}
        accuracy = {key: float(value) for key, value in dataclasses.asdict(baked.errors).items()}
        limits = {"tolerance": options.tolerance, "cell": baked.cell}
        result = GeomDistance(felt, baked.method, arrays, {**accuracy, **limits})
    for flaw in baked.flaws:
        warnings.warn(f"{name}: {felt.geom.shown} {flaw}", stacklevel=2)
    return result


def geom_table(cases: Sequence[Sequence[GeomDistance]]) -> GeomTable[np.ndarray]:
    """Return the table of an object's variants, or of links: geoms of one shape share a column, in their order."""
    shapes, places = aligned([[part.shape for part in case] for case in cases])
    rows = [[None if i is None else case[i] for i in place] for case, place in zip(cases, places, strict=True)]
    columns = list(zip(*rows, strict=True))
    of_geom = {}
    for key, absent in (("size", np.ones(3)), ("pos", np.zeros(3)), ("rotation", np.eye(3))):
        values = [[absent if part is None else getattr(part.geom.geom, key) for part in row] for row in rows]
        of_geom[key] = np.array(values).reshape(len(rows), len(rows[0]), -1)
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
        vertices, faces = (tuple(grid[key] for grid in owned) for key in ("vertices", "faces"))
        return TriangleTable(vertices, faces, float(like["max_distance"]))
    if "values" not in like:
        return None
    distinct = list({id(grid): grid for grid in owned}.values())
    place = [next(i for i, grid in enumerate(distinct) if grid is each) for each in owned]
    starts = np.cumsum([0, *(grid["values"].size for grid in distinct)])
    x, y, z = owned[0]["values"].shape
    return GridTable(
        values=np.concatenate([grid["values"].reshape(-1) for grid in distinct]),
        first=starts[place],
        num=np.array([grid["values"].shape for grid in owned]),
        origin=np.array([grid["origin"] for grid in owned]),
        cell=np.array([grid["cell"] for grid in owned]),
        counts=(x, y, z),
    )


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
            "and taxels feel that hull; `surface` names another geometry to feel",
            stacklevel=2,
        )

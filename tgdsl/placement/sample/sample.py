"""Taxels on a link's surface: grids, even samples and points given by hand, each with normal, tangent and area.

Shapes: `taxel` samples, `f` faces, `cell` cells of a grid. Everything is in the body frame.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from tgdsl.errors import SampleError
from tgdsl.placement.sample import poisson
from tgdsl.placement.sample.points import PointTable, point_table
from tgdsl.schema.placement import Grid, Placement, Poisson
from tgdsl.surfaces import meshlab
from tgdsl.surfaces.rays import OrthographicView, first_hits, frame, reference_axes, visible_rectangle
from tgdsl.surfaces.region import Covered, Region, unit
from tgdsl.surfaces.surface import Surface

MIN_COSINE = 0.1  # a grid cell on a steep face counts at most 1/0.1 times its projected area
ROUNDED = 1e-14
"""Largest rounding of a squared length, and of the cosine of a normal and a tangent that was projected across it."""
MAX_DENSITY = poisson.MAX_POOL / poisson.PER_SAMPLE
"""Largest area per squared spacing: about 0.7 times as many samples fit, and the pool resolves no finer spacing."""


@dataclass(frozen=True, eq=False)
class Samples:
    """Taxels of one link."""

    pos: Float[np.ndarray, "taxel 3"]  # position in the body frame [m]
    normal: Float[np.ndarray, "taxel 3"]  # outward unit normal in the body frame
    tangent: Float[np.ndarray, "taxel 3"]  # unit tangent in the body frame, perpendicular to the normal
    radius: Float[np.ndarray, " taxel"]  # sensing radius [m]
    area: Float[np.ndarray, " taxel"]  # surface that the taxel stands for [m²]
    cell: Int[np.ndarray, "taxel 2"]  # row and column in the grid; −1 where there is none


def sample(
    surface: Surface,
    placement: Placement,
    folder: Path,
    link: str = "",
    is_covered: Covered | None = None,
    pools: dict[Hashable, poisson.Pool | None] | None = None,
) -> Samples:
    """Return the taxels that a placement puts on a link's surface; the same input gives the same bytes.

    Args:
        surface: The link's triangles, in the body frame.
        placement: How to sample them.
        folder: Where a file of points is looked up.
        link: The link's name, by which its points are found in a file of several links.
        is_covered: Returns which points other solids cover; an `exposed` placement leaves them out.
        pools: Points to choose from on the same surface, drawn for other placements; those that are drawn are added.

    Raises:
        SampleError: If the surface, or the file of points, cannot satisfy the placement.
    """
    if isinstance(placement, Grid):
        return _grid(surface, placement, is_covered if placement.exposed else None)
    if isinstance(placement, Poisson):
        return _poisson(surface, placement, is_covered if placement.exposed else None, {} if pools is None else pools)
    return _points(point_table(placement, folder, link))


def _grid(surface: Surface, placement: Grid, is_covered: Covered | None) -> Samples:
    """Project rows × columns onto the surface.

    Columns, rows and direction are a right-handed frame: seen from where the rays start, columns run to the right and rows
    down, as on a page. The side that a ray comes from is outside. With `rows_reversed` rows run up, as in a mirror image.
    """
    view = OrthographicView.of(surface, _grid_axes(placement))
    region = Region.of(surface, placement.region, is_covered)
    rectangle = visible_rectangle(view, region)
    if rectangle is None:
        problem = "the region" if placement.region else "the link's exposed surface" if is_covered else "the link's surface"
        raise SampleError(f"no part of {problem} is seen along {_shown(placement.direction)}", "turn `direction`")
    cell = np.stack(np.divmod(np.arange(placement.rows * placement.columns), placement.columns), axis=-1)
    num = np.array([placement.columns, placement.rows])
    low, high = rectangle
    pitch = (high - low) / num
    step = np.column_stack([placement.rows - 1 - cell[:, 0], cell[:, 1]]) if placement.rows_reversed else cell
    uv = low + (step[:, ::-1] + 0.5) * pitch
    hits = first_hits(view, uv)
    chosen = np.flatnonzero(hits.face >= 0)
    pos = np.column_stack([uv[chosen], hits.depth[chosen]]) @ view.axes
    face = hits.face[chosen]
    is_in = region.has_faces(view.normals[face], view.geom[face]) & region.has_points(pos)
    kept = np.flatnonzero(is_in)[_central(placement, cell[chosen[is_in]], pitch)]
    normal = view.normals[face[kept]]
    cosine = np.abs(normal @ view.axes[2])
    return Samples(
        pos=pos[kept],
        normal=normal,
        tangent=_tangent(normal, view.axes[0], -view.axes[1] if placement.rows_reversed else view.axes[1]),
        radius=np.full(len(kept), placement.radius),
        area=pitch.prod() / np.maximum(cosine, MIN_COSINE),
        cell=cell[chosen[kept]],
    )


def _grid_axes(placement: Grid) -> Float[np.ndarray, "3 3"]:
    """Return the unit vectors along columns, rows and rays."""
    direction = unit(np.array(placement.direction))
    if placement.columns_along is None:
        return frame(direction)
    columns = unit(np.array(placement.columns_along))
    if np.linalg.norm(np.cross(direction, columns)) < 1e-6:
        problem = f"`columns_along` {_shown(placement.columns_along)} is parallel to `direction`"
        raise SampleError(f"{problem} {_shown(placement.direction)}", "choose an axis across it")
    return frame(direction, columns)


def _central(placement: Grid, cell: Int[np.ndarray, "hit 2"], pitch: Float[np.ndarray, " 2"]) -> Int[np.ndarray, " kept"]:
    """Return which of the cells that hit are kept, ascending: all, or the `count` nearest the rectangle's centre."""
    total = placement.rows * placement.columns
    if not len(cell):
        raise SampleError(f"none of the grid's {total} cells hits the surface", "give more `rows` and `columns`")
    if placement.count is None:
        return np.arange(len(cell))
    if placement.count > len(cell):
        problem = f"only {len(cell)} of the grid's {total} cells hit the surface, expected `count` {placement.count}"
        raise SampleError(problem, "lower `count`, or give more `rows` and `columns`")
    from_center = (cell + 0.5 - np.array([placement.rows, placement.columns]) / 2) * pitch[::-1]
    distance = np.linalg.norm(from_center, axis=1)
    order = np.argsort(distance, kind="stable")
    # Distances that differ by rounding are ties; which cell wins must not depend on the last bit of a mesh.
    steps = np.diff(distance[order], prepend=distance[order[0]]) > 1e-4 * pitch[pitch > 0].min(initial=np.inf)
    tier = np.empty(len(cell), dtype=np.int64)
    tier[order] = np.cumsum(steps)
    return np.sort(np.lexsort((cell[:, 1], cell[:, 0], tier))[: placement.count])


def _poisson(
    surface: Surface, placement: Poisson, is_covered: Covered | None, pools: dict[Hashable, poisson.Pool | None]
) -> Samples:
    """Poisson-disk samples: an exact count, or as many as fit at a spacing."""
    size = placement.spacing if placement.count is None else poisson.size(placement.count)
    drawn = (placement.region, placement.exposed, placement.seed, size, placement.sampler)
    if drawn not in pools:
        try:
            shell = meshlab.outer_shell(surface)
        except ImportError as error:
            raise SampleError(f"`poisson` needs pymeshlab: {error}", "pip install pymeshlab") from error
        region = Region.of(surface, placement.region, is_covered)
        pools[drawn] = poisson.pool(shell, region, placement.seed, placement.count, placement.spacing, placement.sampler)
    pool = pools[drawn]
    part, hint = "exposed outer surface" if placement.exposed else "outer surface", "widen `region`"
    hint = "other links cover it: place none here" if placement.exposed and not placement.region else hint
    if pool is None:
        raise SampleError(f"no part of the link's {part} is in the region", hint)
    if placement.count is not None and len(pool.pos) < placement.count:
        raise SampleError(f"the region holds too little of the link's {part} for `count` {placement.count}", hint)
    if placement.spacing is not None and pool.area / placement.spacing**2 > MAX_DENSITY:
        least = np.sqrt(pool.area / MAX_DENSITY)
        problem = f"a spacing of {placement.spacing:g} m is too fine for a surface of {pool.area:.3g} m²"
        raise SampleError(problem, f"expected at least {least:.2g} m")
    chosen = poisson.choose(pool, placement.count, placement.spacing)
    normal = pool.normal[chosen]
    return Samples(
        pos=pool.pos[chosen],
        normal=normal,
        tangent=_tangent(normal, reference_axes(normal)),
        radius=np.full(len(chosen), placement.radius),
        area=poisson.voronoi_areas(pool, chosen),
        cell=np.full((len(chosen), 2), -1),
    )


def _points(table: PointTable) -> Samples:
    """Take points as they are: nothing is projected, and what is unit and perpendicular already keeps its bits."""
    normal = _kept_unit(table.normal)
    tangent = _tangent(normal, reference_axes(normal))
    given = np.flatnonzero(~np.isnan(table.tangent[:, 0]))
    along = _kept_unit(table.tangent[given])
    is_across = np.abs((along * normal[given]).sum(axis=1)) <= ROUNDED
    tangent[given] = np.where(is_across[:, None], along, _tangent(normal[given], along))
    area = np.where(np.isnan(table.area), np.pi * table.radius**2, table.area)
    return Samples(table.pos, normal, tangent, table.radius, area, table.cell)


def _kept_unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    is_unit = np.abs((vectors**2).sum(axis=1) - 1.0) <= ROUNDED
    return np.where(is_unit[:, None], vectors, unit(vectors))


def _shown(vector: tuple[float, ...]) -> str:
    return "[" + ", ".join(f"{component:g}" for component in vector) + "]"


def _tangent(
    normal: Float[np.ndarray, "n 3"], along: Float[np.ndarray, "*n 3"], otherwise: Float[np.ndarray, " 3"] | None = None
) -> Float[np.ndarray, "n 3"]:
    """Return `along` projected onto the tangent planes, unit; `otherwise` projected where it is near the normal."""
    along = np.broadcast_to(along, normal.shape)
    if otherwise is not None:
        is_normal = np.linalg.norm(np.cross(normal, along), axis=1) < 1e-3
        along = np.where(is_normal[:, None], otherwise, along)
    return unit(along - (along * normal).sum(axis=1, keepdims=True) * normal)

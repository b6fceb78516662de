"""Taxels on a link's surface: grids, even samples and points given by hand, each with normal, tangent and area.

Shapes: `taxel` samples, `f` faces, `cell` cells of a grid. Everything is in the body frame.
"""

from __future__ import annotations

import csv
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from tgdsl.errors import SampleError, did_you_mean
from tgdsl.placement.sample import poisson
from tgdsl.schema.placement import MAX_COUNT, Grid, Placement, Point, Points, Poisson
from tgdsl.surfaces import meshlab
from tgdsl.surfaces.rays import OrthographicView, first_hits, frame, reference_axes, visible_rectangle
from tgdsl.surfaces.region import Covered, Region, unit
from tgdsl.surfaces.surface import Surface

MIN_COSINE = 0.1  # a grid cell on a steep face counts at most 1/0.1 times its projected area
ROUNDED = 1e-14  # largest rounding of a squared length, and of the cosine of a normal and its tangent
MAX_DENSITY = poisson.MAX_POOL / poisson.PER_SAMPLE
"""Largest area per squared spacing: about 0.7 times as many samples fit, and the pool resolves no finer spacing."""

Drawn = dict[Hashable, Any]
"""Pools of points, and grids' visible rectangles, on one surface, by the placement's options that they depend on."""


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
    drawn: Drawn | None = None,
) -> Samples:
    """Return the taxels that a placement puts on a link's surface; the same input gives the same bytes.

    `drawn` keeps what other placements on the same surface share.

    Raises:
        SampleError: If the surface, or the file of points, cannot satisfy the placement.
    """
    if isinstance(placement, Grid):
        return _grid(surface, placement, is_covered if placement.exposed else None, {} if drawn is None else drawn)
    if isinstance(placement, Poisson):
        return _poisson(surface, placement, is_covered if placement.exposed else None, {} if drawn is None else drawn)
    return _points(point_table(placement, folder, link))


def _grid(surface: Surface, placement: Grid, is_covered: Covered | None, drawn: Drawn) -> Samples:
    """Project rows × columns onto the surface.

    Columns, rows and direction are a right-handed frame: seen from where the rays start, columns run to the right and rows
    down, as on a page. The side that a ray comes from is outside. With `rows_reversed` rows run up, as in a mirror image.
    """
    view = OrthographicView.of(surface, _grid_axes(placement))
    region = Region.of(surface, placement.region, is_covered)
    seen = (placement.region, placement.exposed, placement.direction, placement.columns_along)
    if seen not in drawn:
        drawn[seen] = visible_rectangle(view, region)
    rectangle = drawn[seen]
    if rectangle is None:
        problem = "the region" if placement.region else "the link's exposed surface" if is_covered else "the link's surface"
        raise SampleError(f"no part of {problem} is visible along {_vector(placement.direction)}", "turn `direction`")
    cell = np.stack(np.divmod(np.arange(placement.rows * placement.columns), placement.columns), axis=-1)
    num = np.array([placement.columns, placement.rows])
    low, high = rectangle
    pitch = (high - low) / num
    step = np.column_stack([placement.rows - 1 - cell[:, 0], cell[:, 1]]) if placement.rows_reversed else cell
    uv = low + (step[:, ::-1] + 0.5) * pitch
    hits = first_hits(view, uv)
    hit = np.flatnonzero(hits.face >= 0)
    pos = np.column_stack([uv[hit], hits.depth[hit]]) @ view.axes
    face = hits.face[hit]
    is_in = region.has_faces(view.normals[face], view.geom[face]) & region.has_points(pos)
    central = np.flatnonzero(is_in)[_central(placement, cell[hit[is_in]], pitch)]
    normal = view.normals[face[central]]
    cosine = np.abs(normal @ view.axes[2])
    return Samples(
        pos=pos[central],
        normal=normal,
        tangent=_tangent(normal, view.axes[0], -view.axes[1] if placement.rows_reversed else view.axes[1]),
        radius=np.full(len(central), placement.radius),
        area=pitch.prod() / np.maximum(cosine, MIN_COSINE),
        cell=cell[hit[central]],
    )


def _grid_axes(placement: Grid) -> Float[np.ndarray, "3 3"]:
    """Return the unit vectors along columns, rows and rays."""
    direction = unit(np.array(placement.direction))
    if placement.columns_along is None:
        return frame(direction)
    columns = unit(np.array(placement.columns_along))
    if np.linalg.norm(np.cross(direction, columns)) < 1e-6:
        problem = f"`columns_along` {_vector(placement.columns_along)} is parallel to `direction`"
        raise SampleError(f"{problem} {_vector(placement.direction)}", "choose an axis across it")
    return frame(direction, columns)


def _central(placement: Grid, cell: Int[np.ndarray, "hit 2"], pitch: Float[np.ndarray, " 2"]) -> Int[np.ndarray, " kept"]:
    """Return the indices of the cells to use, ascending: all hits, or the `count` nearest the rectangle's centre."""
    total = placement.rows * placement.columns
    if not len(cell):
        problem = f"none of the grid's {total} cells hits the surface along {_vector(placement.direction)}"
        opposite = _vector(tuple(0.0 - component for component in placement.direction))
        hint = f"`direction` points into the surface: is {opposite} meant? Else give more `rows` and `columns`"
        raise SampleError(problem, hint)
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


def _poisson(surface: Surface, placement: Poisson, is_covered: Covered | None, drawn: Drawn) -> Samples:
    """Poisson-disk samples: an exact count, or as many as fit at a spacing."""
    size = placement.spacing if placement.count is None else poisson.size(placement.count)
    pooled = (placement.region, placement.exposed, placement.seed, size, placement.sampler)
    if pooled not in drawn:
        try:
            shell = meshlab.outer_shell(surface)
        except ImportError as error:
            raise SampleError(f"`poisson` needs pymeshlab: {error}", "pip install pymeshlab") from error
        region = Region.of(surface, placement.region, is_covered)
        drawn[pooled] = poisson.pool(shell, region, placement.seed, placement.count, placement.spacing, placement.sampler)
    pool = drawn[pooled]
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
    points = poisson.choose(pool, placement.count, placement.spacing)
    normal = pool.normal[points]
    return Samples(
        pos=pool.pos[points],
        normal=normal,
        tangent=_tangent(normal, reference_axes(normal)),
        radius=np.full(len(points), placement.radius),
        area=poisson.voronoi_areas(pool, points),
        cell=np.full((len(points), 2), -1),
    )


def _points(table: PointTable) -> Samples:
    """Return a table's points, without projection; unit and perpendicular vectors keep their bits."""
    normal = _kept_unit(table.normal)
    tangent = _tangent(normal, reference_axes(normal))
    rows = np.flatnonzero(~np.isnan(table.tangent[:, 0]))
    along = _kept_unit(table.tangent[rows])
    is_across = np.abs((along * normal[rows]).sum(axis=1)) <= ROUNDED
    tangent[rows] = np.where(is_across[:, None], along, _tangent(normal[rows], along))
    area = np.where(np.isnan(table.area), np.pi * table.radius**2, table.area)
    return Samples(table.pos, normal, tangent, table.radius, area, table.cell)


def _kept_unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    is_unit = np.abs((vectors**2).sum(axis=1) - 1.0) <= ROUNDED
    return np.where(is_unit[:, None], vectors, unit(vectors))


def _vector(vector: tuple[float, ...]) -> str:
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


REQUIRED = ("x", "y", "z", "nx", "ny", "nz")
TANGENT = ("tx", "ty", "tz")
CELL = ("row", "column")
OPTIONAL = ("radius", "area", *TANGENT, *CELL, "link")


@dataclass(frozen=True, eq=False)
class PointTable:
    """Points of a link as given, in its body's frame."""

    pos: Float[np.ndarray, "point 3"]  # position [m]
    normal: Float[np.ndarray, "point 3"]  # outward normal, of any length
    tangent: Float[np.ndarray, "point 3"]  # tangent, of any length and across the normal only roughly; NaN where none is given
    radius: Float[np.ndarray, " point"]  # sensing radius [m]
    area: Float[np.ndarray, " point"]  # surface that the point stands for [m²]; NaN where none is given
    cell: Int[np.ndarray, "point 2"]  # row and column in the link's grid; −1 where there is none


def point_table(placement: Points, folder: Path, link: str = "") -> PointTable:
    """Return the points of a link."""
    if isinstance(placement.points, str):
        placed = list(_read(folder, placement.points, link))
    else:
        placed = [(f"points[{i}]", _values(point)) for i, point in enumerate(placement.points)]
    for place, values in placed:
        _check(place, values, placement.radius)
    rows = [values for _, values in placed]
    table = PointTable(
        pos=_columns(rows, REQUIRED[:3]),
        normal=_columns(rows, REQUIRED[3:]),
        tangent=_columns(rows, TANGENT),
        radius=_columns(rows, ("radius",), placement.radius)[:, 0],
        area=_columns(rows, ("area",))[:, 0],
        cell=_columns(rows, CELL, -1.0).astype(np.int64),
    )
    _check_cells([place for place, _ in placed], table.cell)
    return table


def _columns(rows: Sequence[Mapping[str, float]], names: Sequence[str], default: float | None = None) -> np.ndarray:
    default = np.nan if default is None else default
    return np.array([[row.get(name, default) for name in names] for row in rows], dtype=np.float64)


def _values(point: Point) -> dict[str, float]:
    """Return a layout point's values, by the names of a file's columns."""
    values = dict(zip(REQUIRED, (*point.pos, *point.normal), strict=True))
    if point.tangent is not None:
        values |= dict(zip(TANGENT, point.tangent, strict=True))
    optional = {"radius": point.radius, "area": point.area, "row": point.row, "column": point.column}
    return values | {name: value for name, value in optional.items() if value is not None}


def _read(folder: Path, name: str, link: str) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield the place and the numbers of each of a link's rows of a CSV file; empty cells have none."""
    try:
        text = (folder / name).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise SampleError(f"cannot read the points of {name}: {reason}") from error
    reader = csv.DictReader(text.splitlines(), skipinitialspace=True)
    header = [column.strip() for column in reader.fieldnames or ()]
    reader.fieldnames = header
    _check_header(name, header)
    links: dict[str, None] = {}
    for row in reader:
        place = f"{name}:{reader.line_num}"
        if None in row:
            raise SampleError(f"{place}: more values than the header has columns")
        if "link" in header:
            owner = (row.pop("link") or "").strip()
            links[owner] = None
            if owner != link:
                continue
        values = {column: _number(place, column, text) for column, text in row.items() if (text or "").strip()}
        for column in REQUIRED:
            if column not in values:
                raise SampleError(f"{place}: {column} is empty, expected a number")
        yield place, values
    if "link" in header and link not in links:
        raise SampleError(f'{name} has no points of the link "{link}"', did_you_mean(link, links, "links"))
    if "link" not in header and reader.line_num <= 1:
        raise SampleError(f"{name} has no points")


def _check_header(name: str, header: Sequence[str]) -> None:
    """Raise a `SampleError` unless a file's columns are known and unique, and none is missing."""
    for i, column in enumerate(header):
        if column not in REQUIRED + OPTIONAL:
            raise SampleError(f'{name}:1: unknown column "{column}"', did_you_mean(column, REQUIRED + OPTIONAL))
        if column in header[:i]:
            raise SampleError(f'{name}:1: column "{column}" is there twice')
    missing = [column for column in REQUIRED if column not in header]
    if missing:
        raise SampleError(f"{name}:1: no column {', '.join(missing)}", f"expected the header {','.join(REQUIRED)}")


def _check(place: str, values: Mapping[str, float], radius: float | None) -> None:
    """Raise a `SampleError` unless a point has a radius and directions, and all of a tangent or a cell if any."""
    if values.get("radius", radius) is None:
        hint = "add a column `radius`, or give one `radius` for the whole file"
        raise SampleError(f"{place}: the point has no radius", hint)
    if not any(values[column] for column in REQUIRED[3:]):
        raise SampleError(f"{place}: normal [0, 0, 0] has no direction", "expected a vector of non-zero length")
    for whole in (TANGENT, CELL):
        present = [column for column in whole if column in values]
        if present and len(present) < len(whole):
            raise SampleError(f"{place}: {', '.join(present)} without the others of {', '.join(whole)}", "give all or none")
    if TANGENT[0] in values:
        normal, tangent = (np.array([values[column] for column in columns]) for columns in (REQUIRED[3:], TANGENT))
        normal, tangent = normal / np.abs(normal).max(), tangent / max(np.abs(tangent).max(), np.finfo(float).tiny)
        if np.linalg.norm(np.cross(normal, tangent)) < 1e-3:
            raise SampleError(f"{place}: the tangent is along the normal", "expected a direction across it")


def _check_cells(places: Sequence[str], cell: Int[np.ndarray, "point 2"]) -> None:
    """Raise a `SampleError` if two points have one cell."""
    first: dict[tuple[int, ...], str] = {}
    for place, (row, column) in zip(places, cell.tolist(), strict=True):
        if min(row, column) >= 0 and (other := first.setdefault((row, column), place)) != place:
            raise SampleError(f"{place}: row {row}, column {column} is used by {other} too", "one point for each cell")


def _number(place: str, column: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise SampleError(f'{place}: {column} is "{text.strip()}", expected a number')
    if (column == "radius" and value < 0) or (column == "area" and value <= 0):
        bound = "at least 0" if column == "radius" else "more than 0"
        raise SampleError(f"{place}: {column} {value:g} is out of range, expected {bound}")
    if column in CELL and (value != int(value) or not 0 <= value < MAX_COUNT):
        raise SampleError(f'{place}: {column} is "{text.strip()}", expected a whole number from 0 to {MAX_COUNT - 1}')
    return value

"""Points sampled on an object's outer surface, plain, or with lists of those within reach (`moments.PointCloud`).

Shapes: `n` points, `bin` cubes of a lattice, `slot` places of a list.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from tgdsl.errors import BakeError
from tgdsl.files import cache
from tgdsl.quantities.moments.fields import moments_key, spacing_of, surface_area
from tgdsl.surfaces.geom import SurfaceGeom
from tgdsl.surfaces.quadrature import outer_surface

SLACK = 1e-6
"""By how much lists reach farther than the radius, for the rounding of a float32 [m]."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of a surface, and for each cube of a lattice those within reach; index `n` of a list stands for none.

    Attributes:
        points: Places in the body's frame [m].
        weight: Surface that each stands for [m²].
        lists: Indices of points.
        num: Number of cubes along each axis.
        origin: Lower corner of the lattice [m].
        cell: Side of a cube [m].
    """

    points: Float[np.ndarray, "n 3"]
    weight: float
    lists: Int[np.ndarray, "bin slot"]
    num: tuple[int, int, int]
    origin: Float[np.ndarray, " 3"]
    cell: float


def sample_points(geoms: Sequence[SurfaceGeom], count: int) -> tuple[Float[np.ndarray, "n 3"], float]:
    """Return points drawn alike from all of an object's outer surface [m], always the same ones, and its whole area [m²].

    Points that are near each other mostly follow each other, so that those in contact are in few runs. Kept in the user's cache
    folder.

    Args:
        geoms: The geoms of one variant of an object, none of them a plane.
        count: Number of points.

    Raises:
        BakeError: A mesh has no face with an area.
    """

    def make() -> tuple[np.ndarray, float]:
        pieces = outer_surface(geoms, spacing_of(geoms))
        return pieces.random_by_side(count, seed=0).pos, surface_area(geoms)

    return cache.cached(
        moments_key(geoms, b"points side by side", spacing_of(geoms), count),
        make,
        lambda sampled: {"pos": sampled[0], "area": np.asarray(sampled[1])},
        lambda found: (found["pos"], float(found["area"])),
    )


def sample_cloud(
    geoms: Sequence[SurfaceGeom], radius: float, count: int, budget: int = 64 * 2**20, radius_noise: float = 0.0
) -> Cloud:
    """Return points drawn alike from all of an object's outer surface (the paper's backend), always the same ones.

    Kept in the user's cache folder. The cubes of the lattice are as small as the budget allows, half the radius at least: the
    smaller, the shorter the lists that are gone through.

    Args:
        geoms: The geoms of one variant of an object.
        radius: Largest sensing radius [m].
        count: Number of points.
        budget: Largest size of the lists [bytes].
        radius_noise: By how much probes may reach farther [m]; the points are the same with and without.

    Raises:
        BakeError: Nothing to sample, or no lists within the budget.
    """
    return cache.cached(
        moments_key(geoms, b"cloud", radius, count, budget, radius_noise),
        lambda: _sample(geoms, radius, count, budget, radius_noise),
        lambda cloud: {field.name: np.asarray(getattr(cloud, field.name)) for field in dataclasses.fields(cloud)},
        _unpacked_cloud,
    )


def _unpacked_cloud(found: Mapping[str, np.ndarray]) -> Cloud:
    x, y, z = found["num"].tolist()
    points, lists = found["points"], found["lists"]
    if len(lists) != x * y * z or not np.isfinite(points).all():
        raise ValueError("a damaged cloud")
    return Cloud(points, float(found["weight"]), lists, (x, y, z), found["origin"], float(found["cell"]))


def _sample(geoms: Sequence[SurfaceGeom], radius: float, count: int, budget: int, radius_noise: float) -> Cloud:
    pieces = outer_surface(geoms, radius / 4)
    if not len(pieces.area):
        raise BakeError("there is no surface to sample: planes are exact")
    points, weight = pieces.random(count, seed=0).pos, surface_area(geoms) / count
    needed, reach = 0, radius + radius_noise
    for share in (0.5, 1.0, 2.0):
        cell = share * radius
        low, high = points.min(axis=0) - reach, points.max(axis=0) + reach
        x, y, z = (int(num) for num in np.ceil((high - low) / cell))
        lists = _lists(points, low, (x, y, z), cell, reach + SLACK, budget)
        if isinstance(lists, np.ndarray):
            return Cloud(points, weight, lists, (x, y, z), low, cell)
        needed = lists
    raise BakeError(
        f"lists of {count} points within {1e3 * reach:g} mm need {needed / 2**20:.3g} MiB ({needed} bytes), and the budget is"
        f" {budget / 2**20:.3g} MiB ({budget} bytes); raise the budget, or take fewer points or a field"
    )


def _lists(
    points: Float[np.ndarray, "n 3"], origin: np.ndarray, num: tuple[int, int, int], cell: float, reach: float, budget: int
) -> np.ndarray | int:
    """Return for each cube the points within reach of any place in it; or the size of that [bytes] if it is over the budget."""
    from scipy.spatial import KDTree

    index = np.stack(np.unravel_index(np.arange(np.prod(num)), num), axis=1)
    middle = origin + cell * (index + 0.5)
    tree = KDTree(points)
    found = []
    for own in middle:
        near = np.sort(np.array(tree.query_ball_point(own, reach + cell * np.sqrt(0.75)), dtype=np.int64))
        gap = np.maximum(np.abs(points[near] - own) - cell / 2, 0)
        found.append(near[(gap**2).sum(axis=1) < reach**2])
        if 8 * len(middle) * len(found[-1]) > budget:
            return 8 * len(middle) * len(found[-1])
    lists = np.full((len(middle), max(1, max(map(len, found)))), len(points), dtype=np.int64)
    for row, near in zip(lists, found, strict=True):
        row[: len(near)] = near
    return lists

"""Moments of an object's outer surface, computed beforehand as fields on a lattice.

See `quantities.moment_sums` for what they are, `quadrature` for what the integrals are summed from. A field's nodes hold
f − h²/12 ∇²f rather than f, with second differences over the cell h: linear interpolation lies above what curves upwards by
h²/12 f'' on the mean, so that this takes the mean error away and leaves its spread (√(1/720) against √(1/120) of h² f''): a
cell may be half as large again. Where the gradient by place has a tolerance, nodes hold the factors of quadratic B-splines that
equal f there: the gradient then has no jumps, and its error is largest a radius away from faces, where f's second derivative
has one. Planes are exact and take no part.

Shapes: `n` points, `x`, `y`, `z` nodes along the axes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int

from tgdsl.errors import BakeError
from tgdsl.files import cache
from tgdsl.geometry.planes import split
from tgdsl.quantities.moment_sums import MomentField, field_moments
from tgdsl.surfaces.geom import SurfaceGeom
from tgdsl.surfaces.quadrature import Pieces, Quadrature, extent, outer_surface

FORMAT = b"tgdsl moments 2"
CHOICE_POINTS, REPORT_POINTS = 1024, 2048
HEADROOM = 0.95  # the choice keeps a margin to the tolerance, so the held-out points usually satisfy it too
FINER = 2.0  # how many times finer than the field's the quadrature is that it is measured against
GRADIENT_FINENESS = 24  # pieces along a radius where gradients have a tolerance; fewer where it is more than one over this
BRICK = 6  # nodes along the side of a brick that is computed at once
SPACING, PIECES = 1e-3, 200.0
"""Longest side of the pieces that an area is summed from and points are drawn from [m]; but no more along a large object."""


@dataclass(frozen=True)
class FieldErrors:
    """Errors at random points within the radius of the surface, which took no part in the choice of the lattice.

    All are fractions of full scale, the largest magnitude at these points.
    """

    mass_rms: float  # root mean square of the error of S0
    mass_max: float  # its largest
    first_rms: float  # root mean square of the length of the error of S1
    first_max: float  # its largest
    # 99.9th percentile of the error of S0's gradient by place, over the largest gradient; None: not measured, as the next two
    gradient_p999: float | None = None
    gradient_max: float | None = None  # its largest
    first_gradient_p999: float | None = None  # the same of S1, by Frobenius' norm


@dataclass(frozen=True, eq=False)
class BakedField:
    """Moments at the nodes of a lattice in the body's frame."""

    # S0 [m³], S1 [m⁴], and their derivatives with respect to R if asked for, or their splines' factors; float32
    values: Float[np.ndarray, "x y z channel"]
    origin: Float[np.ndarray, " 3"]  # place of node (0, 0, 0) [m]
    cell: float  # spacing of the nodes [m]
    errors: FieldErrors  # errors of the lattice


def spacing_of(geoms: Sequence[SurfaceGeom]) -> float:
    """Return the longest side of the pieces that an object's surface is cut into where no radius says how fine [m]."""
    return max(SPACING, float(np.ptp(extent(geoms), axis=0).max()) / PIECES)


def surface_area(geoms: Sequence[SurfaceGeom]) -> float:
    """Return the area of an object's outer surface, planes left out [m²]."""
    spacing = spacing_of(geoms)
    return cache.cached(
        moments_key(geoms, b"area", spacing),
        lambda: float(outer_surface(geoms, spacing).area.sum()),
        lambda area: {"area": np.asarray(area)},
        lambda found: float(found["area"]),
    )


def bake_field(
    geoms: Sequence[SurfaceGeom],
    radius: float,
    tolerance: float = 5e-3,
    gradient_tolerance: float | None = None,
    budget: int = 64 * 2**20,
    with_slope: bool = False,
) -> BakedField:
    """Return the coarsest lattice found that holds the moments of an object's outer surface to a tolerance.

    The tolerance bounds the root mean square of the errors of S0, and of S1 as a vector, over full scale, at random points
    within the radius of the surface, against a quadrature much finer than the field's. Kept in the user's cache folder.

    Args:
        geoms: The geoms of one variant of an object.
        radius: Sensing radius [m].
        tolerance: Largest error, in the sense above, as a fraction of full scale.
        gradient_tolerance: Largest error of 99.9 % of S0's gradients by place, as a fraction of the largest gradient; the field
            is of quadratic B-splines then. None: a trilinear field, whose gradients are as good as they come out.
        budget: Largest size of the values [bytes].
        with_slope: Whether to add the derivatives with respect to the radius; no tolerance holds for them.

    Raises:
        BakeError: Nothing to bake, or the tolerance needs more than the budget.
    """
    if not (0 < radius < np.inf and 0 < tolerance < 1):
        raise BakeError(
            f"a field of moments needs a radius above 0 and a tolerance between 0 and 1, found {radius}, {tolerance}"
        )
    return cache.cached_record(
        moments_key(geoms, b"field", radius, tolerance, gradient_tolerance or 0.0, budget, float(with_slope)),
        lambda: _bake(geoms, radius, Limits(tolerance, gradient_tolerance, budget), with_slope),
        BakedField,
    )


def moments_key(geoms: Sequence[SurfaceGeom], what: bytes, *limits: float | int) -> str:
    """Return the cache key of the moments of some geoms."""
    arrays = [np.array(limits, float)]
    for felt in geoms:
        arrays += [np.frombuffer(felt.shape.encode(), np.uint8), felt.geom.size, felt.geom.pos, felt.geom.rotation]
        arrays += [] if felt.surface is None else [felt.surface.vertices, felt.surface.faces]
    return cache.digest(FORMAT + what, arrays)


class Limits(NamedTuple):
    """What a field is to hold: see `bake_field`."""

    tolerance: float
    gradient_tolerance: float | None
    budget: int


class Truth(NamedTuple):
    """Points [m], the moments there, and their derivatives by place if they matter."""

    pos: Float[np.ndarray, "n 3"]
    moments: Float[np.ndarray, "n 4"]
    gradients: Float[np.ndarray, "n 4 3"] | None


def _bake(geoms: Sequence[SurfaceGeom], radius: float, limits: Limits, with_slope: bool) -> BakedField:
    tolerance, gradient_tolerance, budget = limits
    least = 4.0 if gradient_tolerance is None else float(np.clip(1 / gradient_tolerance, 4, GRADIENT_FINENESS))
    # The error of S1 is the quadrature's, about (0.25 / k)² for spacings R/k, plus the lattice's.
    spacing = radius / float(np.clip(0.55 / np.sqrt(tolerance), least, 24))
    channels = 8 if with_slope else 4
    # The error falls as the square of the cell or faster: about 0.4 (h/R)² on a coarse lattice, which gives the cell. The error
    # of S0's gradients falls as the cell: about 0.17 h/R.
    cell = radius * float(np.clip(2 * np.sqrt(tolerance / 0.4), 0.05, 0.5))
    cell = cell if gradient_tolerance is None else min(cell, radius * gradient_tolerance / 0.17)
    # Checked before any sum: the budget also bounds the number of pieces.
    needed = 4 * channels * int(np.prod(_lattice(extent(geoms), radius, cell)[1]))
    if needed > budget:
        raise BakeError(_too_large(radius, limits, needed))
    pieces, fine = outer_surface(geoms, spacing), outer_surface(geoms, spacing / FINER)
    if not len(pieces.area):
        raise BakeError("there is no surface to bake moments of: planes are exact")
    coarse, exact = pieces.quadrature(spacing), fine.quadrature(spacing / FINER)
    held_back = _around(fine, radius, REPORT_POINTS, seed=2), _around(fine, radius, CHOICE_POINTS, seed=1)
    with_gradients = gradient_tolerance is not None
    report, choice = (
        Truth(pos, moment_sums(exact, pos, radius, 4, block=1), gradient_sums(exact, pos, radius) if with_gradients else None)
        for pos in held_back
    )
    while True:
        origin, num = _lattice(coarse.pos, radius, cell)
        needed = 4 * channels * int(np.prod(num))
        if needed > budget:
            raise BakeError(_too_large(radius, limits, needed))
        nodes = _node_sums(coarse, origin, num, cell, radius, channels)
        values = (_fitted if gradient_tolerance is None else _splines)(nodes).astype(np.float32)
        errors = _errors(values, origin, cell, choice)
        worst = max(errors.mass_rms, errors.first_rms) / (HEADROOM * tolerance)
        steep = 0.0 if gradient_tolerance is None else (errors.gradient_p999 or 0.0) / (HEADROOM * gradient_tolerance)
        if max(worst, steep) <= 1:
            return BakedField(values, origin, cell, _errors(values, origin, cell, report))
        cell /= float(np.clip(max(np.sqrt(worst), steep), 1.05, 2.5))


def _too_large(radius: float, limits: Limits, needed: int) -> str:
    """Return the message for limits that need so many bytes."""
    gradients = "" if limits.gradient_tolerance is None else f", and of {limits.gradient_tolerance:g} of its gradients,"
    return (
        f"a field of moments of a tolerance of {limits.tolerance:g}{gradients} at a radius of {1e3 * radius:g} mm needs about"
        f" {needed / 2**20:.3g} MiB ({needed} bytes), and the budget is {limits.budget / 2**20:.3g} MiB"
        f" ({limits.budget} bytes); raise the tolerance or the budget, or sum over points"
    )


def gradient_sums(surface: Quadrature, pos: Float[np.ndarray, "n 3"], radius: float) -> Float[np.ndarray, "n 4 3"]:
    """Return the derivatives of S0 and S1 by place at points, summed over points of a surface.

    With u the unit vector from q to p and r = |p − q| < R: ∇S0 = ∫ u dA [m²], ∇S1 = ∫ (r u uᵀ − (R − r) 1) dA [m³].
    """
    result = np.zeros((len(pos), 4, 3))
    for row, near, q in zip(result, surface.tree.query_ball_point(pos, radius), pos, strict=True):
        way, area = surface.pos[near] - q, surface.area[near]
        r = np.linalg.norm(way, axis=1)
        unit = way / np.maximum(r, 1e-12)[:, None]
        row[0] = area @ unit
        row[1:] = (area[:, None] * way).T @ unit - (area @ (radius - r)) * np.eye(3)
    return result


def _around(pieces: Pieces, radius: float, count: int, seed: int) -> Float[np.ndarray, "n 3"]:
    """Return points of balls around uniformly random points of a surface [m]."""
    rng = np.random.default_rng(seed)
    way = rng.normal(size=(count, 3))
    way *= radius * np.cbrt(rng.uniform(size=(count, 1))) / np.linalg.norm(way, axis=1, keepdims=True)
    return pieces.random(count, seed) + way


def _lattice(pos: Float[np.ndarray, "m 3"], radius: float, cell: float) -> tuple[np.ndarray, tuple[int, int, int]]:
    low, high = pos.min(axis=0) - radius, pos.max(axis=0) + radius
    x, y, z = (int(num) + 5 for num in np.ceil((high - low) / cell))
    return (low + high) / 2 - cell * np.array([x - 1, y - 1, z - 1]) / 2, (x, y, z)


def moment_sums(
    surface: Quadrature, pos: Float[np.ndarray, "n 3"], radius: float, channels: int, block: int
) -> Float[np.ndarray, "n channel"]:
    """Return S0 [m³] and S1 [m⁴] at points, and their derivatives with respect to the radius: sums over points of a surface.

    Args:
        surface: Points with their areas.
        pos: Where; so many as make a block should be neighbours [m].
        radius: Sensing radius [m].
        channels: 4, or 8 with the derivatives.
        block: How many are computed at once.
    """
    result = np.zeros((len(pos), channels))
    for start in range(0, len(pos), block):
        block_pos = pos[start : start + block]
        middle = (block_pos.min(axis=0) + block_pos.max(axis=0)) / 2
        reach = radius + np.linalg.norm(block_pos - middle, axis=1).max()
        near = np.array(surface.tree.query_ball_point(middle, reach), dtype=np.int64)
        if not len(near):
            continue
        # Relative to the middle, to keep the digits of small squared distances.
        points, here = torch.from_numpy(surface.pos[near] - middle), torch.from_numpy(block_pos - middle)
        weight = torch.relu(radius - torch.cdist(here, points))
        area = torch.from_numpy(surface.area[near])[:, None]
        parts = torch.cat([area, area * points], dim=1).T.contiguous()
        for first in range(0, channels, 4):
            sums = torch.nn.functional.linear(weight if first == 0 else (weight > 0).double(), parts)
            sums[:, 1:] -= sums[:, :1] * here
            result[start : start + block, first : first + 4] = sums.numpy()
    return result


def _node_sums(
    surface: Quadrature, origin: Float[np.ndarray, " 3"], num: tuple[int, int, int], cell: float, radius: float, channels: int
) -> Float[np.ndarray, "x y z channel"]:
    """Return moments at the nodes of a lattice, brick by brick."""
    index = np.stack(np.unravel_index(np.arange(int(np.prod(num))), num), axis=1)
    values = np.zeros((len(index), channels))
    bricks = np.asarray(np.ravel_multi_index(tuple((index // BRICK).T), tuple(n // BRICK + 1 for n in num)))
    order = np.argsort(bricks, kind="stable")
    for nodes in np.split(order, 1 + np.flatnonzero(np.diff(bricks[order]))):
        values[nodes] = moment_sums(surface, origin + cell * index[nodes], radius, channels, len(nodes))
    return values.reshape(*num, channels)


def _fitted(values: Float[np.ndarray, "x y z channel"]) -> Float[np.ndarray, "x y z channel"]:
    """Return the node values whose linear interpolation has no mean error: f − h²/12 ∇²f."""
    fitted = values.copy()
    for axis in range(3):
        along = np.moveaxis(values, axis, 0)
        np.moveaxis(fitted, axis, 0)[1:-1] -= (along[2:] - 2 * along[1:-1] + along[:-2]) / 12
    return fitted


def _splines(values: Float[np.ndarray, "x y z channel"]) -> Float[np.ndarray, "x y z channel"]:
    """Return the factors of the quadratic B-splines whose sum equals the values at the nodes; zero in the two outer layers."""
    from scipy.ndimage import spline_filter

    result = np.zeros_like(values)
    within = (slice(2, -2),) * 3
    for channel in range(values.shape[3]):
        result[within + (channel,)] = spline_filter(values[..., channel], order=2)[within]
    return result


def _errors(
    values: Float[np.ndarray, "x y z channel"], origin: Float[np.ndarray, " 3"], cell: float, true: Truth
) -> FieldErrors:
    x, y, z, channels = values.shape
    place, side = split(torch.from_numpy(origin)), torch.tensor(cell, dtype=torch.float64)
    flat = torch.from_numpy(values.reshape(-1, channels))
    field = MomentField(flat, 0, (x, y, z), place, side, is_smooth=true.gradients is not None)
    pos = torch.from_numpy(true.pos).requires_grad_()
    mass, first = field_moments(split(pos), field)
    estimate = torch.stack([mass, *first], dim=1)
    mass_error, first_error = (
        np.linalg.norm(error, axis=1) / np.linalg.norm(scale, axis=1).max()
        for error, scale in _halves(estimate.detach().numpy() - true.moments, true.moments)
    )
    rms = [float(np.sqrt(np.mean(error**2))) for error in (mass_error, first_error)]
    errors = FieldErrors(rms[0], float(mass_error.max()), rms[1], float(first_error.max()))
    if true.gradients is None:
        return errors
    slopes = [torch.autograd.grad(estimate[:, c].sum(), pos, retain_graph=True)[0].numpy() for c in range(4)]
    error = np.stack(slopes, axis=1) - true.gradients
    of_mass, of_first = (
        np.linalg.norm(part, axis=(1, 2)) / np.linalg.norm(all_of, axis=(1, 2)).max()
        for part, all_of in _halves(error, true.gradients)
    )
    p999, first_p999 = (float(np.quantile(part, 0.999)) for part in (of_mass, of_first))
    return dataclasses.replace(errors, gradient_p999=p999, gradient_max=float(of_mass.max()), first_gradient_p999=first_p999)


def _halves(*both: np.ndarray) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    return tuple(part[:, :1] for part in both), tuple(part[:, 1:4] for part in both)


SLACK = 1e-6  # by how much lists reach farther than the radius, for the rounding of a float32 [m]


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of a surface, and for each cube of a lattice those within reach; index `n` of a list stands for none."""

    points: Float[np.ndarray, "n 3"]  # places in the body's frame [m]
    weight: float  # surface that each stands for [m²]
    lists: Int[np.ndarray, "bin slot"]  # indices of points
    num: tuple[int, int, int]  # number of cubes along each axis
    origin: Float[np.ndarray, " 3"]  # lower corner of the lattice [m]
    cell: float  # side of a cube [m]


def sample_points(geoms: Sequence[SurfaceGeom], count: int) -> tuple[Float[np.ndarray, "n 3"], float]:
    """Return seeded points, uniform on an object's outer surface [m], and its area [m²].

    Near points are mostly consecutive, so the points in contact form few runs. The result is saved in the user's cache folder.
    None of the geoms is a plane.
    """

    def make() -> tuple[np.ndarray, float]:
        pieces = outer_surface(geoms, spacing_of(geoms))
        return pieces.random_by_side(count, seed=0), surface_area(geoms)

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

    Kept in the cache folder. The cubes of the lattice are as small as the budget [bytes] allows, half the largest sensing
    radius [m] at least: the smaller, the shorter the lists. `radius_noise` is by how much probes may reach
    farther [m]; the points are the same with and without.
    """
    key = moments_key(geoms, b"cloud", radius, count, budget, radius_noise)
    return cache.cached_record(key, lambda: _sample(geoms, radius, count, budget, radius_noise), Cloud)


def _sample(geoms: Sequence[SurfaceGeom], radius: float, count: int, budget: int, radius_noise: float) -> Cloud:
    pieces = outer_surface(geoms, radius / 4)
    if not len(pieces.area):
        raise BakeError("there is no surface to sample: planes are exact")
    points, weight = pieces.random(count, seed=0), surface_area(geoms) / count
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
    results = []
    for center in middle:
        near = np.sort(np.array(tree.query_ball_point(center, reach + cell * np.sqrt(0.75)), dtype=np.int64))
        gap = np.maximum(np.abs(points[near] - center) - cell / 2, 0)
        results.append(near[(gap**2).sum(axis=1) < reach**2])
        if 8 * len(middle) * len(results[-1]) > budget:
            return 8 * len(middle) * len(results[-1])
    lists = np.full((len(middle), max(1, max(map(len, results)))), len(points), dtype=np.int64)
    for row, near in zip(lists, results, strict=True):
        row[: len(near)] = near
    return lists

"""Signed distance of a triangle surface, sampled on a grid that is as coarse as the asked tolerance allows.

Distances are libigl's (exact, by a tree of boxes: `AABB`), to the outer surface (`surfaces.outer`). `igl.signed_distance`
itself scales the distance by the winding number, whose rounding costs it 12 µm on a 4 cm cube.

Shapes: `n` points, `v` vertices, `f` faces, `x`, `y`, `z` nodes along the axes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from tgdsl.errors import BakeError
from tgdsl.files import cache
from tgdsl.geometry.grid import METHODS, one_grid
from tgdsl.surfaces.solid import Lattice, Solid
from tgdsl.surfaces.surface import Surface

FORMAT = b"tgdsl grid 4"
CHOICE_POINTS, REPORT_POINTS = 4096, 16384
HEADROOM, CHOICE_PERCENTILE = 0.95, 99.3
"""The choice holds the tolerance with something to spare, nearly two standard deviations of a percentile of so few points, so
that as a rule the 99th percentile of the held-back points holds it too."""
EDGE_FACTOR = 5.0
"""How many times the tolerance the 99th percentile of the error near sharp edges may be."""
COARSEST = 16
"""Cells along the longest side of the first grid that is tried."""


@dataclass(frozen=True)
class Errors:
    """Errors at random points of the band, none of which took part in the choice of the grid.

    Points nearer to a sharp edge than one cell are counted apart: there no grid does better than O(cell).

    Attributes:
        count: Points away from sharp edges; the tolerance holds for their `p99`.
        p99: 99th percentile of the distance error [m].
        max: Largest distance error [m].
        rms: Root mean square of the distance error [m].
        angle_p99: 99th percentile of the angle between the gradient and the true one [rad].
        edge_count: Points near sharp edges.
        edge_p99: 99th percentile of their distance error [m]; 0 if there are none, as the next.
        edge_max: Largest distance error among them [m].
    """

    count: int
    p99: float
    max: float
    rms: float
    angle_p99: float
    edge_count: int
    edge_p99: float
    edge_max: float


@dataclass(frozen=True, eq=False)
class Baked:
    """A grid of signed distances in the surface's frame.

    Attributes:
        values: Signed distance at the nodes [m], negative inside.
        origin: Place of node (0, 0, 0) [m].
        cell: Spacing of the nodes [m].
        method: Name of the function of `tgdsl.geometry.grid` that interpolates: trilinear or tricubic.
        errors: What the grid costs in accuracy.
        flaws: What of the surface its user should know: see `Outer`.
    """

    values: Float[np.ndarray, "x y z"]
    origin: Float[np.ndarray, " 3"]
    cell: float
    method: str
    errors: Errors
    flaws: tuple[str, ...]


def bake(surface: Surface, margin: float, tolerance: float = 5e-5, budget: int = 64 * 2**20) -> Baked:
    """Return the coarsest grid found that holds a surface's signed distance to a tolerance.

    The tolerance bounds the 99th percentile of the error at random points of the band |distance| ≤ margin, denser near the
    surface. An edge is sharp where its faces' normals differ by more than 30°, or where it does not join two faces: points
    nearer to one than a cell are reported apart and held to five times the tolerance (their error is a fraction of a cell).
    At each cell size the cheaper trilinear lookup is tried first. Results are kept in the user's cache folder.

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

    def make() -> Baked:
        return _bake(Solid(surface), margin, tolerance, budget)

    return cache.cached(cache.digest(FORMAT, arrays), make, _packed, _unpacked)


def _packed(baked: Baked) -> dict[str, np.ndarray]:
    fields = {
        field.name: np.asarray(getattr(baked, field.name)) for field in dataclasses.fields(baked) if field.name != "errors"
    }
    return fields | {"errors": np.array(dataclasses.astuple(baked.errors), float)}


def _unpacked(found: Mapping[str, np.ndarray]) -> Baked:
    count, *errors = found["errors"].tolist()
    errors[4] = int(errors[4])
    values, method = found["values"], str(found["method"])
    if values.dtype != np.float32 or not np.isfinite(values).all() or method not in METHODS:
        raise ValueError("a damaged grid")
    report, cell = Errors(int(count), *errors), float(found["cell"])
    return Baked(values, found["origin"], cell, method, report, tuple(found["flaws"].tolist()))


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
        p99=_percentile(away, percentile),
        max=float(away.max(initial=0)),
        rms=float(np.sqrt(np.mean(away**2))) if len(away) else 0.0,
        angle_p99=_percentile(angle, percentile),
        edge_count=len(near),
        edge_p99=_percentile(near, percentile),
        edge_max=float(near.max(initial=0)),
    )


def _percentile(values: np.ndarray, percentile: float) -> float:
    return float(np.percentile(values, percentile)) if len(values) else 0.0

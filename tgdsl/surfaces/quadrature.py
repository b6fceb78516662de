"""The outer surface of an object as triangles, and as points with area weights for integrals over it.

Geoms become triangles, bisected to a spacing; a primitive's triangles add up to its area in closed form. Surface inside another
geom of the object does not count, nor does a face that two geoms share from opposite sides; of faces shared from the same side
the first counts. Triangles that another geom's surface crosses are bisected further. Only random points depend on a seed.

Shapes: `n` points, `f` triangles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from tgdsl.geometry.planes import vec
from tgdsl.geometry.shapes import SHAPES
from tgdsl.surfaces.bulk import primitive_area
from tgdsl.surfaces.geom import SurfaceGeom
from tgdsl.surfaces.solid import Solid
from tgdsl.surfaces.surface import face_areas, face_cross

SECTIONS = 128  # least number of sides of the polygon for a circle, before its points are moved onto the true surface
CUT = 16.0  # the spacing over the size of triangles that another geom's surface cuts
STEP = 1e-7  # offset of points to either side of the surface, to test whether they are inside [m]

Distance = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Quadrature:
    """Points that represent a surface."""

    pos: Float[np.ndarray, "n 3"]  # places in the body's frame [m]
    area: Float[np.ndarray, " n"]  # surface that each stands for [m²]

    @cached_property
    def tree(self) -> KDTree:
        """The points, to look for near ones."""
        return KDTree(self.pos)


@dataclass(frozen=True, eq=False)
class Pieces:
    """Small triangles of an outer surface."""

    corners: Float[np.ndarray, "f 3 3"]  # their corners in the body's frame [m]; a primitive's triangles are chords
    pos: Float[np.ndarray, "f 3"]  # the point of the true surface at the middle of each [m]
    normal: Float[np.ndarray, "f 3"]  # unit normal out of the object there
    area: Float[np.ndarray, " f"]  # surface that each stands for [m²]

    def quadrature(self, spacing: float) -> Quadrature:
        """Return one point for all pieces in a cube of half the spacing [m]."""
        cube = np.floor((self.pos - self.pos.min(axis=0)) / (0.5 * spacing)).astype(np.int64)
        num = cube.max(axis=0) + 1
        _, which = np.unique(np.ravel_multi_index(tuple(cube.T), tuple(num)), return_inverse=True)
        area = np.bincount(which, self.area)
        pos = np.stack([np.bincount(which, self.area * part) for part in self.pos.T], axis=1)
        return Quadrature(pos / area[:, None], area)

    def random(self, count: int, seed: int) -> Float[np.ndarray, "n 3"]:
        """Return points drawn uniformly from the surface [m]."""
        return self._drawn(count, seed)[0]

    def random_by_side(self, count: int, seed: int) -> Float[np.ndarray, "n 3"]:
        """Return the points of `random`, ordered so that successive points are mostly near: side by side, each along a curve.

        A side is the surface whose normals are closest to one of the six axis directions; its points follow a Morton curve.
        """
        pos, piece = self._drawn(count, seed)
        normal = self.normal[piece]
        axis = np.abs(normal).argmax(axis=1)
        faces_up = normal[np.arange(count), axis] > 0
        return pos[np.lexsort((_morton(pos), faces_up, axis))]

    def _drawn(self, count: int, seed: int) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
        """Return random points, and the piece that each is from."""
        rng = np.random.default_rng(seed)
        piece = rng.choice(len(self.area), count, p=self.area / self.area.sum())
        weight = rng.dirichlet((1.0, 1.0, 1.0), count)
        off = self.pos[piece] - self.corners[piece].mean(axis=1)
        return (weight[:, :, None] * self.corners[piece]).sum(axis=1) + off, piece


def outer_surface(geoms: Sequence[SurfaceGeom], spacing: float) -> Pieces:
    """Return the outer surface of an object's geoms, planes left out, in pieces not longer than a spacing [m].

    Raises:
        BakeError: If a mesh has no face with an area.
    """
    solids = [_Geom.of(felt, spacing) for felt in geoms if felt.shape != "plane"]
    parts = [tuple(np.zeros((0, *rest)) for rest in ((3, 3), (3,), (3,), ()))]
    parts += [_outer(i, solids, spacing) for i in range(len(solids))]
    return Pieces(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def extent(geoms: Sequence[SurfaceGeom]) -> Float[np.ndarray, "2 3"]:
    """Return the least and the largest coordinates of an object's geoms in the body's frame, planes left out [m]."""
    corners = [np.zeros((0, 3))]
    for felt in (felt for felt in geoms if felt.shape != "plane"):
        geom = felt.geom
        local = _triangles(felt.shape, geom.size, np.inf) if felt.surface is None else felt.surface.vertices
        corners.append(local.reshape(-1, 3) @ geom.rotation.T + geom.pos)
    points = np.concatenate(corners)
    return np.array([points.min(axis=0), points.max(axis=0)]) if len(points) else np.zeros((2, 3))


@dataclass(frozen=True, eq=False)
class _Geom:
    """A geom's triangles, signed distance and its gradient, all in the body's frame."""

    corners: Float[np.ndarray, "f 3 3"]
    distance: Distance
    is_mesh: bool
    stretch: float
    """Area of the true surface over the triangles' area."""

    @staticmethod
    def of(felt: SurfaceGeom, spacing: float) -> _Geom:
        geom = felt.geom
        solid = None if felt.surface is None else Solid(felt.surface)
        corners = _triangles(felt.shape, geom.size, spacing) if solid is None else solid.corners

        def distance(pos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            local = (pos - geom.pos) @ geom.rotation
            if solid is not None:
                value, gradient = solid.distance(local)
            else:
                x, y, z = torch.from_numpy(np.ascontiguousarray(local.T))
                planes = SHAPES[felt.shape]((x, y, z), vec(torch.from_numpy(np.asarray(geom.size, float)).unbind()))
                value, gradient = planes[0].numpy(), torch.stack(planes[1], dim=1).numpy()
            return value, gradient @ geom.rotation.T

        stretch = 1.0 if solid is not None else primitive_area(felt.shape, geom.size) / face_areas(corners).sum()
        return _Geom(corners @ geom.rotation.T + geom.pos, distance, solid is not None, stretch)

    def on_surface(self, corners: Float[np.ndarray, "f 3 3"]) -> tuple[np.ndarray, np.ndarray]:
        """Return the points of the true surface at the triangles' centres, and the outward unit normals there."""
        middle = corners.mean(axis=1)
        if not self.is_mesh:
            value, gradient = self.distance(middle)
            return middle - value[:, None] * gradient, gradient
        normal = face_cross(corners)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        is_inverted = self.distance(middle + STEP * normal)[0] < 0
        return middle, np.where(is_inverted[:, None], -normal, normal)


def _outer(i: int, solids: Sequence[_Geom], spacing: float) -> tuple[np.ndarray, ...]:
    """Return corners, places, normals and areas of the pieces of one geom that are outside all other geoms."""
    geom, rest = solids[i], [(j < i, other) for j, other in enumerate(solids) if j != i]
    corners, pieces = geom.corners, []
    while len(corners):
        pos, normal = geom.on_surface(corners)
        side = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
        is_out, is_cut = np.ones(len(corners), bool), np.zeros(len(corners), bool)
        for is_earlier, other in rest:
            value = other.distance(pos)[0]
            is_out &= value > -side
            near = np.flatnonzero((np.abs(value) <= side) & (side <= spacing))
            hidden = _hidden(geom, other, is_earlier, corners[near])
            is_cut[near] |= hidden.any(axis=0) & ~hidden.all(axis=0) & (side[near] > spacing / CUT)
            is_out[near] &= ~hidden[0] | is_cut[near]
        is_split = is_out & ((side > spacing) | is_cut)
        is_done = is_out & ~is_split
        done = corners[is_done]
        pieces.append((done, pos[is_done], normal[is_done], geom.stretch * face_areas(done)))
        corners = _bisected(corners[is_split])
    return tuple(np.concatenate(part) for part in zip(*pieces, strict=True))


def _hidden(geom: _Geom, other: _Geom, is_earlier: bool, corners: Float[np.ndarray, "f 3 3"]) -> Bool[np.ndarray, "4 f"]:
    """Return whether another geom hides the surface at the triangles' centres and just within their corners."""
    middle = corners.mean(axis=1)
    results = []
    for k in range(4):
        pulled = corners if k == 0 else corners + 0.98 * (corners[:, k - 1] - middle)[:, None]
        pos, normal = geom.on_surface(pulled)
        hidden = other.distance(pos + STEP * normal)[0] < 0
        results.append(hidden | (other.distance(pos - STEP * normal)[0] < 0) if is_earlier else hidden)
    return np.array(results)


def _bisected(corners: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "g 3 3"]:
    """Return the two halves of each triangle by longest-edge bisection."""
    length = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
    turn = (length.argmax(axis=1)[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(corners, turn[:, :, None], axis=1).swapaxes(0, 1)
    middle = (a + b) / 2
    return np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])


def _morton(pos: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Return the points' positions on a Morton curve through 1024³ cubes: the interleaved bits of their three indices."""
    low = pos.min(axis=0)
    size = max(float((pos - low).max()), 1e-30)
    cube = (1023 / size * (pos - low)).astype(np.int64)
    bit = np.arange(10)
    return ((cube[:, :, None] >> bit & 1) << (3 * bit + np.arange(3)[:, None])).sum(axis=(1, 2))


def _triangles(shape: str, size: Float[np.ndarray, " 3"], spacing: float) -> Float[np.ndarray, "f 3 3"]:
    """Return triangles of a primitive in its own frame."""
    if shape == "box":
        return np.concatenate([_box_face(size, axis, sign) for axis in range(3) for sign in (-1.0, 1.0)])
    radius = float(size.max() if shape == "ellipsoid" else size[0])
    half = float(size[1]) if shape in ("capsule", "cylinder") else 0.0
    sections = max(SECTIONS, int(np.ceil(2 * np.pi * radius / spacing)))
    # The chord polygon has the circle's length, so that the triangles have the surface's area.
    swell = (np.pi / sections) / np.sin(np.pi / sections)
    wall = np.linspace(-half, half, max(1, int(np.ceil(2 * half / spacing))) + 1)
    if shape == "cylinder":
        radii = radius * np.linspace(0, 1, max(1, int(np.ceil(radius / spacing))) + 1)[:-1]
        profile = [*((r, -half) for r in radii), *((radius, z) for z in wall), *((r, half) for r in radii[::-1])]
        return _revolved(np.array(profile), sections, swell)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 2 * (sections // 4) + 1)
    ball = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if shape != "capsule":
        return _revolved(ball, sections, swell) * (size if shape == "ellipsoid" else radius)
    lower, upper = radius * ball[: len(ball) // 2 + 1], radius * ball[len(ball) // 2 :]
    straight = np.stack([np.full(len(wall) - 2, radius), wall[1:-1]], axis=1)
    return _revolved(np.concatenate([lower - [0, half], straight, upper + [0, half]]), sections, swell)


def _box_face(size: np.ndarray, axis: int, sign: float) -> np.ndarray:
    a, b = np.eye(3)[[(axis + 1) % 3, (axis + 2) % 3]] * size
    middle = sign * np.eye(3)[axis] * size
    p, q, r, s = middle - a - b, middle + a - b, middle + a + b, middle - a + b
    return np.array([[p, q, r], [p, r, s]])


def _revolved(profile: Float[np.ndarray, "k 2"], sections: int, swell: float) -> Float[np.ndarray, "f 3 3"]:
    """Return the surface that a line of points (distance from the axis, height) sweeps about z."""
    angle = 2 * np.pi * np.arange(sections + 1) / sections
    ring = swell * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = np.concatenate(
        [profile[:, None, :1] * ring, np.broadcast_to(profile[:, None, 1:], (len(profile), sections + 1, 1))], axis=2
    )
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    both = np.concatenate([np.stack(part, axis=2).reshape(-1, 3, 3) for part in ((a, b, c), (a, c, d))])
    area = np.linalg.norm(face_cross(both), axis=1)
    return both[area > 1e-12 * area.max()]

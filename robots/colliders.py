"""Fit capsules, boxes and spheres to the surfaces of a hand's links: a second set of colliders, `collision: primitive`.

Each link starts from primitives of a table; their numbers then minimise the fourth power of the distance between the link's
surface and the union of the primitives' (Levenberg–Marquardt on its square), most where objects touch the link: on
the inner sides and the tips. What is written (`colliders_file.py`) is checked anew by `deviations`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import igl
import numpy as np
import torch
import trimesh
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tgdsl.geometry.shapes import SHAPES
from tgdsl.plan.scene import Collider
from tgdsl.surfaces.convex import hull_planes
from tgdsl.surfaces.surface import Surface

MM = 1e-3
TOUCHED_SCALE, REST_SCALE = 0.5, 3.0
"""Distances that count alike where objects touch the link and elsewhere [mm]."""
CONE = 60.0
"""Largest angle between a surface's normal and a direction that objects come from [deg]."""
NUM_SAMPLES = 1500
MOST_STEPS = 40
OUTSIDE = 0.05 * MM
"""A point so far above a mesh that is inside of another one is on no outer surface [m]."""
STRAY, STRAY_TURN = 8.0, 30.0
"""How far the fit may move a primitive's numbers from the table's [mm], [deg]."""
CACHED = 64
"""Primitives, with what was found of them, that the fit remembers."""
_LINE = np.linspace(-1, 1, 9)
EDGES = np.unique(
    np.concatenate([np.roll([[t, a, b] for t in _LINE for a in (-1, 1) for b in (-1, 1)], k, axis=1) for k in range(3)]), axis=0
)
"""Points of the edges of a box of half-extents 1."""


@dataclass(frozen=True)
class Primitive:
    """A primitive in a link's frame, in millimetres and degrees, as the fit starts from it.

    Attributes:
        shape: `capsule`, `sphere` or `box`.
        at: A capsule's first end, else the centre.
        size: A capsule's or sphere's radius; a box's half-extents.
        to: A capsule's other end.
        turn: A box's rotation vector [deg].
        is_pair: Whether there is a second one, mirrored at the link's plane of symmetry.
        is_core: Whether other links meet it too: it is then the link to them.
    """

    shape: str
    at: tuple[float, float, float]
    size: tuple[float, ...]
    to: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    is_pair: bool = False
    is_core: bool = False


@dataclass(frozen=True)
class Link:
    """How a link's primitives are fitted.

    Attributes:
        primitives: What the fit starts from.
        touched: Directions that objects come from, in the link's frame; none: it is not touched.
        region: Lower and upper corner of what is touched [mm].
        lateral: Axis that the link is symmetric along, as an index; None: it is not.
        middle: Where its plane of symmetry is on that axis [mm].
        count: Points of its surface that are fitted.
        is_hollow: Whether its surface, and not only its convex hull, bounds the boxes' edges.
    """

    primitives: tuple[Primitive, ...]
    touched: tuple[tuple[float, float, float], ...] = ()
    region: tuple[tuple[float, float, float], tuple[float, float, float]] = ((-1e3,) * 3, (1e3,) * 3)  # type: ignore
    lateral: int | None = None
    middle: float = 0.0
    count: int = NUM_SAMPLES
    is_hollow: bool = False


@dataclass(frozen=True, eq=False)
class Samples:
    """Points of a link's surface [m], and whether objects touch it there."""

    pos: np.ndarray
    is_touched: np.ndarray


# ---- the surface


def samples(surface: Surface, link: Link, count: int, seed: int = 0) -> Samples:
    """Return points spread over a link's surface, the same ones every time; of several meshes on the outside of their union."""
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    pos, face, *_ = trimesh.sample.sample_surface(mesh, count, seed=seed)
    pos, normal = np.asarray(pos), surface.face_normals[face]
    outer = np.asarray(igl.fast_winding_number(surface.vertices, surface.faces, pos + OUTSIDE * normal)) < 0.5
    return Samples(pos[outer], touched(pos[outer], normal[outer], link))


def _hull_planes(surface: Surface) -> np.ndarray:
    hull = trimesh.convex.convex_hull(surface.vertices)
    count = len(hull.faces)
    return hull_planes(Surface(np.asarray(hull.vertices), np.asarray(hull.faces), np.zeros(count, dtype=np.int64), ()))


def touched(pos: np.ndarray, normal: np.ndarray, link: Link) -> np.ndarray:
    """Return whether points with normals are where objects touch a link."""
    low, high = (MM * np.array(corner) for corner in link.region)
    is_inside = ((pos >= low) & (pos <= high)).all(axis=1)
    facing = np.zeros(len(pos), dtype=bool)
    for direction in link.touched:
        unit = np.array(direction) / np.linalg.norm(direction)
        facing |= normal @ unit >= np.cos(np.radians(CONE))
    return is_inside & facing


# ---- primitives as numbers


def _flip(link: Link, is_mirrored: bool) -> np.ndarray:
    signs = np.ones(3)
    if is_mirrored and link.lateral is not None:
        signs[link.lateral] = -1.0
    return signs


def _numbers(primitive: Primitive) -> np.ndarray:
    """Return a primitive's numbers: at, to or turn, size [mm, deg]."""
    second = primitive.to if primitive.shape == "capsule" else primitive.turn if primitive.shape == "box" else ()
    return np.array([*primitive.at, *second, *primitive.size], dtype=np.float64)


def _bound(primitive: Primitive, sign: int) -> np.ndarray:
    """Return the least or greatest values of a primitive's numbers [mm, deg]: sizes stay above 1 mm."""
    numbers = _numbers(primitive)
    steps = np.full(len(numbers), STRAY)
    if primitive.shape == "box":
        steps[3:6] = STRAY_TURN
    found = numbers + sign * steps
    found[-len(primitive.size) :] = np.maximum(found[-len(primitive.size) :], 1.0)
    return found


def _is_free(primitive: Primitive, link: Link) -> np.ndarray:
    """Return which of a primitive's numbers the fit may change: one on the plane of symmetry stays there."""
    free = np.ones(len(_numbers(primitive)), dtype=bool)
    if link.lateral is not None and not primitive.is_pair:
        free[link.lateral] = False
        if primitive.shape == "capsule":
            free[3 + link.lateral] = False
        elif primitive.shape == "box":
            free[[3 + i for i in range(3) if i != link.lateral]] = False
    return free


def _placed(primitive: Primitive, numbers: np.ndarray, link: Link, is_mirrored: bool = False) -> Collider:
    """Return a primitive with some numbers as MuJoCo has it."""
    flip, middle = _flip(link, is_mirrored), np.zeros(3)
    if link.lateral is not None:
        middle[link.lateral] = link.middle
    at = (middle + (numbers[:3] - middle) * flip) * MM
    if primitive.shape == "capsule":
        to = (middle + (numbers[3:6] - middle) * flip) * MM
        axis = to - at
        length = float(np.linalg.norm(axis))
        turn = Rotation.align_vectors([axis / length], [[0.0, 0.0, 1.0]])[0] if length > 1e-9 else Rotation.identity()
        size, pos = (numbers[6] * MM, 0.5 * length), 0.5 * (at + to)
    elif primitive.shape == "box":
        vector = numbers[3:6] * flip * np.prod(flip)  # a rotation vector is a pseudovector
        turn, size, pos = Rotation.from_rotvec(vector, degrees=True), tuple(numbers[6:9] * MM), at
    else:
        turn, size, pos = Rotation.identity(), (numbers[3] * MM,), at
    quat = turn.as_quat(scalar_first=True)
    as_floats = lambda values: tuple(float(value) for value in values)  # noqa: E731
    return Collider("", primitive.shape, as_floats(size), as_floats(pos), as_floats(quat), primitive.is_core)  # type: ignore


def all_placed(link: Link, numbers: Sequence[np.ndarray]) -> list[Collider]:
    """Return all primitives of a link with some numbers, those of pairs one after the other."""
    found = []
    for primitive, own in zip(link.primitives, numbers, strict=True):
        found += [
            _placed(primitive, own, link, is_mirrored) for is_mirrored in ((False, True) if primitive.is_pair else (False,))
        ]
    return found


# ---- distances


def distance(placed: Sequence[Collider], pos: np.ndarray) -> np.ndarray:
    """Return the signed distance [m] of each primitive's surface from points, (primitive, point)."""
    found = []
    for own in placed:
        turn = Rotation.from_quat(own.quat, scalar_first=True).as_matrix()
        x, y, z = torch.from_numpy(((pos - own.pos) @ turn).T.copy())
        size = torch.tensor([*own.size, 0.0, 0.0][:3], dtype=torch.float64)
        found.append(SHAPES[own.type]((x, y, z), tuple(size))[0].numpy())  # type: ignore[arg-type]
    return np.stack(found)


def fitted(link: Link, surface: Surface) -> list[Collider]:
    """Return a link's primitives, fitted to its surface."""
    points = samples(surface, link, link.count)
    height = partial(signed_heights, surface) if link.is_hollow else partial(_above, _hull_planes(surface))
    apart = lru_cache(CACHED)(lambda own: distance([own], points.pos)[0])  # a step of one number moves one primitive
    rise = lru_cache(CACHED)(lambda box: height(edges(box)))
    between = lru_cache(CACHED**2)(lambda own, box: distance([own], edges(box))[0])
    scale = np.where(points.is_touched, TOUCHED_SCALE, REST_SCALE) * MM
    start = [_numbers(primitive) for primitive in link.primitives]
    free = np.concatenate([_is_free(primitive, link) for primitive in link.primitives])
    ends = np.cumsum([len(own) for own in start])[:-1]

    def numbers(chosen: np.ndarray) -> list[np.ndarray]:
        whole = np.concatenate(start)
        whole[free] = chosen
        return np.split(whole, ends)

    def residuals(chosen: np.ndarray, power: float) -> np.ndarray:
        placed = all_placed(link, numbers(chosen))
        found = np.min([apart(own) for own in placed], axis=0) / scale
        corners = sharp(placed, rise, between) / (TOUCHED_SCALE * MM)
        return np.concatenate([np.sign(found) * np.abs(found) ** np.where(points.is_touched, power, 2), corners**power])

    chosen = np.concatenate(start)[free]
    low, high = (np.concatenate([_bound(own, sign) for own in link.primitives])[free] for sign in (-1, 1))
    for power in (2, 3, 4):
        made = least_squares(
            residuals, chosen, bounds=(low, high), x_scale=1.0, diff_step=1e-5, max_nfev=MOST_STEPS, args=(power,)
        )
        chosen = made.x
    return all_placed(link, [np.round(own, 2) for own in numbers(chosen)])


def _above(planes: np.ndarray, pos: np.ndarray) -> np.ndarray:
    """Return how far points are outside of planes, (plane, normal and offset) [m]."""
    return (pos @ planes[:, :3].T - planes[:, 3]).max(axis=1)


def signed_heights(surface: Surface, pos: np.ndarray) -> np.ndarray:
    """Return the heights of points above a surface, of several meshes above their union [m]."""
    sign = igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
    return np.asarray(igl.signed_distance(pos, surface.vertices, surface.faces, sign_type=sign)[0])


def edges(box: Collider) -> np.ndarray:
    """Return points of a box's edges [m]."""
    return EDGES * box.size @ Rotation.from_quat(box.quat, scalar_first=True).as_matrix().T + box.pos


def sharp(
    placed: Sequence[Collider],
    rise: Callable[[Collider], np.ndarray],
    between: Callable[[Collider, Collider], np.ndarray],
) -> np.ndarray:
    """Return how far points of the boxes' edges stick out of a link and of the other primitives [m], or less.

    Args:
        placed: The primitives.
        rise: The heights of a box's edges above the link, or less [m].
        between: The distances of the second one's edges, a box's, from the first one [m].
    """
    found = []
    for i, box in enumerate(placed):
        if box.type == "box":
            others = [between(own, box) for j, own in enumerate(placed) if j != i]
            found.append(np.clip(np.min([rise(box), *others], axis=0), 0, None))
    return np.concatenate(found) if found else np.zeros(0)


# ---- how well they fit


@dataclass(frozen=True)
class Deviation:
    """How far primitives are from a link's surface [m], where objects touch it, or elsewhere.

    Attributes:
        mean: Mean distance of the surface's points from the primitives' surface.
        gap: Largest distance of a point of the surface from the primitives, outside of them.
        excess: Largest depth of a point of the surface in a primitive, or height of a primitive's point above the surface.
    """

    mean: float
    gap: float
    excess: float


def deviations(
    link: Link, placed: Sequence[Collider], surface: Surface, count: int = 20000, seed: int = 1
) -> tuple[Deviation, Deviation]:
    """Measure on points that were not fitted how far primitives are from a surface: where it is touched, and elsewhere."""
    points = samples(surface, link, count, seed)
    found = distance(placed, points.pos).min(axis=0)
    outer = exterior(placed, max(count // len(placed), 500), seed)
    height = signed_heights(surface, outer)
    _, face, nearest = igl.point_mesh_squared_distance(outer, surface.vertices, surface.faces)
    is_touched = touched(np.asarray(nearest), surface.face_normals[np.asarray(face)], link)
    made = []
    for chosen, other in ((points.is_touched, is_touched), (~points.is_touched, ~is_touched)):
        own, above = found[chosen], height[other].max(initial=0)
        mean = float(np.abs(own).mean()) if len(own) else 0.0
        made.append(Deviation(mean, float(own.max(initial=0)), float(max(-own.min(initial=0), above))))
    return made[0], made[1]


def exterior(placed: Sequence[Collider], count: int, seed: int) -> np.ndarray:
    """Return points of the primitives' surfaces that are inside none of the others [m]."""
    found = []
    for i, own in enumerate(placed):
        if own.type == "box":
            mesh = trimesh.creation.box(2 * np.array(own.size))
        elif own.type == "sphere":
            mesh = trimesh.creation.icosphere(subdivisions=4, radius=own.size[0])
        else:
            mesh = trimesh.creation.capsule(2 * own.size[1], own.size[0], count=[48, 48])
            mesh.apply_translation([0, 0, -mesh.bounds.mean(axis=0)[2]])
        pos = trimesh.sample.sample_surface(mesh, count, seed=seed)[0]
        pos = np.concatenate([np.asarray(pos), np.asarray(mesh.vertices)])
        pos = pos @ Rotation.from_quat(own.quat, scalar_first=True).as_matrix().T + own.pos
        others = [other for j, other in enumerate(placed) if j != i]
        found.append(pos[distance(others, pos).min(axis=0) > 0] if others else pos)
    return np.concatenate(found)

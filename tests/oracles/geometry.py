"""Distances of primitives and meshes, against known values, or points built at a known distance."""

from typing import Any

import numpy as np
import torch
import trimesh

from oracles.comparison import Values, field
from oracles.setups.scenes import BOX, probed, state
from tgdsl.geometry.planes import split
from tgdsl.geometry.shapes import SHAPES
from tgdsl.module.state import SceneState

oracle = field("geometry", "geometry", "contact_depth", "surface_distance")
THIRD = 1 / np.sqrt(3)
Row = tuple[str, tuple[float, ...], tuple[float, ...], float, tuple[float, ...]]
KNOWN: tuple[Row, ...] = (
    ("plane", (0, 0, 0), (5, -3, -2), -2.0, (0, 0, 1)),
    ("sphere", (2, 0, 0), (0, 0, 0), -2.0, (1, 0, 0)),
    ("sphere", (2, 0, 0), (0, 3, 4), 3.0, (0, 0.6, 0.8)),
    ("capsule", (1, 2, 0), (0, 0, 5), 2.0, (0, 0, 1)),
    ("capsule", (1, 2, 0), (0, 0, 1), -1.0, (1, 0, 0)),
    ("capsule", (1, 2, 0), (3, 4, 2), 4.0, (0.6, 0.8, 0)),
    ("box", (1, 2, 3), (2, 3, 4), float(np.sqrt(3)), (THIRD, THIRD, THIRD)),
    ("box", (1, 2, 3), (0, 0, 0), -1.0, (1, 0, 0)),
    ("box", (1, 2, 3), (-0.5, 1.9, 0), -0.1, (0, 1, 0)),
    ("box", (1, 2, 3), (1, 2, 3), 0.0, (1, 0, 0)),
    ("cylinder", (1, 2, 0), (4, 0, 6), 5.0, (0.6, 0, 0.8)),
    ("cylinder", (1, 2, 0), (0, 0, 0), -1.0, (1, 0, 0)),
    ("cylinder", (3, 1, 0), (0, 0, -0.5), -0.5, (0, 0, -1)),
    ("ellipsoid", (1, 2, 3), (0, 0, 5), 2.0, (0, 0, 1)),
    ("ellipsoid", (1, 2, 3), (-4, 0, 0), 3.0, (-1, 0, 0)),
    ("ellipsoid", (1, 2, 3), (0, 0, 0), -1.0, (1, 0, 0)),
    ("ellipsoid", (2, 2, 2), (0, 3, 4), 3.0, (0, 0.6, 0.8)),
)
"""Known distances: shape, size, point, distance, gradient."""
PRIMITIVES = (
    ("plane", (1.0, 1.0, 0.1)),
    ("sphere", (0.02, 0.0, 0.0)),
    ("capsule", (0.01, 0.03, 0.0)),
    ("box", (0.02, 0.015, 0.03)),
    ("box", (0.05, 0.04, 1e-3)),
    ("cylinder", (0.012, 0.03, 0.0)),
    ("cylinder", (0.05, 0.002, 0.0)),
    ("ellipsoid", (0.02, 0.012, 0.03)),
    ("ellipsoid", (0.02, 0.02, 0.01)),
    ("ellipsoid", (0.05, 0.005, 0.02)),
)
"""Shapes and sizes [m] of surfaces with known points."""
HALF, REACH = 0.02, 0.01
"""Half the edge of the cube of 4 cm, and the radius of its probes [m]."""


def distances(
    shape: str, size: tuple[float, ...], pos: np.ndarray, dtype: torch.dtype = torch.float64
) -> tuple[np.ndarray, np.ndarray]:
    """Return this package's signed distances (point,) [m] and their gradients (point, 3) [1]."""
    p, s = torch.tensor(pos, dtype=dtype), torch.tensor(size, dtype=dtype)
    distance, gradient = SHAPES[shape](split(p), split(s))
    return distance.double().numpy(), torch.stack(gradient, dim=-1).double().numpy()


@oracle(
    "Distances of primitives that need no code", "φ, ∇φ", "geometry, by hand", "distance and gradient [1]",
    at=[f"{shape} {point}" for shape, _, point, *_ in KNOWN], atol=1e-12, series=("φ", "∂x", "∂y", "∂z"), defects=(7,),
)  # fmt: skip
def known_distances():
    exact, ours = [], []
    for shape, size, point, distance, gradient in KNOWN:
        computed, direction = distances(shape, size, np.array([point], dtype=float))
        exact.append([distance, *gradient])
        ours.append([computed[0], *direction[0]])
    return np.array(exact).T, np.array(ours).T


@oracle(
    "An ellipsoid at points along its normals", "φ(X + t n) = t",
    "X + t n is at t while t is above −(least radius of curvature)", "distance, the farthest off of 1,000 [m]", "t [m]",
    atol=1e-14, defects=(7,),
)  # fmt: skip
def ellipsoid_normals(num: int = 1000):
    rng, size = np.random.default_rng(0), np.array([0.02, 0.012, 0.03])
    on_sphere = rng.normal(size=(num, 3))
    surface = size * on_sphere / np.linalg.norm(on_sphere, axis=1, keepdims=True)
    normal = unit(surface / size**2)
    least = size.min() ** 2 / size.max()
    exact = np.array([0.05, 0.5 * least, 0.0, -0.5 * least])
    ours = []
    for t in exact:
        distance, gradient = distances("ellipsoid", tuple(size), surface + t * normal)
        off = distance[np.abs(distance - t).argmax()]
        ours.append(off if np.abs(gradient - normal).max() <= 1e-11 else np.nan)
    return Values(exact, ours, at=exact)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (vector, 3) scaled to length 1."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


Surface = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Points of a surface, their outward normals, and to which depth each is the nearest one [m]."""


def surface_points(shape: str, size: tuple[float, ...], rng: np.random.Generator, num: int) -> Surface:
    """Return random points of a primitive's surface."""
    whole = np.array(size)
    if shape == "plane":
        return rng.uniform(-1, 1, (num, 3)) * [1, 1, 0], np.tile([0.0, 0.0, 1.0], (num, 1)), np.full(num, 1.0)
    if shape == "sphere":
        normal = unit(rng.normal(size=(num, 3)))
        return whole[0] * normal, normal, np.full(num, whole[0])
    if shape == "capsule":
        normal = unit(rng.normal(size=(num, 3)))
        on_wall = rng.random(num) < 0.5
        normal[on_wall] = unit(normal[on_wall] * [1, 1, 0])
        height = np.where(on_wall, rng.uniform(-1, 1, num), np.sign(normal[:, 2])) * whole[1]
        return whole[0] * normal + height[:, None] * [0, 0, 1], normal, np.full(num, whole[0])
    if shape == "ellipsoid":
        surface = whole * unit(rng.normal(size=(num, 3)))
        return surface, unit(surface / whole**2), np.full(num, whole.min() ** 2 / whole.max())
    return (_box_points if shape == "box" else _cylinder_points)(whole, rng, num)


def _box_points(size: np.ndarray, rng: np.random.Generator, num: int) -> Surface:
    inside = size * rng.uniform(-1, 1, (num, 3))
    normal = unit(np.abs(rng.normal(size=(num, 3)))) * rng.choice([-1.0, 1.0], (num, 3))
    fixed = rng.permuted(np.tile([True, False, False], (num, 1)), axis=1)  # which axes are at their limit: a face,
    fixed |= rng.random((num, 3)) < 0.3  # an edge or a corner
    normal = unit(normal * fixed)
    surface = np.where(fixed, np.sign(normal) * size, inside)
    room = np.where(fixed, size, size - np.abs(inside)).min(axis=1)
    return surface, normal, np.where(fixed.sum(axis=1) == 1, room, 0.0)


def _cylinder_points(size: np.ndarray, rng: np.random.Generator, num: int) -> Surface:
    radius, half = size[0], size[1]
    angle, part = rng.uniform(0, 2 * np.pi, num), rng.integers(0, 3, num)
    radial = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(num)])
    side = rng.choice([-1.0, 1.0], num)
    lean = np.where(part == 2, rng.uniform(0, np.pi / 2, num), np.where(part == 1, np.pi / 2, 0.0))
    normal = np.cos(lean)[:, None] * radial + (np.sin(lean) * side)[:, None] * [0, 0, 1]
    normal[part == 1] = side[part == 1, None] * [0, 0, 1]
    rho = np.where(part == 1, radius * np.sqrt(rng.random(num)), radius)
    height = np.where(part == 0, half * rng.uniform(-1, 1, num), half * side)
    depth = np.select([part == 0, part == 1], [np.minimum(radius, half - np.abs(height)), np.minimum(half, radius - rho)], 0.0)
    return rho[:, None] * radial + height[:, None] * [0, 0, 1], normal, depth


@oracle(
    "{num:,} points at known distances of a {shape}, size {size}", "φ(X + t n) = t, ∇φ = n",
    "X + t n is at t while X is the nearest point", "largest error over the tolerance [1]",
    at=["φ, 1e-12 of the size", "|∇φ|, 1e-5", "φ in float32, 1e-6", "|∇φ| in float32, 1e-5", "∇φ, 1e-8"], atol=1.0,
    defects=(7,), each=[(*row, 20_000) for row in PRIMITIVES], also=[(*row, 1_000_000) for row in PRIMITIVES],
)  # fmt: skip
def at_known_distances(shape: str, size: tuple[float, ...], num: int = 100_000):
    # A point X of a surface with outward normal n, moved by t along n, is at the distance t as long as X stays the nearest
    # point: for every t > 0 outside these convex shapes, and inside down to the depth where another part comes as near.
    rng = np.random.default_rng(0)
    surface, normal, depth = surface_points(shape, size, rng, num)
    t = np.where(rng.random(num) < 0.5, rng.random(num) * max(size), -rng.random(num) * depth)
    pos, errors = surface + t[:, None] * normal, []
    for dtype, allowed in ((torch.float64, 1e-12), (torch.float32, 1e-6)):
        distance, gradient = distances(shape, size, pos, dtype)
        errors += [np.abs(distance - t).max() / max(size) / allowed, np.abs(np.linalg.norm(gradient, axis=1) - 1).max() / 1e-5]
    is_clear = (t > 1e-6) | (t < -1e-6) & (-t < 0.9 * depth)
    if shape == "ellipsoid":  # near a plane of symmetry the sign of one small component is fixed: see `planes.tie`
        is_clear &= (np.abs(pos) > 1e-7).all(axis=1)
    direction = distances(shape, size, pos)[1]
    errors.append(np.abs(direction[is_clear] - normal[is_clear]).max() / 1e-8)
    return 0.0, errors


@oracle(
    "A probe reaches its radius and no further", "d = max(0, R − φ)", "geometry, by hand; the paper's range as measured",
    "depth [m]", "clearance [m]", atol=1e-15, defects=(6,),
)  # fmt: skip
def reach():
    clearances = np.array([-5.0, 0.0, 1.0, 2.5, 4.0, 5.0, 7.5, 9.0, 9.9, 10.0, 10.1]) * 1e-3
    touch = probed([(0, 0, HALF + c) for c in clearances], BOX, kind="contact_depth")
    exact = np.maximum(REACH - clearances, 0)
    paper = np.where(clearances <= 0.1 * 2 * HALF, exact, 0.0)
    return Values(exact, touch(state(touch))["s"][0, :, 0], paper, at=clearances)


@oracle(
    "Distance before, in and after contact", "φ = min(z − h, range)", "geometry, by hand", "distance [m]", "height [m]",
    atol=1e-15,
)  # fmt: skip
def before_and_after_contact():
    heights = np.array([0.2, 0.07, 0.0699, 0.05, 0.0201, 0.02, 0.019, 0.005])
    touch = probed([(0, 0, z) for z in heights], BOX, gate=None, kind="surface_distance")
    return Values(np.minimum(heights - HALF, 0.05), touch(state(touch))["s"][0, :, 0], at=heights)


@oracle(
    "The vector leads to the surface", "v = −φ ∇φ", "geometry, by hand", "distance and vector [m]",
    at=[f"{'φ' if i == 0 else 'xyz'[i - 1]} at {p}" for p in range(3) for i in range(4)], atol=1e-15,
)  # fmt: skip
def nearest_vector():
    probes = np.array([(0.023, 0.024, 0.0), (0.0, 0.0, 0.015), (0.2, 0, 0)])
    touch = probed(probes, BOX, gate=None, kind="surface_distance", nearest=True)
    return [0.005, -0.003, -0.004, 0, -0.005, 0, 0, 0.005, 0.05, 0, 0, 0], touch(state(touch))["s"][0].numpy().ravel()


def mesh_scene(
    mesh: trimesh.Trimesh | None, probes: np.ndarray, *, kind: str = "contact_depth", scale: float = 1.0,
    geoms: str = '<geom type="mesh" mesh="item"/>', dtype: torch.dtype = torch.float64, **target: Any,
) -> tuple[Any, SceneState]:  # fmt: skip
    """Return a module whose probes of 10 mm feel a mesh or geoms, and its scene at the origin: see `module`."""
    gate = None if kind == "surface_distance" else "geometric"
    fields = {"kind": kind, "gate": gate, "mesh": mesh, "scale": scale, "target": target, "dtype": dtype, "radius": REACH}
    touch = probed(probes, geoms, **fields)
    return touch, state(touch)


WAYS: dict[str, tuple[dict[str, Any] | None, float]] = {
    "exact": (None, 1e-15),
    "sdf": ({"query": "sdf"}, 5e-5),
    "raycast": ({"query": "raycast"}, 1e-6),
}
"""Queries of a cube with their tolerances [m]: as a primitive, as a mesh on a grid, and per triangle."""
SPOTS = [(x, y) for x in (-0.012, 0.0, 0.007) for y in (-0.009, 0.003)]
"""Positions of probes over the cube's upper face [m]."""


@oracle(
    "A cube of 4 cm, query {way}", "d = R − c", "geometry, by hand", "depth [m]", "clearance [m]",
    series=[f"at {spot}" for spot in SPOTS], defects=(6, 20), each=list(WAYS), slow=True,
)  # fmt: skip
def cube_of_any_making(way: str):
    target, tolerance = WAYS[way]
    clearances = np.array([1.0, 2.0, 3.5, 5.0, 6.5, 8.0, 9.0, 9.9]) * 1e-3
    probes = np.array([(x, y, HALF + c) for c in clearances for x, y in SPOTS])
    mesh = None if target is None else trimesh.creation.box((0.04, 0.04, 0.04))
    touch, scene = mesh_scene(mesh, probes, **({"geoms": BOX} if target is None else target))
    ours = touch(scene)["s"][0, :, 0].numpy().reshape(len(clearances), len(SPOTS))
    return Values(REACH - clearances, ours.T, at=clearances, atol=tolerance)


@oracle(
    "A ball of triangles, query {query}, in units of {scale:g} m", "φ = |x| − R",
    "geometry; R(1 − cos(θ/2)) of an arc of θ = 2.5°", "error within which 99 % are [m]", at=["99 %"], defects=(20,),
    each=["sdf", "raycast"], also=[("sdf", 1e-3), ("raycast", 1e-3)], slow=True,
)  # fmt: skip
def ball_of_triangles(query: str, scale: float = 1.0):
    rng = np.random.default_rng(0)
    direction, radius = unit(rng.normal(size=(300, 3))), rng.uniform(0.012, 0.029, 300)
    ball = trimesh.creation.icosphere(subdivisions=5, radius=HALF)
    touch, scene = mesh_scene(
        ball, direction * radius[:, None], kind="surface_distance", scale=scale, query=query, surface="visual"
    )
    error = np.abs(touch(scene)["s"][0, :, 0].numpy() - (radius - HALF))
    tessellation = HALF * (1 - np.cos(np.deg2rad(2.5) / 2)) + 1e-6
    return Values(0.0, np.percentile(error, 99), atol=tessellation + (5e-5 if query == "sdf" else 0))

"""Hard cases of probes: edges, medial axes, grazing contacts, deep overlap, ties, jitter, thin and sharp meshes."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from oracles.geometry import mesh_scene
from oracles.hard import case
from oracles.hard.case import Errors
from oracles.hard.scene import quiet
from oracles.setups.brute import brute_force
from oracles.setups.scenes import BALL, BOX, probed, state
from tgdsl.geometry.planes import split
from tgdsl.geometry.reference import TIE, signed_distance
from tgdsl.geometry.shapes import SHAPES
from tgdsl.module.accuracy.states import moved
from tgdsl.module.state import SceneState

R = 0.01
"""Radius of the probes [m]."""
HALF = 0.02
DIAGONAL = np.sqrt(0.5)

Place = tuple[tuple[float, float, float], float]
HARD: dict[str, list[Place]] = {
    BOX: [
        ((HALF, 0, 0), R),  # on a face
        ((HALF, HALF, 0), R),  # on an edge
        ((HALF, HALF, HALF), R),  # on a corner
        ((0, 0, 0), R + HALF),  # at the centre
        ((HALF + 0.006, HALF + 0.008, 0), 0.0),  # one radius off an edge: just out of reach
        ((HALF + 0.003, HALF + 0.004, 0), 0.005),
    ],
    BALL: [((HALF, 0, 0), R), ((0, 0, 0), R + HALF), ((0, 0, HALF + 0.004), 0.006)],
    '<geom type="capsule" size=".01 .02"/>': [
        ((0, 0, 0), R + 0.01),  # at the centre
        ((0, 0, 0.02), R + 0.01),  # on the axis, at the end of the segment
        ((0, 0, 0.03), R),  # on the pole
        ((0.01, 0, 0.013), R),  # on the wall
    ],
    '<geom type="cylinder" size=".02 .03"/>': [
        ((0, 0, 0), R + HALF),
        ((HALF, 0, 0), R),  # on the wall
        ((0, 0, 0.03), R),  # on a cap
        ((HALF * DIAGONAL, HALF * DIAGONAL, 0.03), R),  # on the rim
        ((HALF + 0.003, 0, 0.034), 0.005),
    ],
    '<geom type="ellipsoid" size=".02 .01 .03"/>': [
        ((0, 0, 0), R + 0.01),
        ((HALF, 0, 0), R),
        ((0, 0.01, 0), R),
        ((0, 0, 0.035), 0.005),
    ],
    '<geom type="plane" size="1 1 .1"/>': [((0.3, 0.2, 0), R), ((0, 0, 0.004), 0.006), ((0, 0, -0.03), 0.04)],
}
"""By a geom's MJCF: positions of probes [m] and their depths in the geom [m]."""
GEOMS = {geom.split('"')[1]: geom for geom in HARD}
"""Geoms by the names of their shapes."""
BY_HAND = "geometry, by hand"
hard = partial(case.hard, "probes and shapes")


JITTER = 1e-9
"""Residual motion of a solver at rest [m, and of a unit quaternion]."""
NUM_STEPS = 10_000
"""Steps that tests evaluate."""


def repeated(scene: SceneState, num: int) -> SceneState:
    """Return an environment repeated many times."""
    names = ("body_pos", "body_quat", "body_linvel", "body_angvel", "contact_found")
    values: dict[str, Any] = {name: getattr(scene, name) for name in names}
    return SceneState(**{k: v.expand(num, *v.shape[1:]).clone() for k, v in values.items() if v is not None})


def jittered(scene: SceneState, num: int, seed: int = 0) -> SceneState:
    """Return `num` steps of a scene at rest with jittering poses."""
    steps = repeated(scene, num)
    generator = torch.Generator().manual_seed(seed)
    assert steps.body_pos is not None and steps.body_quat is not None
    for tensor in (steps.body_pos, steps.body_quat):
        tensor += JITTER * torch.randn(tensor.shape, generator=generator, dtype=tensor.dtype)
    return steps


@hard(
    "taxels on faces, edges, corners, medial axes{place}", "the nearest point is not unique; a normal of length zero", BY_HAND,
    "m", GEOMS, defects=(7,), each=["", ", 1 km away"],
)  # fmt: skip
def depths_at_places(dtype: torch.dtype, geom: str, place: str):
    places, depths = zip(*HARD[geom], strict=True)
    touch = probed(places, geom, kind="contact_depth", radius=R, dtype=dtype)
    scene = state(touch)
    if place:
        scene = moved(scene, np.array([600.0, -800.0, 50.0]), Rotation.from_rotvec([0.4, 1.0, -2.0]))
    near, far = (1e-15, 2e-11) if dtype == torch.float64 else (3e-9, 2e-8)
    return Errors(np.abs(touch(scene)["s"][0, :, 0].double().numpy() - depths).max(), far if place else near)


@hard(
    "grazing contacts", "a depth that is all rounding; a sign that flips", BY_HAND, "of the radius",
    {f"{depth:g} m": depth for depth in (1e-3, 1e-5, 1e-7, 1e-9, 0.0, -1e-9, -1e-7)}, float64=1e-14, float32=4e-7,
)  # fmt: skip
def grazing(dtype: torch.dtype, depth: float):
    touch = probed([(0, 0, 0.02 + R - depth)], BALL, kind="contact_depth", dtype=dtype)
    return abs(float(touch(state(touch))["s"].item()) - max(depth, 0.0)) / R


@hard(
    "deep overlap", "forces without bound, normals that are not finite", "force at 10 cm", "of that force", GEOMS, float64=None,
    float32=1.0,
)  # fmt: skip
def deep_overlap(dtype: torch.dtype, geom: str):
    places, worst = np.random.default_rng(0).normal(scale=0.004, size=(200, 3)), 0.0
    touch = probed(places, geom, kind="kinematic_taxel", dtype=dtype)
    for scale in (1e-12, 1e-3, 1.0):
        reading = touch(state(touch, pos=scale * np.array([0.001, -0.002, 0.0005])))["s"]
        size = float(reading[..., :3].norm(dim=-1).max()) if torch.isfinite(reading).all() else np.inf
        worst = max(worst, size / (500 * 0.1**1.2))
    return worst


@hard(
    "a spin of {speed:,.0f} rad/s", "velocity of the surface loses its digits", "k_t ω × r", "of the force",
    ("normal", "along", "across"), float64=1e-12, float32=1e-5,
)  # fmt: skip
def fast_spin(dtype: torch.dtype, speed: float = 1000.0):
    touch = probed([(0.016, 0, 0)], BALL, kind="kinematic_taxel", dtype=dtype)
    reading = touch(state(touch, angvel=[0, 0, speed]))["s"][0, 0].double().numpy()
    exact = np.array([500 * 0.014**1.2, 2 * speed * 0.016, 0])
    return np.abs(reading[:3] - exact) / np.where(exact == 0, np.finfo(float).tiny, np.abs(exact))


@hard(
    "link and object moving as one", "differences of large velocities", "the same at rest", "of the force",
    {f"{speed:g} rad/s": speed for speed in (1e-6, 1.0, 1e3)}, float64=1e-12, float32=1e-6,
)  # fmt: skip
def turned_velocity(dtype: torch.dtype, speed: float):
    touch = probed([(0.01, 0.004, 0.0)], BOX, kind="kinematic_taxel", dtype=dtype)
    still, moving = (state(touch, pos=[0, 0, 0.026]) for _ in range(2))
    spin, drift = speed * np.array([1.0, -2.0, 0.5]), speed * np.array([0.3, 0.1, -0.2])
    for i in range(moving.body_pos.shape[1]):
        moving.body_angvel[0, i] = torch.tensor(spin)
        moving.body_linvel[0, i] = torch.tensor(drift + np.cross(spin, moving.body_pos[0, i].numpy()))
    return float((touch(moving)["s"] - touch(still)["s"]).double().abs().max()) / (2 * speed * 0.05 + 0.66)


@hard(
    "at rest on a tie, poses trembling by 1 nm", "the normal alternates between faces", "its first value", "rad", GEOMS,
    float64=1e-3, float32=1e-3, each=[2000], also=[NUM_STEPS],
)  # fmt: skip
def trembling(dtype: torch.dtype, geom: str, steps: int):
    places = [place for place, depth in HARD[geom] if depth > 0]
    touch = probed(places, geom, kind="kinematic_taxel", outputs=["force"], dtype=dtype)
    force = touch(jittered(state(touch), steps))["s"].double()
    way = force / force.norm(dim=2, keepdim=True)
    return float((way - way[:1]).norm(dim=2).max())


SHAPES_OF_ONE = (
    ("sphere", (1.0, 0, 0)), ("capsule", (0.5, 1.5, 0)), ("box", (1, 0.75, 1.5)), ("cylinder", (0.6, 1.5, 0)),
    ("ellipsoid", (1, 0.6, 1.5)), ("ellipsoid", (2.5, 0.05, 1)),
)  # fmt: skip


@hard("primitives of {scale:g} m", "squares underflow or overflow", "float64 definition", "of the size", each=[1e-6, 1e-3, 1e3])
def sizes(dtype: torch.dtype, scale: float):
    """Points closer than 1e-7 m to a tie count as on it, whatever the size: below 1 mm, errors may be twice as large."""
    draws = np.random.default_rng(3).uniform(-1.5, 1.5, (2, len(SHAPES_OF_ONE), 200, 3))[int(dtype == torch.float32)]
    errors = []
    for (shape, sides), draw in zip(SHAPES_OF_ONE, draws, strict=True):
        size = np.array(sides) * scale
        pos = (draw * (size + 0.2 * size.max())).astype(np.float32).astype(np.float64)
        whole = torch.tensor(size.astype(np.float32), dtype=dtype)
        distance, _ = SHAPES[shape](split(torch.tensor(pos, dtype=dtype)), split(whole))
        exact = np.array([signed_distance(shape, whole.double().numpy(), point)[0] for point in pos])
        errors.append(np.abs(distance.double().numpy() - exact).max() / size.max())
    most = (2 * TIE / scale if scale < 1e-3 else 0.0) + (1e-12 if dtype == torch.float64 else 1e-6)
    return Errors(errors, most, [f"{shape} {sides[0] * scale:g}" for shape, sides in SHAPES_OF_ONE])


CLEARANCES = (0.0, 3.4e-3, 3.6e-3, 4.1e-3)
GATES = {"geometric": ("geometric", 0.0), "pair in contact": ("contact_pair", 1.0), "pair apart": ("contact_pair", 0.0)}
"""The gate, and whether the solver has a contact."""


@hard(
    "probes that reach before the surfaces meet", "a bit that fires for the wrong reason", BY_HAND, "bits",
    {f"{name}, {1e3 * c:g} mm": (*gate, c) for name, gate in GATES.items() for c in CLEARANCES}, float32=None, defects=(5,),
)  # fmt: skip
def early_contact(dtype: torch.dtype, part: tuple[str, float, float]):
    """A probe of 4 mm fires 0.5 mm within its radius, with `gate: contact_pair` only if the pair is in contact too."""
    gate, is_touching, clearance = part
    touch = probed([(0, 0, 0.02 + clearance)], BALL, kind="contact", radius=0.004, gate=gate, dtype=dtype)
    scene = state(touch)
    if scene.contact_found is not None:
        scene.contact_found = torch.full_like(scene.contact_found, is_touching)
    exact = float(0.004 - clearance > 5e-4 and (gate == "geometric" or is_touching > 0))
    return abs(float(touch(scene)["s"].item()) - exact)


def plate() -> trimesh.Trimesh:
    """Return a sheet of two sides that coincide."""
    corners = np.array([[-0.02, -0.015, 0], [0.02, -0.015, 0], [0.02, 0.015, 0], [-0.02, 0.015, 0]])
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]], process=False)


def needles() -> trimesh.Trimesh:
    """Return a wedge 40 mm long with triangles as thin as 1 to 4,000."""
    low = np.array([[0, 0, 0], [0.04, 0, 0], [0.04, 1e-5, 0]])
    faces = [[2, 1, 0], [3, 4, 5], [0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]]
    return trimesh.Trimesh(np.concatenate([low, low + [0, 0, 0.02]]), faces, process=False)


def twins() -> trimesh.Trimesh:
    """Return two boxes that share a face, with both copies of it."""
    parts = [trimesh.creation.box((0.02, 0.02, 0.02)).apply_translation((x, 0, 0)) for x in (-0.01, 0.01)]
    return trimesh.util.concatenate(parts)


Probes = list[tuple[float, float, float]]
MESHES: dict[str, tuple[Callable[[], trimesh.Trimesh], Probes]] = {
    "plate": (plate, [(0.003, 0.002, 0.004), (0.003, 0.002, -0.004), (0.0215, 0.004, 0.0), (0.021, 0.016, 0.001)]),
    "needles": (needles, [(0.03, -0.003, 0.01), (0.03, 0.004, 0.01), (0.042, 0.0, 0.01), (0.0425, 0.0, 0.022)]),
    "twins": (twins, [(0.0, 0.004, 0.013), (0.0, 0.013, 0.0), (0.003, 0.002, 0.014), (0.0215, 0.0115, 0.0115)]),
}
"""The mesh, and probes near it: over its middle, its edges and its corners [m]."""
TOLERANCE = 1e-4
"""Tolerance of distance grids around them [m]."""


@hard(
    "sheets, needles, faces that coincide: query {query}", "no inside, triangles without area, ties",
    "the nearest triangle by brute force", "m", MESHES, each=["sdf", "raycast"],
)  # fmt: skip
def hard_meshes(dtype: torch.dtype, part: tuple[Callable[[], trimesh.Trimesh], Probes], query: str):
    make, probes = part
    geoms = '<inertial pos="0 0 0" mass=".1" diaginertia="1e-4 1e-4 1e-4"/>'
    geoms += '<geom type="mesh" mesh="item" contype="0" conaffinity="0"/>'
    fields = {"surface": "visual", "query": query, "tolerance": TOLERANCE}
    with quiet():
        touch, scene = mesh_scene(make(), np.array(probes), geoms=geoms, dtype=dtype, **fields)
        depth = touch(scene)["s"][0, :, 0].double().numpy()
    exact = np.maximum(R - brute_force(np.asarray(make().triangles), np.array(probes))[0], 0)
    # Near creases a grid may err by five times its tolerance.
    return Errors(np.abs(depth - exact).max(), 5 * TOLERANCE if query == "sdf" else 1e-6)

"""What is hard for probes: edges, medial axes, grazing contacts, deep overlap, ties, trembling, thin and sharp meshes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from oracles.geometry import mesh_scene
from oracles.hard.places import HARD, R
from oracles.hard.results import Allowed, Case, HardCase
from oracles.hard.scene import DTYPES, quiet
from oracles.hard.trembling import jittered
from oracles.setups.scenes import probed, state
from tgdsl.geometry.planes import split
from tgdsl.geometry.reference import TIE, signed_distance
from tgdsl.geometry.shapes import SHAPES
from tgdsl.module.accuracy.changed import moved
from tgdsl.module.state import SceneState

GEOMS = tuple(HARD)
NAMES = tuple(geom.split('"')[1] for geom in GEOMS)
BY_HAND = "geometry, by hand"


def depths_at_places(is_far: bool) -> HardCase:
    """Return how far depths are off on faces, edges, corners and medial axes, near or 1 km from the origin."""
    errors: dict[str, Allowed] = {}
    for precision, dtype in DTYPES.items():
        found = []
        for geom in GEOMS:
            places, depths = zip(*HARD[geom], strict=True)
            touch = probed(places, geom, kind="contact_depth", radius=R, dtype=dtype)
            scene = state(touch)
            if is_far:
                scene = moved(scene, np.array([600.0, -800.0, 50.0]), Rotation.from_rotvec([0.4, 1.0, -2.0]))
            found.append(np.abs(touch(scene)["s"][0, :, 0].double().numpy() - depths).max())
        most = {"float64": 2e-11 if is_far else 1e-15, "float32": 2e-8 if is_far else 3e-9}[precision]
        errors[precision] = Allowed(np.array(found), most)
    return HardCase(
        "taxels on faces, edges, corners, medial axes" + (", 1 km away" if is_far else ""),
        "the nearest point is not unique; a normal of length zero",
        BY_HAND,
        "m",
        NAMES,
        errors,
        defects=(7,),
    )


def grazing() -> HardCase:
    """Return how far depths of contacts are off that just begin, from 1e-9 m on, over a probe's radius."""
    depths = (1e-3, 1e-5, 1e-7, 1e-9, 0.0, -1e-9, -1e-7)
    errors: dict[str, Allowed] = {}
    for precision, dtype in DTYPES.items():
        found = []
        for depth in depths:
            touch = probed([(0, 0, 0.02 + R - depth)], '<geom type="sphere" size=".02"/>', kind="contact_depth", dtype=dtype)
            found.append(abs(float(touch(state(touch))["s"].item()) - max(depth, 0.0)) / R)
        errors[precision] = Allowed(np.array(found), 1e-14 if precision == "float64" else 4e-7)
    return HardCase(
        "grazing contacts",
        "a depth that is all rounding; a sign that flips",
        BY_HAND,
        "of the radius",
        tuple(f"{depth:g} m" for depth in depths),
        errors,
    )


def deep_overlap() -> HardCase:
    """Return the largest force of a ball of probes deep inside each primitive, over what its inner radius allows."""
    rng = np.random.default_rng(0)
    places, found = rng.normal(scale=0.004, size=(200, 3)), []
    for geom in GEOMS:
        touch = probed(places, geom, kind="kinematic_taxel", dtype=torch.float32)
        worst = 0.0
        for scale in (1e-12, 1e-3, 1.0):
            reading = touch(state(touch, pos=scale * np.array([0.001, -0.002, 0.0005])))["s"]
            size = float(reading[..., :3].norm(dim=-1).max()) if torch.isfinite(reading).all() else np.inf
            worst = max(worst, size / (500 * 0.1**1.2))
        found.append(worst)
    return HardCase(
        "deep overlap", "forces without bound, normals that are not finite", "force at 10 cm", "of that force", NAMES,
        {"float32": Allowed(np.array(found), 1.0)},
    )  # fmt: skip


def fast_spin(speed: float = 1000.0) -> HardCase:
    """Return how far the friction of a ball is off that spins over a probe inside it: v = ω × r."""
    errors: dict[str, Allowed] = {}
    for precision, dtype in DTYPES.items():
        touch = probed([(0.016, 0, 0)], '<geom type="sphere" size=".02"/>', kind="kinematic_taxel", dtype=dtype)
        reading = touch(state(touch, angvel=[0, 0, speed]))["s"][0, 0].double().numpy()
        exact = np.array([500 * 0.014**1.2, 2 * speed * 0.016, 0])
        off = np.abs(reading[:3] - exact) / np.where(exact == 0, np.finfo(float).tiny, np.abs(exact))
        errors[precision] = Allowed(off, 1e-12 if precision == "float64" else 1e-5)
    return HardCase(
        f"a spin of {speed:,.0f} rad/s", "velocity of the surface loses its digits", "k_t ω × r", "of the force",
        ("normal", "along", "across"), errors,
    )  # fmt: skip


def trembling(steps: int = 2000) -> HardCase:
    """Return by how much normals turn on faces, edges, corners and centres while poses tremble by 1 nm."""
    errors: dict[str, Allowed] = {}
    for precision, dtype in DTYPES.items():
        found = []
        for geom in GEOMS:
            places = [place for place, depth in HARD[geom] if depth > 0]
            touch = probed(places, geom, kind="kinematic_taxel", outputs=["force"], dtype=dtype)
            force = touch(jittered(state(touch), steps))["s"].double()
            way = force / force.norm(dim=2, keepdim=True)
            found.append(float((way - way[:1]).norm(dim=2).max()))
        errors[precision] = Allowed(np.array(found), 1e-3)
    return HardCase(
        "at rest on a tie, poses trembling by 1 nm",
        "the normal alternates between faces",
        "its first value",
        "rad",
        NAMES,
        errors,
    )


def sizes(scale: float) -> HardCase:
    """Return how far signed distances of primitives of a tiny or huge size are off, over the size.

    Places nearer to a tie than 1e-7 m count as on it, whatever the size: below 1 mm errors may be twice as much.
    """
    errors: dict[str, Allowed] = {}
    shapes = [(shape, np.array(size) * scale) for shape, size in (
        ("sphere", (1.0, 0, 0)), ("capsule", (0.5, 1.5, 0)), ("box", (1, 0.75, 1.5)), ("cylinder", (0.6, 1.5, 0)),
        ("ellipsoid", (1, 0.6, 1.5)), ("ellipsoid", (2.5, 0.05, 1)),
    )]  # fmt: skip
    rng = np.random.default_rng(3)
    for precision, dtype in DTYPES.items():
        found = []
        for shape, size in shapes:
            pos = (rng.uniform(-1.5, 1.5, (200, 3)) * (size + 0.2 * size.max())).astype(np.float32).astype(np.float64)
            whole = torch.tensor(size.astype(np.float32), dtype=dtype)
            distance, _ = SHAPES[shape](split(torch.tensor(pos, dtype=dtype)), split(whole))
            exact = np.array([signed_distance(shape, whole.double().numpy(), point)[0] for point in pos])
            found.append(np.abs(distance.double().numpy() - exact).max() / size.max())
        tie = 2 * TIE / scale if scale < 1e-3 else 0.0
        errors[precision] = Allowed(np.array(found), tie + (1e-12 if precision == "float64" else 1e-6))
    return HardCase(
        f"primitives of {scale:g} m", "squares underflow or overflow", "float64 definition", "of the size",
        tuple(f"{shape} {size[0]:g}" for shape, size in shapes), errors,
    )  # fmt: skip


def early_contact() -> HardCase:
    """Return how far a geometric gate's bit and depth are off at clearances around a probe's radius and threshold.

    With `gate: geometric` a probe of 4 mm fires 0.5 mm within its radius, whatever the rest of the link touches; with
    `gate: contact_pair` it needs the pair's contact in addition.
    """
    clearances = (0.0, 3.4e-3, 3.6e-3, 4.1e-3)
    found = []
    for gate, is_touching in (("geometric", 0.0), ("contact_pair", 1.0), ("contact_pair", 0.0)):
        for clearance in clearances:
            touch = probed(
                [(0, 0, 0.02 + clearance)], '<geom type="sphere" size=".02"/>', kind="contact", radius=0.004, gate=gate
            )
            scene = state(touch)
            if scene.contact_found is not None:
                scene.contact_found = torch.full_like(scene.contact_found, is_touching)
            exact = float(0.004 - clearance > 5e-4 and (gate == "geometric" or is_touching > 0))
            found.append(abs(float(touch(scene)["s"].item()) - exact))
    names = ("geometric", "pair in contact", "pair apart")
    return HardCase(
        "probes that reach before the surfaces meet", "a bit that fires for the wrong reason", BY_HAND, "bits",
        tuple(f"{name}, {1e3 * c:g} mm" for name in names for c in clearances), {"float64": Allowed(np.array(found), 0.0)},
        defects=(5,),
    )  # fmt: skip


def plate() -> trimesh.Trimesh:
    """Return a sheet of two sides that coincide."""
    corners = np.array([[-0.02, -0.015, 0], [0.02, -0.015, 0], [0.02, 0.015, 0], [-0.02, 0.015, 0]])
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]], process=False)


def needles() -> trimesh.Trimesh:
    """Return a wedge 40 mm long whose sides are triangles as thin as 1 to 4,000."""
    low = np.array([[0, 0, 0], [0.04, 0, 0], [0.04, 1e-5, 0]])
    faces = [[2, 1, 0], [3, 4, 5], [0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]]
    return trimesh.Trimesh(np.concatenate([low, low + [0, 0, 0.02]]), faces, process=False)


def twins() -> trimesh.Trimesh:
    """Return two boxes that share a face, both of whose copies are there."""
    parts = [trimesh.creation.box((0.02, 0.02, 0.02)).apply_translation((x, 0, 0)) for x in (-0.01, 0.01)]
    found = trimesh.util.concatenate(parts)
    assert isinstance(found, trimesh.Trimesh)
    return found


Probes = list[tuple[float, float, float]]
MESHES: dict[str, tuple[Callable[[], trimesh.Trimesh], Probes]] = {
    "plate": (plate, [(0.003, 0.002, 0.004), (0.003, 0.002, -0.004), (0.0215, 0.004, 0.0), (0.021, 0.016, 0.001)]),
    "needles": (needles, [(0.03, -0.003, 0.01), (0.03, 0.004, 0.01), (0.042, 0.0, 0.01), (0.0425, 0.0, 0.022)]),
    "twins": (twins, [(0.0, 0.004, 0.013), (0.0, 0.013, 0.0), (0.003, 0.002, 0.014), (0.0215, 0.0115, 0.0115)]),
}
"""The mesh, and probes beside it: over its middle, its edges and its corners [m]."""
TOLERANCE = 1e-4
"""Of distance grids around them [m]."""


def _to_segment(a: np.ndarray, b: np.ndarray, pos: np.ndarray) -> np.ndarray:
    part = ((pos - a) * (b - a)).sum(-1) / ((b - a) ** 2).sum(-1)
    return np.linalg.norm(pos - a - np.clip(part, 0, 1)[..., None] * (b - a), axis=-1)


def to_triangles(corners: np.ndarray, pos: np.ndarray) -> np.ndarray:
    """Return the distance to the nearest of triangles (triangle, 3, 3) [m], one triangle at a time."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    p = pos[:, None]
    best = np.minimum(np.minimum(_to_segment(a, b, p), _to_segment(b, c, p)), _to_segment(c, a, p))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    is_over = np.ones(best.shape, bool)
    for start, end in ((a, b), (b, c), (c, a)):
        is_over &= ((p - start) * np.cross(normal, end - start)).sum(-1) >= 0
    return np.where(is_over, np.abs(((p - a) * normal).sum(-1)), best).min(axis=1)


def hard_meshes(query: str) -> HardCase:
    """Return how far depths are off beside a sheet without thickness, needles, and faces that coincide."""
    errors: dict[str, Allowed] = {}
    for precision, dtype in DTYPES.items():
        found = []
        for make, probes in MESHES.values():
            geom = '<inertial pos="0 0 0" mass=".1" diaginertia="1e-4 1e-4 1e-4"/>'
            geom += '<geom type="mesh" mesh="item" contype="0" conaffinity="0"/>'
            with quiet():
                touch, scene = mesh_scene(
                    make(), np.array(probes), geoms=geom, dtype=dtype, surface="visual", query=query, tolerance=TOLERANCE
                )
                depth = touch(scene)["s"][0, :, 0].double().numpy()
            found.append(np.abs(depth - np.maximum(R - to_triangles(np.asarray(make().triangles), np.array(probes)), 0)).max())
        # Near creases a grid is held to five times its tolerance.
        errors[precision] = Allowed(np.array(found), 5 * TOLERANCE if query == "sdf" else 1e-6)
    return HardCase(
        f"sheets, needles, faces that coincide: query {query}", "no inside, triangles without area, ties",
        "the nearest triangle by brute force", "m", tuple(MESHES), errors,
    )  # fmt: skip


def turned_velocity() -> HardCase:
    """Return how far a rigid motion of link and object is from rest, whatever its spin: no relative velocity."""
    speeds, errors = (1e-6, 1.0, 1e3), dict[str, Allowed]()
    for precision, dtype in DTYPES.items():
        found = []
        for speed in speeds:
            touch = probed([(0.01, 0.004, 0.0)], '<geom type="box" size=".02 .02 .02"/>', kind="kinematic_taxel", dtype=dtype)
            still, moving = (state(touch, pos=[0, 0, 0.026]) for _ in range(2))
            spin, drift = speed * np.array([1.0, -2.0, 0.5]), speed * np.array([0.3, 0.1, -0.2])
            _turn(moving, spin, drift)
            apart = (touch(moving)["s"] - touch(still)["s"]).double().abs().max()
            found.append(float(apart) / (2 * speed * 0.05 + 0.66))
        errors[precision] = Allowed(np.array(found), 1e-12 if precision == "float64" else 1e-6)
    return HardCase(
        "link and object moving as one", "differences of large velocities", "the same at rest", "of the force",
        tuple(f"{speed:g} rad/s" for speed in speeds), errors,
    )  # fmt: skip


def _turn(scene: SceneState, spin: np.ndarray, drift: np.ndarray) -> None:
    assert scene.body_pos is not None and scene.body_linvel is not None and scene.body_angvel is not None
    for i in range(scene.body_pos.shape[1]):
        scene.body_angvel[0, i] = torch.tensor(spin)
        scene.body_linvel[0, i] = torch.tensor(drift + np.cross(spin, scene.body_pos[0, i].numpy()))


CASES: tuple[Case, ...] = (
    *(partial(depths_at_places, is_far) for is_far in (False, True)),
    grazing,
    deep_overlap,
    fast_spin,
    turned_velocity,
    trembling,
    *(partial(sizes, scale) for scale in (1e-6, 1e-3, 1e3)),
    early_contact,
    *(partial(hard_meshes, query) for query in ("sdf", "raycast")),
)

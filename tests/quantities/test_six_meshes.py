"""Six awkward meshes from file to reading: each query within its tolerance, against brute force over all triangles."""

import numpy as np
import pytest
import torch
import trimesh
from oracles.setups.brute import brute_force, to_segment

import tgdsl
from tgdsl.module.state import SceneState

TOLERANCE = 1e-4
EDGE_FACTOR = 5
"""Near sharp edges the bound is five times the tolerance."""
REACH = 0.008
NUM_POINTS = 1500


def box(*size):
    return trimesh.creation.box(size)


def ball(radius, subdivisions=3):
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)


def open_box():
    mesh = box(0.04, 0.03, 0.02)
    mesh.update_faces(mesh.face_normals[:, 2] < 0.5)
    return mesh


def slivers():
    """Return a box with one side cut into needles, as thin as 1 to 3,000."""
    cuts = -0.02 + np.array([0, 1e-5, 4e-5, 2e-4, 3e-3, 0.04])
    top = np.array([[-0.015, cuts[0], 0.01], *([0.015, y, 0.01] for y in cuts), [-0.015, 0.02, 0.01]])
    num = len(top)
    faces = [[0, k, k + 1] for k in range(1, num - 1)] + [[num, num + k + 1, num + k] for k in range(1, num - 1)]
    for k in range(num):
        n = (k + 1) % num
        faces += [[k, num + k, num + n], [k, num + n, n]]
    return trimesh.Trimesh(np.concatenate([top, top * [1, 1, -1]]), faces, process=False)


def nested():
    """Return a box around a ball of the same winding, like a fingertip around a screw: solid throughout."""
    return trimesh.util.concatenate([box(0.04, 0.03, 0.03), ball(0.006, 2)])


def bracket():
    """Return a concave L: a bar and an upright on its end."""
    outline = np.array([[-0.02, -0.01], [0.02, -0.01], [0.02, 0.0], [-0.01, 0.0], [-0.01, 0.02], [-0.02, 0.02]])
    faces = np.array([[0, 1, 3], [1, 2, 3], [0, 3, 5], [3, 4, 5]])
    num = len(outline)
    low, high = (np.column_stack([outline, np.full(num, z)]) for z in (-0.008, 0.008))
    sides = [[[k, (k + 1) % num, num + (k + 1) % num], [k, num + (k + 1) % num, num + k]] for k in range(num)]
    all_faces = np.concatenate([faces[:, ::-1], faces + num, np.reshape(sides, (-1, 3))])
    return trimesh.Trimesh(np.concatenate([low, high]), all_faces, process=False)


MESHES = {
    "ball": (lambda: ball(0.02), 1.0, None),
    "open box": (open_box, 1.0, lambda: box(0.04, 0.03, 0.02)),
    "slivers": (slivers, 1.0, None),
    "millimetres": (lambda: bracket().apply_scale(1000), 0.001, None),
    "inner shell": (nested, 1.0, lambda: box(0.04, 0.03, 0.03)),
    "bracket": (bracket, 1.0, None),
}
"""The mesh as filed, its scale, and the solid that it represents if its triangles do not bound it."""


def points_near(mesh: trimesh.Trimesh) -> np.ndarray:
    """Return points within reach of the surface, on both sides, half of them near edges."""
    rng = np.random.default_rng(0)
    on, _ = trimesh.sample.sample_surface(mesh, NUM_POINTS // 2, seed=1)
    edges = mesh.vertices[mesh.edges[rng.integers(0, len(mesh.edges), NUM_POINTS - len(on))]]
    along = rng.uniform(size=(len(edges), 1))
    on = np.concatenate([on, along * edges[:, 0] + (1 - along) * edges[:, 1]])
    direction = rng.normal(size=on.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return on + direction * rng.uniform(0, REACH, (len(on), 1))


def readings(folder, mesh, scale, points, **target):
    """Return the distance [m] that each probe reads, and the measured accuracy of the grid."""
    mesh.export(folder / "item.stl")
    (folder / "scene.xml").write_text(
        f'<mujoco><asset><mesh name="item" file="item.stl" scale="{scale} {scale} {scale}" inertia="shell"/></asset><worldbody>'
        '<body name="pad"><freejoint/><geom size=".05"/></body><body name="item"><freejoint/>'
        '<geom type="mesh" mesh="item"/></body></worldbody></mujoco>'
    )
    probes = [{"pos": point.tolist(), "normal": [0, 0, 1], "radius": REACH} for point in points]
    touch = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {
                "model": str(folder / "scene.xml"),
                "layout": {"resolutions": {"r": {"pad": {"method": "points", "points": probes}}}},
            },
            "objects": {"item": {"body": "item", "surface": "visual", **target}},
            "sensors": {"s": {"kind": "surface_distance", "links": "pad", "feels": ["item"], "max_range": 2 * REACH}},
        },
        dtype=torch.float64,
    )
    rest = torch.zeros(1, 2, 3, dtype=torch.float64)
    quat = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(1, 2, 4)
    state = SceneState(body_pos=rest, body_quat=quat)
    return touch(state)["s"][0, :, 0].numpy(), touch.plan.quantities["contact_depth"].geoms[0].accuracy[0][0]


def signed(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    distance, winding = brute_force(np.asarray(mesh.triangles), points)
    return np.where(winding > 0.5, -distance, distance)


def to_sharp_edge(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Return the distance [m] of each point to the nearest edge whose faces' normals differ by more than 30°."""
    merged = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    sharp = merged.face_adjacency_edges[merged.face_adjacency_angles > np.deg2rad(30)]
    if not len(sharp):
        return np.full(len(points), np.inf)
    ends = merged.vertices[sharp]
    return to_segment(ends[:, 0], ends[:, 1], points[:, None]).min(axis=1)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path / "cache"))


@pytest.mark.slow
@pytest.mark.parametrize("name", MESHES)
@pytest.mark.filterwarnings("ignore:object item. .* is not closed:UserWarning")
def test_a_grid_holds_its_tolerance_at_new_points(tmp_path, name):
    make, scale, solid = MESHES[name]
    represented = solid() if solid is not None else make().apply_scale(scale)
    points = points_near(represented)
    distances, accuracy = readings(tmp_path, make(), scale, points, tolerance=TOLERANCE)
    error = np.abs(distances - signed(represented, points))
    is_edge = to_sharp_edge(represented, points) < accuracy["cell"]
    assert np.percentile(error[~is_edge], 99) <= TOLERANCE
    assert not is_edge.any() or np.percentile(error[is_edge], 99) <= EDGE_FACTOR * TOLERANCE


@pytest.mark.slow
@pytest.mark.parametrize("name", MESHES)
@pytest.mark.filterwarnings("ignore:object item. .* is not closed:UserWarning")
def test_raycast_equals_brute_force(tmp_path, name):
    make, scale, solid = MESHES[name]
    mesh = solid() if solid is not None else make().apply_scale(scale)
    points = points_near(mesh)
    distances, _ = readings(tmp_path, make(), scale, points, query="raycast")
    np.testing.assert_allclose(distances, signed(mesh, points), rtol=0, atol=1e-6)

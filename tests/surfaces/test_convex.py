"""Depths inside convex solids, against closed forms, the float64 reference of primitives and hulls of known solids."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tgdsl.geometry.reference import signed_distance
from tgdsl.surfaces.convex import CHUNK, ConvexSolid, hull_planes
from tgdsl.surfaces.surface import Surface

ATOL = 1e-10  # [m] centimetres in float64, through a rotation and normals to twelve digits
POS, ROTATION = np.array([0.1, -0.2, 0.3]), Rotation.from_rotvec([0.4, -1.0, 0.7]).as_matrix()
SIZES = {
    "sphere": ([0.02, 0, 0], [0.02, 0.02, 0.02]),
    "capsule": ([0.01, 0.02, 0], [0.01, 0.01, 0.03]),
    "cylinder": ([0.01, 0.02, 0], [0.01, 0.01, 0.02]),
    "box": ([0.01, 0.02, 0.03], [0.01, 0.02, 0.03]),
    "ellipsoid": ([0.01, 0.02, 0.03], [0.01, 0.02, 0.03]),
}


def solid(shape: str, size: list[float], half: list[float], planes: np.ndarray | None = None) -> ConvexSolid:
    planes = np.zeros((0, 4)) if planes is None else planes
    return ConvexSolid(shape, np.array(size, dtype=float), POS, ROTATION, planes, -np.array(half), np.array(half))


def hull_of(points: np.ndarray) -> Surface:
    hull = trimesh.convex.convex_hull(points)
    return Surface(np.array(hull.vertices), np.array(hull.faces), np.zeros(len(hull.faces), dtype=np.int64), (("hull",),))


@pytest.mark.parametrize("shape", SIZES)
def test_depths_inside_primitives_match_the_reference(shape):
    size, half = SIZES[shape]
    local = np.random.default_rng(0).uniform(-1.2, 1.2, (300, 3)) * half
    expected = np.array([-signed_distance(shape, np.array(size), point)[0] for point in local])
    depth = solid(shape, size, half).depth(local @ ROTATION.T + POS)
    is_inside = expected > 1e-9
    assert 50 < is_inside.sum() < 250
    np.testing.assert_allclose(depth[is_inside], expected[is_inside], rtol=0, atol=ATOL)
    assert (depth[~is_inside] <= ATOL).all()


def test_depths_inside_a_hull_match_its_box():
    """Outside, the depth is negative and no more than the distance."""
    half = np.array([0.01, 0.02, 0.03])
    corners = half * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    inner = np.random.default_rng(1).uniform(-1, 1, (50, 3)) * half
    box = solid("mesh", [0, 0, 0], list(half), hull_planes(hull_of(np.concatenate([corners, inner]))))
    local = np.random.default_rng(2).uniform(-1.5, 1.5, (500, 3)) * half
    room = half - np.abs(local)
    depth = box.depth(local @ ROTATION.T + POS)
    is_inside = (room > 0).all(axis=1)
    np.testing.assert_allclose(depth[is_inside], room[is_inside].min(axis=1), rtol=0, atol=ATOL)
    distance = np.linalg.norm(np.maximum(-room, 0), axis=1)[~is_inside]
    assert (depth[~is_inside] < 0).all()
    near = np.isfinite(depth[~is_inside])
    assert (-depth[~is_inside][near] <= distance[near] + ATOL).all()


def test_sliver_faces_cut_nothing_off():
    """Faces between near-duplicate corners have arbitrary normals."""
    half = np.array([0.02, 0.02, 0.02])
    corners = half * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    faces = hull_of(corners)
    hair = 1e-9
    doubled = np.concatenate([faces.vertices, [faces.vertices[0] + [0, 0, hair]], [faces.vertices[0] + [hair, hair, 0]]])
    sliver = np.array([[0, len(faces.vertices), len(faces.vertices) + 1]])
    broken = Surface(
        doubled, np.concatenate([faces.faces, sliver, sliver[:, ::-1]]), np.zeros(len(faces.faces) + 2, int), ((),)
    )
    local = np.random.default_rng(3).uniform(-1, 1, (200, 3)) * half
    depth = solid("mesh", [0, 0, 0], list(half), hull_planes(broken)).depth(local @ ROTATION.T + POS)
    np.testing.assert_allclose(depth, (half - np.abs(local)).min(axis=1), rtol=0, atol=10 * hair)


def test_depths_of_no_points_and_of_far_points():
    ball = solid("sphere", [0.02, 0, 0], [0.02, 0.02, 0.02])
    assert ball.depth(np.zeros((0, 3))).shape == (0,)
    assert ball.depth(np.full((2, 3), 9.0)).tolist() == [-np.inf, -np.inf]


def test_chunked_depths_in_a_hull_match_all_its_planes():
    half = np.array([0.01, 0.02, 0.03])
    hull = hull_of(trimesh.creation.icosphere(subdivisions=4).vertices * half)
    planes = hull_planes(hull)
    local = np.random.default_rng(3).uniform(-1, 1, (5000, 3)) * half
    assert len(local) * len(planes) > 2 * CHUNK
    depth = solid("mesh", [0, 0, 0], list(half), planes).depth(local @ ROTATION.T + POS)
    expected = np.array([(planes[:, 3] - planes[:, :3] @ point).min() for point in local])
    np.testing.assert_allclose(depth, expected, rtol=0, atol=ATOL)

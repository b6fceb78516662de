"""Distances to meshes against brute force in float64: every triangle, and the exact generalized winding number."""

import copy
import gc
import pickle
import sys
import time

import numpy as np
import pytest
import torch
import trimesh
from oracles.setups.brute import brute_force

from tgdsl.errors import TgdslError
from tgdsl.geometry.bvh import ON_SURFACE, TriangleMesh, nearest

TOLERANCE = 1e-6
"""[m]. Meshes are about 0.1 m large, where float32 resolves 4e-9 m; the search may take a face 2e-6 of the size farther."""


def cube():
    mesh = trimesh.creation.box((0.06, 0.05, 0.04))
    return np.array(mesh.vertices), np.array(mesh.faces)


def icosphere(subdivisions=2):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.05)
    return np.array(mesh.vertices), np.array(mesh.faces)


def plate():
    vertices = np.array([[-0.05, -0.03, 0.01], [0.05, -0.03, 0.01], [0.05, 0.03, 0.01], [-0.05, 0.03, 0.01]])
    return vertices, np.array([[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]])


def needles():
    """A prism whose base has 0.1 m and 1e-5 m long edges, its sides cut along their diagonals."""
    low = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 1e-5, 0]])
    faces = [[2, 1, 0], [3, 4, 5], [0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]]
    return np.concatenate([low, low + [0, 0, 0.02]]), np.array(faces)


def fan():
    """A box one face of which is a fan of needles, as thin as aspect 1e4, about one of its corners."""
    rim = np.array([[0.05, y, 0.01] for y in -0.05 + np.array([1e-5, 3e-5, 1e-4, 1e-3, 1e-2])])
    top = np.array([[-0.05, -0.05, 0.01], [0.05, -0.05, 0.01], *rim, [0.05, 0.05, 0.01], [-0.05, 0.05, 0.01]])
    low = top * [1, 1, -1]
    num = len(top)
    faces = [[0, k, k + 1] for k in range(1, num - 1)] + [[num, num + k + 1, num + k] for k in range(1, num - 1)]
    for k in range(num):
        n = (k + 1) % num
        faces += [[k, num + k, num + n], [k, num + n, n]]
    return np.concatenate([top, low]), np.array(faces)


def open_cube():
    vertices, faces = cube()
    normal = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    return vertices, faces[normal[:, 2] <= 0]


def overlapping():
    vertices, faces = cube()
    other, more = icosphere(1)
    return np.concatenate([vertices, 0.6 * other + [0.03, 0.01, 0.005]]), np.concatenate([faces, more + len(vertices)])


def duplicates():
    vertices, faces = cube()
    return vertices, np.concatenate([faces, faces[:5], faces[2:4]])


def sheet():
    vertices, faces = plate()
    return vertices + [0.3, -0.2, 0.1], faces[:2]


CLOSED = [cube, icosphere, needles, fan, plate, overlapping]
MESHES = [*CLOSED, open_cube, duplicates, sheet]


def points_about(vertices, faces, seed=0, num=400):
    """Points near vertices, edges and faces, at many distances, on both sides; and anywhere, inside and far."""
    rng = np.random.default_rng(seed)
    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    weights = rng.dirichlet((1, 1, 1), num)
    weights[: num // 4] = np.eye(3)[rng.integers(0, 3, num // 4)]
    weights[num // 4 : num // 2, 0] = 0
    weights /= weights.sum(axis=1, keepdims=True)
    on = np.einsum("nk,nkd->nd", weights, vertices[faces[rng.integers(0, len(faces), num)]])
    direction = rng.normal(size=(num, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    near = on + direction * 10 ** rng.uniform(-6, -1.5, (num, 1))
    anywhere = rng.uniform(lower - 0.02, upper + 0.02, (num, 3))
    far = 0.5 * (lower + upper) + direction[: num // 4] * rng.uniform(0.2, 1.0, (num // 4, 1))
    return np.concatenate([near, anywhere, far])


def ask(mesh, points, max_distance=float("inf"), dtype=torch.float64):
    distance, gradient = nearest(torch.tensor(points, dtype=dtype).unbind(-1), [mesh], max_distance)
    return distance.numpy(), torch.stack(gradient, dim=-1).numpy()


@pytest.mark.parametrize("make", MESHES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_brute_force(make, dtype):
    vertices, faces = make()
    points = torch.tensor(points_about(vertices, faces), dtype=dtype).double().numpy()
    distance, gradient = ask(TriangleMesh(vertices, faces), points, dtype=dtype)
    expected, winding = brute_force(vertices[faces], points)
    is_outside = (points < vertices.min(axis=0)).any(axis=1) | (points > vertices.max(axis=0)).any(axis=1)
    is_inside = (winding > 0.5) & ~is_outside
    is_clear = (abs(winding - 0.5) > 0.02) | (make in CLOSED) | is_outside  # near an opening, the sign is approximate
    np.testing.assert_allclose(abs(distance), expected, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(distance[is_clear], np.where(is_inside, -expected, expected)[is_clear], rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1, rtol=0, atol=1e-5)
    assert (is_inside.any() or make in (plate, sheet, needles)) and is_clear.mean() > 0.9


@pytest.mark.parametrize("make", [cube, icosphere, fan, overlapping])
def test_gradient_leads_to_the_surface(make):
    vertices, faces = make()
    points = points_about(vertices, faces)
    distance, gradient = ask(TriangleMesh(vertices, faces), points)
    to_surface, _ = brute_force(vertices[faces], points - distance[:, None] * gradient)
    assert to_surface.max() < 1e-9


@pytest.mark.parametrize("offset", [0.0, 3e-9, -3e-9])
def test_face_normal_on_the_surface(offset):
    vertices, faces = cube()
    assert abs(offset) < ON_SURFACE * 0.08
    points = np.array([[0.01, 0.02, 0.02 + offset], [-0.03 - offset, 0.001, 0.003]])
    distance, gradient = ask(TriangleMesh(vertices, faces), points)
    np.testing.assert_allclose(distance, offset, rtol=0, atol=1e-12)
    np.testing.assert_allclose(gradient, [[0, 0, 1], [-1, 0, 0]], rtol=0, atol=1e-12)


def test_closed_form_in_the_cube():
    distance, gradient = ask(TriangleMesh(*cube()), np.array([[0.01, 0.0, 0.015], [0.033, 0.029, 0.0], [0.0, 0.0, 0.03]]))
    np.testing.assert_allclose(distance, [-0.005, 0.005, 0.01], rtol=0, atol=1e-12)
    np.testing.assert_allclose(gradient, [[0, 0, 1], [0.6, 0.8, 0], [0, 0, 1]], rtol=0, atol=1e-9)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_error_scales_with_the_mesh(scale):
    vertices, faces = icosphere()
    points = points_about(vertices, faces)
    small, _ = ask(TriangleMesh(vertices, faces), points)
    large, _ = ask(TriangleMesh(scale * vertices, faces), scale * points)
    np.testing.assert_allclose(large / scale, small, rtol=0, atol=TOLERANCE)


def test_backward_against_finite_differences():
    vertices, faces = icosphere()
    mesh = TriangleMesh(vertices, faces)
    points = points_about(vertices, faces, num=80)
    probe = torch.tensor(points, requires_grad=True)
    distance, gradient = nearest(probe.unbind(-1), [mesh], 0.1)
    assert not any(part.requires_grad for part in gradient)
    (analytic,) = torch.autograd.grad(distance.square().sum(), probe)
    step = 1e-7
    moved = [ask(mesh, points + side * step * axis, 0.1)[0] for axis in np.eye(3) for side in (1, -1)]
    numeric = np.stack([(moved[2 * k] ** 2 - moved[2 * k + 1] ** 2) / (2 * step) for k in range(3)], axis=-1)
    crease = [
        np.linalg.norm(ask(mesh, points + step * axis, 0.1)[1] - ask(mesh, points - step * axis, 0.1)[1], axis=1)
        for axis in np.eye(3)
    ]
    is_smooth = np.max(crease, axis=0) < 1e-2
    assert is_smooth.mean() > 0.9 and (distance.detach().numpy() == 0.1).any()
    np.testing.assert_allclose(analytic.numpy()[is_smooth], numeric[is_smooth], rtol=0, atol=1e-6)


def test_farther_than_the_reach():
    """Outside, distances end at the reach; inside they do not, so a deep contact keeps its depth and direction."""
    mesh = TriangleMesh(*cube())
    points = torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.0, 0.005], [0.0, 0.0, 0.021], [0.0, 0.0, torch.inf]], requires_grad=True)
    distance, gradient = nearest(points.unbind(-1), [mesh], 0.005)
    distance.sum().backward()
    torch.testing.assert_close(distance, torch.tensor([0.005, -0.015, 0.001, 0.005]), rtol=0, atol=1e-6)
    assert torch.stack(gradient, dim=-1).tolist() == [[1, 0, 0], [0, 0, 1], [0, 0, 1], [1, 0, 0]]
    assert points.grad is not None and points.grad.tolist() == [[0, 0, 0], [0, 0, 1], [0, 0, 1], [0, 0, 0]]


def test_nan():
    points = np.array([[np.nan, 0, 0], [0, 0, 0.03], [0, np.nan, np.inf]])
    distance, gradient = ask(TriangleMesh(*cube()), points)
    assert np.isnan(distance).tolist() == [True, False, True]
    assert np.isnan(gradient).all(axis=1).tolist() == [True, False, True]


@pytest.mark.parametrize("shape", [(), (0,), (4, 0), (7,), (4, 6), (2, 3, 5)])
def test_batch_shapes(shape):
    mesh = TriangleMesh(*cube())
    points = 0.05 * torch.randn(*shape, 3, generator=torch.Generator().manual_seed(0))
    distance, gradient = nearest(points.unbind(-1), [mesh], 1.0)
    flat, _ = nearest(points.reshape(-1, 3).unbind(-1), [mesh], 1.0)
    assert distance.shape == shape and all(part.shape == shape for part in gradient) and distance.dtype == torch.float32
    assert torch.equal(distance.reshape(-1), flat)


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda mesh: pickle.loads(pickle.dumps(mesh))])
def test_copies_build_anew(copied):
    vertices, faces = icosphere()
    points = points_about(vertices, faces)
    mesh = TriangleMesh(vertices, faces)
    expected, _ = ask(mesh, points)
    other = copied(mesh)
    assert other.key != mesh.key
    del mesh
    assert np.array_equal(ask(other, points)[0], expected)


def test_freed_meshes_are_refused():
    mesh = TriangleMesh(*cube())
    key = mesh.key
    point, which = torch.zeros(1, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.int32)
    torch.ops.tgdsl.mesh_distance(point, which, [key], 1.0)
    del mesh
    gc.collect()
    with pytest.raises(TgdslError, match="no longer exists; keep the TriangleMesh alive"):
        torch.ops.tgdsl.mesh_distance(point, which, [key], 1.0)


def test_operator_contract():
    meshes = [TriangleMesh(*cube()), TriangleMesh(*cube())]
    point = 0.1 * torch.randn(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for which in (torch.zeros(0, dtype=torch.int32), torch.tensor([0, 1, 1, 0, 1], dtype=torch.int32)):
        keys = [mesh.key for mesh in meshes[: 1 + len(which)]]
        torch.library.opcheck(torch.ops.tgdsl.mesh_distance, (point.requires_grad_(), which, keys, 1.0))


def test_each_point_asks_its_own_of_several_meshes():
    meshes = [TriangleMesh(factor * cube()[0], cube()[1]) for factor in (1.0, 0.5, 2.0)]
    points = 0.05 * torch.randn(4, 30, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    which = torch.tensor([2, 0, 1, 2])
    distance, gradient = nearest(points.unbind(-1), meshes, 1.0, which[:, None])
    for row, mesh in enumerate(which.tolist()):
        own, own_gradient = nearest(points[row].unbind(-1), [meshes[mesh]], 1.0)
        assert torch.equal(distance[row], own)
        assert torch.equal(torch.stack(gradient, -1)[row], torch.stack(own_gradient, -1))


def test_without_warp(monkeypatch):
    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(TgdslError) as error:
        TriangleMesh(*cube())
    assert str(error.value) == 'distances to meshes need NVIDIA Warp: pip install "tgdsl[raycast]"'


def test_quiet(capfd):
    mesh = TriangleMesh(*cube())
    ask(mesh, np.zeros((1, 3)))
    assert capfd.readouterr().out == ""


def test_many_points():
    """With 64 times the faces they take about 3 times as long, not 64 times."""
    points, seconds = 0.04 * np.random.default_rng(0).normal(size=(5_000, 3)), []
    for level in (2, 5):
        mesh = TriangleMesh(*icosphere(level))
        ask(mesh, points[:1])
        start = time.process_time()
        distance, _ = ask(mesh, points, dtype=torch.float32)
        seconds.append(time.process_time() - start)
    assert seconds[1] < 15 * seconds[0]
    np.testing.assert_allclose(distance, np.linalg.norm(points, axis=1) - 0.05, rtol=0, atol=5e-5)  # facets


@pytest.mark.slow
def test_compiled():
    mesh = TriangleMesh(*icosphere())

    def depth(x, y, z):
        distance, gradient = nearest((x, y, z), [mesh], 0.04)
        return torch.relu(0.01 - distance) * gradient[2], distance

    compiled = torch.compile(depth, fullgraph=True, dynamic=True, backend="aot_eager")
    for shape in [(4, 6), (3, 9), (2, 5)]:
        x, y, z = ((0.04 * torch.randn(shape)).requires_grad_() for _ in range(3))
        expected, found = depth(x, y, z), compiled(x, y, z)
        for a, b in zip(expected, found, strict=True):
            torch.testing.assert_close(a, b)
        slopes = torch.autograd.grad(expected[0].sum(), (x, y, z))
        for a, b in zip(slopes, torch.autograd.grad(found[0].sum(), (x, y, z)), strict=True):
            torch.testing.assert_close(a, b)

import itertools

import numpy as np
import pytest
import torch
from oracles import geometry

from tgdsl.geometry.reference import signed_distance
from tgdsl.geometry.shapes import SHAPES

SIZES = {
    "plane": [(1.0, 1.0, 0.1)],
    "sphere": [(0.02, 0.0, 0.0)],
    "capsule": [(0.01, 0.03, 0.0), (0.02, 0.001, 0.0)],
    "box": [(0.02, 0.015, 0.03), (0.02, 0.02, 0.02), (0.05, 0.04, 1e-4)],
    "cylinder": [(0.012, 0.03, 0.0), (0.05, 0.002, 0.0)],
    "ellipsoid": [(0.02, 0.012, 0.03), (0.02, 0.02, 0.01), (0.015, 0.015, 0.015), (0.05, 0.001, 0.02)],
}
CASES = [(shape, size) for shape, sizes in SIZES.items() for size in sizes]
DISTANCE_TOLERANCE = {torch.float64: 1e-12, torch.float32: 1e-6}
"""Of the shape's largest size: float64 to rounding, float32 to some eight roundings."""


def distances(shape: str, size: tuple[float, ...], points: np.ndarray, dtype: torch.dtype):
    return geometry.distances(shape, size, points, dtype)


def reference(shape: str, size: tuple[float, ...], points: np.ndarray):
    pairs = [signed_distance(shape, np.array(size), point) for point in points]
    return np.array([d for d, _ in pairs]), np.array([g for _, g in pairs])


def random_points(size: tuple[float, ...], count: int, seed: int = 0) -> np.ndarray:
    """Points all over the shape and around it, half of them near its bounding box."""
    rng = np.random.default_rng(seed)
    extent = np.array(size) + max(size) * 0.3
    return rng.uniform(-1, 1, (count, 3)) * extent * rng.uniform(0.2, 1.5, (count, 1))


def special_points(size: tuple[float, ...]) -> np.ndarray:
    """Centre, axes, planes of symmetry, faces, edges and corners of the bounding box, from inside and outside."""
    values = [[-1.5 * s, -s, -0.5 * s, 0.0, 0.5 * s, s, 1.5 * s] for s in size]
    return np.array(list(itertools.product(*values)))


@pytest.mark.parametrize(("shape", "size"), CASES)
def test_distance_and_gradient_are_those_of_the_nearest_surface_point(shape, size):
    points = np.concatenate([random_points(size, 400), special_points(size)]).astype(np.float32).astype(np.float64)
    expected, expected_gradient = reference(shape, size, points)
    for dtype, tolerance in DISTANCE_TOLERANCE.items():
        found, _ = distances(shape, size, points, dtype)
        assert np.abs(found - expected).max() <= tolerance * max(size)
    _, gradient = distances(shape, size, points[:400], torch.float64)
    assert np.abs(gradient - expected_gradient[:400]).max() < 1e-7


@pytest.mark.parametrize(("shape", "size"), [case for case in CASES if case[0] != "ellipsoid"])
def test_where_the_nearest_point_is_not_unique_the_convention_holds(shape, size):
    points = special_points(size)
    _, found = distances(shape, size, points, torch.float64)
    _, expected = reference(shape, size, points)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize(("shape", "size"), CASES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_gradient_is_a_unit_vector_everywhere(shape, size, dtype):
    tiny = 1e-30 * np.random.default_rng(0).normal(size=(50, 3))
    points = np.concatenate([random_points(size, 1000), special_points(size), tiny, 1e-12 + special_points(size)])
    distance, gradient = distances(shape, size, points, dtype)
    assert np.isfinite(distance).all()
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-5)


@pytest.mark.parametrize(("shape", "size"), CASES)
def test_autograd_gives_the_gradient(shape, size):
    p = torch.tensor(random_points(size, 500), requires_grad=True)
    s = torch.tensor(size, dtype=torch.float64)
    distance, gradient = SHAPES[shape](tuple(p.unbind(-1)), tuple(s.unbind(-1)))
    (derivative,) = torch.autograd.grad(distance.sum(), p)
    torch.testing.assert_close(derivative, torch.stack(gradient, dim=-1).detach(), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("shape", "size"), CASES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_derivatives_are_finite_everywhere(shape, size, dtype):
    p = torch.tensor(special_points(size), dtype=dtype, requires_grad=True)
    s = torch.tensor(size, dtype=dtype, requires_grad=True)
    distance, gradient = SHAPES[shape](tuple(p.unbind(-1)), tuple(s.unbind(-1)))
    total = distance.sum() + sum((part * (i + 1.0)).sum() for i, part in enumerate(gradient))
    for derivative in torch.autograd.grad(total, (p, s), allow_unused=True):
        assert derivative is None or torch.isfinite(derivative).all()


@pytest.mark.parametrize("size", SIZES["ellipsoid"])
def test_ellipsoid_derivative_with_respect_to_its_size(size):
    points = torch.tensor(random_points(size, 200))

    def distance(s: torch.Tensor) -> torch.Tensor:
        return SHAPES["ellipsoid"](tuple(points.unbind(-1)), tuple(s.unbind(-1)))[0]

    # One Newton step carries the derivative, but not where two equal axes exchange their roles.
    if len(set(size)) == 3:
        assert torch.autograd.gradcheck(
            distance, torch.tensor(size, dtype=torch.float64, requires_grad=True), eps=1e-9, atol=1e-4
        )


@pytest.mark.parametrize("least", range(3))
def test_the_reference_takes_the_positive_side_of_planes_of_symmetry(least):
    """From an ellipsoid's centre, both ends of its shortest axis are nearest."""
    size, axis = np.roll([0.01, 0.02, 0.03], least), np.eye(3)[least]
    distance, gradient = signed_distance("ellipsoid", size, np.zeros(3))
    assert distance == pytest.approx(-0.01)
    np.testing.assert_array_equal(gradient, axis)

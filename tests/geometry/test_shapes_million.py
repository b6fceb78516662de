"""A million points per primitive against an oracle that computes no distance: points are built at a known one.

A point X of a surface with outward normal n, moved by t along n, is at the distance t as long as X stays the nearest point: for
every t > 0 outside these convex shapes, and inside down to the depth where another part of the surface comes as near.
"""

import numpy as np
import pytest
import torch

from tgdsl.geometry.shapes import SHAPES

NUM = 1_000_000
CASES = [
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
]


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def surface_points(shape, size, rng, num):
    """Return points of the surface, outward normals there, and how deep X stays the nearest point."""
    size = np.array(size)
    if shape == "plane":
        return rng.uniform(-1, 1, (num, 3)) * [1, 1, 0], np.tile([0.0, 0.0, 1.0], (num, 1)), np.full(num, 1.0)
    if shape == "sphere":
        normal = unit(rng.normal(size=(num, 3)))
        return size[0] * normal, normal, np.full(num, size[0])
    if shape == "capsule":
        normal = unit(rng.normal(size=(num, 3)))
        on_wall = rng.random(num) < 0.5
        normal[on_wall] = unit(normal[on_wall] * [1, 1, 0])
        height = np.where(on_wall, rng.uniform(-1, 1, num), np.sign(normal[:, 2])) * size[1]
        return size[0] * normal + height[:, None] * [0, 0, 1], normal, np.full(num, size[0])
    if shape == "ellipsoid":
        surface = size * unit(rng.normal(size=(num, 3)))
        return surface, unit(surface / size**2), np.full(num, size.min() ** 2 / size.max())
    if shape == "box":
        return box_points(size, rng, num)
    return cylinder_points(size, rng, num)


def box_points(size, rng, num):
    inside = size * rng.uniform(-1, 1, (num, 3))
    normal = unit(np.abs(rng.normal(size=(num, 3)))) * rng.choice([-1.0, 1.0], (num, 3))
    fixed = rng.permuted(np.tile([True, False, False], (num, 1)), axis=1)  # which axes are at their end: a face,
    fixed |= rng.random((num, 3)) < 0.3  # an edge or a corner
    normal = unit(normal * fixed)
    surface = np.where(fixed, np.sign(normal) * size, inside)
    room = np.where(fixed, size, size - np.abs(inside)).min(axis=1)
    return surface, normal, np.where(fixed.sum(axis=1) == 1, room, 0.0)


def cylinder_points(size, rng, num):
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


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "size"), CASES)
def test_a_million_points_at_known_distances(shape, size):
    rng = np.random.default_rng(0)
    surface, normal, depth = surface_points(shape, size, rng, NUM)
    t = np.where(rng.random(NUM) < 0.5, rng.random(NUM) * max(size), -rng.random(NUM) * depth)
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-6)):
        points = torch.tensor(surface + t[:, None] * normal, dtype=dtype)
        distance, gradient = SHAPES[shape](tuple(points.unbind(-1)), tuple(torch.tensor(size, dtype=dtype).unbind(-1)))
        error = np.abs(distance.double().numpy() - t).max() / max(size)
        assert error < tolerance, f"{dtype}: {error:.1e} of its size"
        length = torch.stack(gradient).norm(dim=0)
        assert (length - 1).abs().max() < 1e-5
    is_clear = (t > 1e-6) | (t < -1e-6) & (-t < 0.9 * depth)
    if shape == "ellipsoid":  # near a plane of symmetry the sign of one small component is fixed: see `planes.tie`
        is_clear &= (np.abs(surface + t[:, None] * normal) > 1e-7).all(axis=1)
    direction = torch.stack(SHAPES[shape](*as_planes(surface + t[:, None] * normal, size))[1], dim=-1).numpy()
    np.testing.assert_allclose(direction[is_clear], normal[is_clear], atol=1e-8)


def as_planes(points, size):
    return tuple(torch.tensor(points).unbind(-1)), tuple(torch.tensor(size, dtype=torch.float64).unbind(-1))

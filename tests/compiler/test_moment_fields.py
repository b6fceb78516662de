"""Moments that are computed beforehand, against closed forms and sums of other making."""

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from surfaces import box, surface_of

import tgdsl.compiler.moments as moments
from tgdsl.compiler.clouds import sample_cloud
from tgdsl.compiler.felt import FeltGeom
from tgdsl.compiler.moments import bake_field, moment_sums, surface_area
from tgdsl.compiler.quadrature import outer_surface
from tgdsl.compiler.robot import Geom
from tgdsl.errors import BakeError
from tgdsl.geometry.moments import MomentField, PointCloud, cloud_moments, field_moments
from tgdsl.geometry.planes import split

R = 0.01
TOLERANCE, LIMIT = 0.008, 0.01
"""Of a field, and what it may err at points that are spread otherwise than the compiler's."""


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


def felt(shape, size, pos=(0, 0, 0), surface=None):
    whole = np.array([*size, 0, 0][:3], float)
    kind = "mesh" if surface is not None else shape
    return FeltGeom(Geom(0, "", "", "body", kind, whole, np.array(pos, float), np.eye(3), True), surface)


CUBE, BALL, CAN = felt("box", [0.02] * 3), felt("sphere", [0.02]), felt("cylinder", [0.012, 0.02])


def places(count=400, seed=5, reach=0.028):
    """Points all over a ball of another draw than the compiler's."""
    rng = np.random.default_rng(seed)
    way = rng.normal(size=(count, 3))
    return reach * np.cbrt(rng.uniform(size=(count, 1))) * way / np.linalg.norm(way, axis=1, keepdims=True)


def sphere_moments(pos, b=0.02, radius=R):
    """With D the distance of the centre: dA = 2π (b/D) r dr, and p − q has the part (D² + r² − b²) / 2D towards it."""
    found = []
    for q in pos:
        d = np.linalg.norm(q)
        low, high = abs(d - b), min(radius, d + b)
        mass, along = 0.0, 0.0
        if low < high:
            mass = 2 * np.pi * b / d * quad(lambda r: (radius - r) * r, low, high)[0]
            along = 2 * np.pi * b / d * quad(lambda r: (radius - r) * r * (d**2 + r**2 - b**2) / (2 * d), low, high)[0]  # noqa: B023
        found.append([mass, *(-along * q / d)])
    return np.array(found)


def box_moments(pos, half, radius=R, num=120):
    """A midpoint sum over each face, of a spacing of its own."""
    found = np.zeros((len(pos), 4))
    for axis in range(3):
        u, v = ((axis + k) % 3 for k in (1, 2))
        line = (np.arange(num) + 0.5) / num * 2 - 1
        grid = np.zeros((num * num, 3))
        grid[:, u], grid[:, v] = (part.ravel() for part in np.meshgrid(line * half[u], line * half[v]))
        area = 4 * half[u] * half[v] / num**2
        for sign in (-1, 1):
            grid[:, axis] = sign * half[axis]
            for i, q in enumerate(pos):
                way = grid - q
                weight = area * np.maximum(radius - np.sqrt((way**2).sum(axis=1)), 0)
                found[i] += [weight.sum(), *(weight @ way)]
    return found


def rms(found, true):
    """Root mean square errors of S0 and of S1 over full scale."""
    error = found - true
    full = np.abs(true[:, 0]).max(), np.linalg.norm(true[:, 1:4], axis=1).max()
    return np.sqrt(np.mean(error[:, 0] ** 2)) / full[0], np.sqrt(np.mean((error[:, 1:4] ** 2).sum(axis=1))) / full[1]


def sums(geoms, pos, radius=R, spacing=R / 8, channels=4):
    return moment_sums(outer_surface(geoms, spacing).quadrature(spacing), pos, radius, channels, 1)


def asked(baked, pos):
    """Return what a field reads, with slopes if it has them."""
    *num, channels = baked.values.shape
    place, cell = split(torch.tensor(baked.origin)), torch.tensor(baked.cell, dtype=torch.float64)
    flat = torch.tensor(baked.values.reshape(-1, channels), dtype=torch.float64)
    parts = []
    for start in range(0, channels, 4):
        mass, first = field_moments(
            split(torch.tensor(pos)), MomentField(flat[:, start : start + 4], 0, tuple(num), place, cell)
        )
        parts += [mass, *first]
    return torch.stack(parts, dim=1).numpy()


@pytest.mark.parametrize(
    ("geom", "area"),
    [
        (CUBE, 6 * 0.04**2),
        (BALL, 4 * np.pi * 0.02**2),
        (CAN, 2 * np.pi * 0.012**2 + 2 * np.pi * 0.012 * 0.04),
        (felt("capsule", [0.008, 0.02]), 4 * np.pi * 0.008**2 + 2 * np.pi * 0.008 * 0.04),
        (felt("ellipsoid", [0.02, 0.01, 0.01]), None),
    ],
)
def test_areas(geom, area):
    """The prolate ellipsoid: 2π b² (1 + a/(b e) arcsin e)."""
    e = np.sqrt(1 - 0.25)
    area = area or 2 * np.pi * 0.01**2 * (1 + 0.02 / (0.01 * e) * np.arcsin(e))
    assert surface_area([geom]) == pytest.approx(area, rel=1e-3)


def test_a_sphere_inside_and_outside():
    pos = places()
    true = sphere_moments(pos)
    assert (true[:, 0] > 0).sum() > 200 and (np.linalg.norm(pos, axis=1)[true[:, 0] > 0] < 0.02).sum() > 50
    assert max(rms(sums([BALL], pos), true)) < 2e-3
    assert max(rms(asked(bake_field([BALL], R, TOLERANCE), pos), true)) < LIMIT


def test_a_box_against_a_sum_of_its_faces():
    pos = places(150)
    true = box_moments(pos, [0.02, 0.015, 0.01])
    geom = felt("box", [0.02, 0.015, 0.01])
    assert max(rms(sums([geom], pos), true)) < 2e-3
    assert max(rms(asked(bake_field([geom], R, TOLERANCE), pos), true)) < LIMIT


@pytest.mark.parametrize("geoms", [[CAN], [felt("box", [0.02, 0.015, 0.01]), felt("sphere", [0.012], (0.015, 0, 0.01))]])
def test_fields_hold_the_tolerance_against_a_fine_surface(geoms):
    baked, pos = bake_field(geoms, R, TOLERANCE), places()
    found = rms(asked(baked, pos), sums(geoms, pos, spacing=R / 16))
    assert max(found) < LIMIT and baked.errors.mass_rms < TOLERANCE and baked.errors.first_rms < TOLERANCE


def test_the_mesh_of_a_cube_is_the_cube():
    mesh, pos = felt("", [0], surface=surface_of(box((0.04, 0.04, 0.04)))), places(150)
    np.testing.assert_allclose(sums([mesh], pos), sums([CUBE], pos), atol=1e-3 * sums([CUBE], pos)[:, 0].max())
    assert surface_area([mesh]) == pytest.approx(surface_area([CUBE]), rel=1e-9)
    true = box_moments(pos, [0.02] * 3)
    assert max(rms(asked(bake_field([mesh], R, TOLERANCE), pos), true)) < LIMIT


@pytest.mark.parametrize(
    "parts",
    [
        [([0.015, 0.01, 0.01], (-0.005, 0, 0)), ([0.015, 0.01, 0.01], (0.005, 0, 0))],
        [([0.01, 0.01, 0.01], (-0.01, 0, 0)), ([0.01, 0.01, 0.01], (0.01, 0, 0))],
        [([0.02, 0.01, 0.01], (0, 0, 0)), ([0.02, 0.01, 0.01], (0, 0, 0))],
        [([0.02, 0.01, 0.01], (0, 0, 0)), ([0.01, 0.005, 0.005], (0, 0, 0))],
    ],
    ids=["overlapping", "touching", "the same twice", "one within the other"],
)
def test_boxes_are_their_union(parts):
    geoms, whole = [felt("box", size, at) for size, at in parts], [felt("box", [0.02, 0.01, 0.01])]
    assert surface_area(geoms) == pytest.approx(surface_area(whole), rel=1e-3)
    pos = places(200)
    assert max(rms(sums(geoms, pos), box_moments(pos, [0.02, 0.01, 0.01]))) < 2e-3


def test_a_ball_in_a_face_leaves_its_disc_out():
    """A ball of 1 cm in the middle of a face: the cube less a disc, and half the ball."""
    area = surface_area([CUBE, felt("sphere", [0.01], (0, 0, 0.02))])
    assert area == pytest.approx(6 * 0.04**2 + np.pi * 0.01**2, rel=1e-3)


def test_derivatives_with_respect_to_the_radius():
    """The sums' slopes are the differences of the sums at R ± δ, and the field's are within a few percent of them."""
    pos, step = places(200), 2e-4
    slopes = sums([CUBE], pos, channels=8, spacing=R / 16)[:, 4:]
    up, down = (sums([CUBE], pos, radius=R + sign * step, spacing=R / 16) for sign in (1, -1))
    assert max(rms((up - down) / (2 * step), slopes)) < 5e-3
    baked = bake_field([CUBE], R, TOLERANCE, with_slope=True)
    assert baked.values.shape[-1] == 8
    assert max(rms(asked(baked, pos)[:, 4:], slopes)) < 0.03
    shifted = asked(baked, pos)[:, :4] + 5e-4 * asked(baked, pos)[:, 4:]
    true = sums([CUBE], pos, radius=R + 5e-4)
    assert max(rms(shifted, true)) < 0.02 < max(rms(asked(baked, pos)[:, :4], true))


def cloud_reads(cloud, pos, radius=R):
    points = np.concatenate([cloud.points, [[1e6] * 3]])
    x, y, z = (torch.tensor(part) for part in points.T.copy())
    place, cell = split(torch.tensor(cloud.origin)), torch.tensor(cloud.cell, dtype=torch.float64)
    weight = torch.tensor(cloud.weight, dtype=torch.float64)
    whole = PointCloud((x, y, z), weight, torch.tensor(cloud.lists), 0, cloud.num, place, cell)
    mass, first = cloud_moments(split(torch.tensor(pos)), whole, torch.full((len(pos),), radius, dtype=torch.float64))
    return torch.stack([mass, *first], dim=1).numpy()


def test_lists_hold_every_point_within_reach():
    cloud, pos = sample_cloud([CUBE], R, 3000), places(300, reach=0.05)
    for radius in (R, 0.6 * R):
        way = cloud.points[None] - pos[:, None]
        weight = cloud.weight * np.maximum(radius - np.linalg.norm(way, axis=2), 0)
        expected = np.concatenate([weight.sum(axis=1)[:, None], (weight[..., None] * way).sum(axis=1)], axis=1)
        np.testing.assert_allclose(cloud_reads(cloud, pos, radius), expected, atol=1e-13 * expected[:, 0].max())
    assert cloud.weight * 3000 == pytest.approx(6 * 0.04**2, rel=1e-9)


def test_the_papers_points_err_more_than_the_field():
    """Sampling noise: 20 times as many points err √20 times less, and both more than a field of half a percent."""
    pos = places(200)
    true = box_moments(pos, [0.02] * 3)
    few, many = (rms(cloud_reads(sample_cloud([CUBE], R, n), pos), true) for n in (5_000, 100_000))
    field = rms(asked(bake_field([CUBE], R, TOLERANCE), pos), true)
    assert 0.02 < few[0] < 0.1
    assert few[0] / many[0] == pytest.approx(np.sqrt(20), rel=0.4)
    assert field[0] < 0.2 * few[0] and field[1] < 0.4 * few[1]


def test_the_cache_gives_the_same_without_the_work(monkeypatch, tmp_path):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path))
    calls, real = [], moments.outer_surface
    monkeypatch.setattr(moments, "outer_surface", lambda *args: (calls.append(1), real(*args))[1])
    first = bake_field([BALL], R, 0.05)
    assert calls
    calls.clear()
    again = bake_field([BALL], R, 0.05)
    assert not calls and again.values.tobytes() == first.values.tobytes()
    assert (again.errors, again.cell) == (first.errors, first.cell) and (again.origin == first.origin).all()
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path / "other"))
    fresh = bake_field([BALL], R, 0.05)
    assert calls and fresh.values.tobytes() == first.values.tobytes() and fresh.errors == first.errors


def test_a_finer_tolerance_takes_more_bytes_and_has_smaller_errors():
    coarse, fine = bake_field([BALL], R, 0.05), bake_field([BALL], R, TOLERANCE)
    assert fine.values.nbytes > coarse.values.nbytes and fine.errors.first_rms < coarse.errors.first_rms


def test_what_cannot_be_computed():
    with pytest.raises(BakeError, match=r"at a radius of 10 mm needs about .* MiB \(\d+ bytes\), and the budget is 0.0954 MiB"):
        bake_field([BALL], R, TOLERANCE, budget=100_000)
    with pytest.raises(BakeError, match=r"needs a radius above 0 and a tolerance between 0 and 1, found 0\.0, 0\.008"):
        bake_field([BALL], 0.0, TOLERANCE)
    with pytest.raises(BakeError, match="there is no surface to bake moments of: planes are exact"):
        bake_field([felt("plane", [1, 1, 0.1])], R)
    with pytest.raises(BakeError, match=r"lists of 100000 points within 10 mm need .* and the budget is 0.954 MiB"):
        sample_cloud([BALL], R, 100_000, budget=10**6)

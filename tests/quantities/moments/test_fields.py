"""Moments that are computed beforehand, against closed forms and sums of other making."""

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from surfaces import box, surface_of

from tgdsl.compiler.felt import FeltGeom
from tgdsl.errors import BakeError
from tgdsl.geometry.planes import split
from tgdsl.quantities.moments import fields as moments
from tgdsl.quantities.moments.clouds import sample_cloud, sample_points
from tgdsl.quantities.moments.fields import bake_field, moment_sums, surface_area
from tgdsl.quantities.moments.moments import MomentField, PointCloud, cloud_moments, field_moments
from tgdsl.surfaces.geom import Geom
from tgdsl.surfaces.quadrature import outer_surface

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


def scalene_area(a, b, c):
    """Return the area of an ellipsoid by its parameters' fundamental form, summed with weights of Gauss and Legendre."""
    node, weight = np.polynomial.legendre.leggauss(200)
    u, v = (node[:, None] + 1) * np.pi / 2, (node + 1) * np.pi
    x, y, z = np.sin(u) * np.cos(v) * b * c, np.sin(u) * np.sin(v) * a * c, np.cos(u) * a * b + 0 * v
    form = np.sin(u) * np.sqrt(x**2 + y**2 + z**2)
    return float(weight @ form @ weight * np.pi / 2 * np.pi)


AREAS = {
    "sphere": ([0.025], 4 * np.pi * 0.025**2),
    "capsule": ([0.01, 0.02], 4 * np.pi * 0.01**2 + 2 * np.pi * 0.01 * 0.04),
    "cylinder": ([0.012, 0.02], 2 * np.pi * 0.012**2 + 2 * np.pi * 0.012 * 0.04),
    "box": ([0.01, 0.02, 0.03], 8 * (2 + 3 + 6) * 1e-4),
    "ellipsoid": ([0.01, 0.02, 0.035], scalene_area(0.01, 0.02, 0.035)),
    "ellipsoid of revolution": (
        [0.01, 0.01, 0.03],
        2 * np.pi * 0.01**2 * (1 + 3 / np.sqrt(8 / 9) * np.arcsin(np.sqrt(8 / 9))),
    ),
    "ellipsoid, almost a sphere": ([0.02, 0.02 + 1e-9, 0.02], 4 * np.pi * 0.02**2),
}


@pytest.mark.parametrize("name", AREAS)
def test_primitives_have_their_own_area_and_points_share_it_out(name):
    """Whatever the radius that pieces are made for: a point stands for A/N."""
    size, area = AREAS[name]
    geom = felt(name.split()[0].rstrip(","), size, pos=(0.1, -0.2, 0.3))
    assert surface_area([geom]) == pytest.approx(area, rel=1e-7 if "almost" in name else 1e-10)
    assert outer_surface([geom], 0.004).area.sum() == pytest.approx(area, rel=1e-7 if "almost" in name else 1e-10)
    assert sample_cloud([geom], 0.016, 200).weight * 200 == pytest.approx(surface_area([geom]), rel=1e-14)
    assert sample_points([geom], 50)[1] == pytest.approx(surface_area([geom]), rel=1e-14)


def test_a_union_has_one_area_too():
    """A ball and a box that share some of their insides: half of the ball's surface and the box's without a disc."""
    union = [felt("sphere", [0.02], pos=(0, 0, 0.03)), felt("box", [0.03] * 3)]
    assert sample_cloud(union, 0.016, 200).weight * 200 == pytest.approx(surface_area(union), rel=1e-14)
    assert surface_area(union) == pytest.approx(2 * np.pi * 0.02**2 + 24 * 0.03**2 - np.pi * 0.02**2, rel=1e-3)


def ball_gradients(pos, b=0.02, radius=R, step=1e-7):
    """The derivative of the closed form by the distance of the centre, along the way from it: all there is."""
    d = np.linalg.norm(pos, axis=1, keepdims=True)
    up, down = (sphere_moments(pos * (1 + sign * step / d), b, radius)[:, :1] for sign in (1, -1))
    return (up - down) / (2 * step) * pos / d


def gradients(baked, pos):
    flat = torch.tensor(baked.values[..., :4].reshape(-1, 4), dtype=torch.float64)
    place, cell = split(torch.tensor(baked.origin)), torch.tensor(baked.cell, dtype=torch.float64)
    x, y, z = baked.values.shape[:3]
    is_smooth = baked.errors.gradient_p999 is not None
    leaf = torch.tensor(pos, requires_grad=True)
    found = field_moments(split(leaf), MomentField(flat, 0, (x, y, z), place, cell, is_smooth))
    slope = torch.autograd.grad(found.mass.sum(), leaf)[0].numpy()
    return torch.stack([found.mass, *found.first], dim=1).detach().numpy(), slope


def test_gradients_hold_their_own_tolerance():
    """Around a ball, by the closed form: 99.9 % within it and the rest near, tangential parts too; a trilinear field's do not."""
    pos, asked_for = places(1500), 0.04
    true = ball_gradients(pos)
    full = np.linalg.norm(true, axis=1).max()
    errors = {}
    for limit in (None, asked_for):
        baked = bake_field([BALL], R, 0.05, limit)
        moments_found, slope = gradients(baked, pos)
        errors[limit] = np.linalg.norm(slope - true, axis=1) / full
        assert max(rms(moments_found, sphere_moments(pos))) < 0.06
    # These points are spread otherwise than the compiler's: more of them are a radius away from the surface.
    assert np.quantile(errors[asked_for], 0.999) < 1.5 * asked_for and errors[asked_for].max() < 2.5 * asked_for
    assert np.quantile(errors[None], 0.999) > 4 * asked_for
    assert baked.errors.gradient_p999 is not None and baked.errors.gradient_p999 < asked_for
    assert baked.errors.mass_rms < 0.01  # what holds the gradients holds the moments better still


def test_gradients_of_sums_are_differences_of_closed_forms():
    """Of S0 and of S1, around a ball."""
    pos, step = places(40), 1e-6
    fine = outer_surface([BALL], R / 30).quadrature(R / 30)
    found = moments.gradient_sums(fine, pos, R)
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        expected = (sphere_moments(pos + shift) - sphere_moments(pos - shift)) / (2 * step)
        for part in (slice(0, 1), slice(1, 4)):
            scale = np.linalg.norm(expected[:, part], axis=1).max()
            assert np.linalg.norm(found[:, part, axis] - expected[:, part], axis=1).max() < 0.01 * scale


def test_a_gradient_tolerance_over_the_budget_is_refused_by_name():
    with pytest.raises(BakeError, match=r"a tolerance of 0.05, and of 0.01 of its gradients, at a radius of 10 mm needs about"):
        bake_field([BALL], R, 0.05, 0.01, budget=100_000)

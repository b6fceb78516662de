"""Moments that are computed beforehand, against closed forms and sums of other making."""

import numpy as np
import pytest
import torch
from oracles.proximity import (
    AREAS,
    LIMIT,
    TOLERANCE,
    R,
    box_moments,
    cloud_reads,
    field_reads,
    geom_of,
    places,
    rms,
    sphere_moments,
    sums,
)  # fmt: skip
from oracles.setups.solids import box, surface_of

from tgdsl.errors import BakeError
from tgdsl.geometry.planes import split
from tgdsl.quantities import moment_fields
from tgdsl.quantities.moment_fields import bake_field, sample_cloud, sample_points, surface_area
from tgdsl.quantities.moment_sums import MomentField, field_moments
from tgdsl.surfaces.quadrature import outer_surface


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


CUBE, BALL, CAN = geom_of("box", [0.02] * 3), geom_of("sphere", [0.02]), geom_of("cylinder", [0.012, 0.02])


@pytest.mark.parametrize(
    ("geom", "area"),
    [
        (CUBE, 6 * 0.04**2),
        (BALL, 4 * np.pi * 0.02**2),
        (CAN, 2 * np.pi * 0.012**2 + 2 * np.pi * 0.012 * 0.04),
        (geom_of("capsule", [0.008, 0.02]), 4 * np.pi * 0.008**2 + 2 * np.pi * 0.008 * 0.04),
        (geom_of("ellipsoid", [0.02, 0.01, 0.01]), None),
    ],
)
def test_areas(geom, area):
    """The prolate ellipsoid: 2π b² (1 + a/(b e) arcsin e)."""
    e = np.sqrt(1 - 0.25)
    area = area or 2 * np.pi * 0.01**2 * (1 + 0.02 / (0.01 * e) * np.arcsin(e))
    assert surface_area([geom]) == pytest.approx(area, rel=1e-3)


@pytest.mark.slow
def test_a_sphere_inside_and_outside():
    pos = places()
    true = sphere_moments(pos)
    assert (true[:, 0] > 0).sum() > 200 and (np.linalg.norm(pos, axis=1)[true[:, 0] > 0] < 0.02).sum() > 50


@pytest.mark.slow
@pytest.mark.parametrize("geoms", [[CAN], [geom_of("box", [0.02, 0.015, 0.01]), geom_of("sphere", [0.012], (0.015, 0, 0.01))]])
def test_fields_hold_the_tolerance_against_a_fine_surface(geoms):
    baked, pos = bake_field(geoms, R, TOLERANCE), places()
    found = rms(field_reads(baked, pos), sums(geoms, pos, spacing=R / 16))
    assert max(found) < LIMIT and baked.errors.mass_rms < TOLERANCE and baked.errors.first_rms < TOLERANCE


@pytest.mark.slow
def test_the_mesh_of_a_cube_is_the_cube():
    mesh, pos = geom_of("", [0], surface=surface_of(box((0.04, 0.04, 0.04)))), places(150)
    np.testing.assert_allclose(sums([mesh], pos), sums([CUBE], pos), atol=1e-3 * sums([CUBE], pos)[:, 0].max())
    assert surface_area([mesh]) == pytest.approx(surface_area([CUBE]), rel=1e-9)
    true = box_moments(pos, [0.02] * 3)
    assert max(rms(field_reads(bake_field([mesh], R, TOLERANCE), pos), true)) < LIMIT


@pytest.mark.slow
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
    geoms, whole = [geom_of("box", size, at) for size, at in parts], [geom_of("box", [0.02, 0.01, 0.01])]
    assert surface_area(geoms) == pytest.approx(surface_area(whole), rel=1e-3)
    pos = places(200)
    assert max(rms(sums(geoms, pos), box_moments(pos, [0.02, 0.01, 0.01]))) < 2e-3


def test_a_ball_in_a_face_leaves_its_disc_out():
    """A ball of 1 cm in the middle of a face: the cube less a disc, and half the ball."""
    area = surface_area([CUBE, geom_of("sphere", [0.01], (0, 0, 0.02))])
    assert area == pytest.approx(6 * 0.04**2 + np.pi * 0.01**2, rel=1e-3)


@pytest.mark.slow
def test_derivatives_with_respect_to_the_radius():
    """The sums' slopes are the differences of the sums at R ± δ, and the field's are within a few percent of them."""
    pos, step = places(200), 2e-4
    slopes = sums([CUBE], pos, channels=8, spacing=R / 16)[:, 4:]
    up, down = (sums([CUBE], pos, radius=R + sign * step, spacing=R / 16) for sign in (1, -1))
    assert max(rms((up - down) / (2 * step), slopes)) < 5e-3
    baked = bake_field([CUBE], R, TOLERANCE, with_slope=True)
    assert baked.values.shape[-1] == 8
    assert max(rms(field_reads(baked, pos)[:, 4:], slopes)) < 0.03
    shifted = field_reads(baked, pos)[:, :4] + 5e-4 * field_reads(baked, pos)[:, 4:]
    true = sums([CUBE], pos, radius=R + 5e-4)
    assert max(rms(shifted, true)) < 0.02 < max(rms(field_reads(baked, pos)[:, :4], true))


def test_lists_hold_every_point_within_reach():
    cloud, pos = sample_cloud([CUBE], R, 3000), places(300, extent=0.05)
    for radius in (R, 0.6 * R):
        way = cloud.points[None] - pos[:, None]
        weight = cloud.weight * np.maximum(radius - np.linalg.norm(way, axis=2), 0)
        expected = np.concatenate([weight.sum(axis=1)[:, None], (weight[..., None] * way).sum(axis=1)], axis=1)
        np.testing.assert_allclose(cloud_reads(cloud, pos, radius), expected, atol=1e-13 * expected[:, 0].max())
    assert cloud.weight * 3000 == pytest.approx(6 * 0.04**2, rel=1e-9)


@pytest.mark.slow
def test_the_papers_points_err_more_than_the_field():
    """Sampling noise: 20 times as many points err √20 times less, and both more than a field of half a percent."""
    pos = places(200)
    true = box_moments(pos, [0.02] * 3)
    few = rms(cloud_reads(sample_cloud([CUBE], R, 5_000), pos), true)
    field = rms(field_reads(bake_field([CUBE], R, TOLERANCE), pos), true)
    assert 0.02 < few[0] < 0.1
    assert field[0] < 0.2 * few[0] and field[1] < 0.4 * few[1]


@pytest.mark.slow
def test_the_cache_gives_the_same_without_the_work(monkeypatch, tmp_path):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path))
    calls, real = [], moment_fields.outer_surface
    monkeypatch.setattr(moment_fields, "outer_surface", lambda *args: (calls.append(1), real(*args))[1])
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
    """The errors are as large as they are said to be: by the closed form, within a radius of the surface, of another draw."""
    coarse, fine = bake_field([BALL], R, 0.05), bake_field([BALL], R, TOLERANCE)
    assert fine.values.nbytes > coarse.values.nbytes and fine.errors.first_rms < coarse.errors.first_rms
    assert bake_field([BALL], R, 0.05).errors == coarse.errors  # from the cache
    way = np.random.default_rng(3).normal(size=(2, 150, 3))
    way /= np.linalg.norm(way, axis=2, keepdims=True)
    pos = 0.02 * way[0] + R * np.cbrt(np.linspace(0, 1, 150))[:, None] * way[1]
    true = sphere_moments(pos)
    for baked in (coarse, fine):
        assert (baked.errors.mass_rms, baked.errors.first_rms) == pytest.approx(rms(field_reads(baked, pos), true), rel=0.25)


def test_objects_of_metres_take_no_more_pieces_than_small_ones(monkeypatch):
    """A table with a leg: its area in closed form, of as many pieces as that of a hundredth of it."""
    counts = []

    def counted(geoms, spacing):
        found = outer_surface(geoms, spacing)
        counts.append(len(found.area))
        return found

    monkeypatch.setattr(moment_fields, "outer_surface", counted)
    for size in (4.0, 0.3):
        top, leg = geom_of("box", [size, size, size / 4]), geom_of("box", [size / 4] * 2 + [size], (0, 0, -size))
        # The leg is hidden down to a quarter of the size, and hides as much of the top's underside as its own lower end has.
        area = 8 * size**2 + 8 * size * size / 2 + 4 * (size / 2) * (7 / 4 * size)
        assert surface_area([top, leg]) == pytest.approx(area, rel=1e-3)
    assert counts[0] == counts[1] < 1e6


def test_a_field_that_no_budget_holds_is_refused_before_anything_is_summed(monkeypatch):
    """Two metres at a radius of 4 mm: 0.9 mm cells, 4 numbers of 4 bytes at each of 2250³ nodes."""
    monkeypatch.setattr(moment_fields, "outer_surface", None)
    with pytest.raises(BakeError, match=r"at a radius of 4 mm needs about 1\.7\de\+05 MiB"):
        bake_field([geom_of("box", [1.0, 1.0, 1.0])], 0.004)


@pytest.mark.slow
def test_what_cannot_be_computed():
    with pytest.raises(BakeError, match=r"at a radius of 10 mm needs about .* MiB \(\d+ bytes\), and the budget is 0.0954 MiB"):
        bake_field([BALL], R, TOLERANCE, budget=100_000)
    with pytest.raises(BakeError, match=r"needs a radius above 0 and a tolerance between 0 and 1, found 0\.0, 0\.008"):
        bake_field([BALL], 0.0, TOLERANCE)
    with pytest.raises(BakeError, match="there is no surface to bake moments of: planes are exact"):
        bake_field([geom_of("plane", [1, 1, 0.1])], R)
    with pytest.raises(BakeError, match=r"lists of 100000 points within 10 mm need .* and the budget is 0.954 MiB"):
        sample_cloud([BALL], R, 100_000, budget=10**6)


@pytest.mark.parametrize("name", AREAS)
def test_primitives_have_their_own_area_and_points_share_it_out(name):
    """Whatever the radius that pieces are made for: a point stands for A/N."""
    size, area = AREAS[name]
    geom = geom_of(name.split()[0].rstrip(","), size, pos=(0.1, -0.2, 0.3))
    assert outer_surface([geom], 0.004).area.sum() == pytest.approx(area, rel=1e-7 if "almost" in name else 1e-10)
    assert sample_cloud([geom], 0.016, 200).weight * 200 == pytest.approx(surface_area([geom]), rel=1e-14)
    assert sample_points([geom], 50)[1] == pytest.approx(surface_area([geom]), rel=1e-14)


def test_a_union_has_one_area_too():
    """A ball and a box that share some of their insides: half of the ball's surface and the box's without a disc."""
    union = [geom_of("sphere", [0.02], pos=(0, 0, 0.03)), geom_of("box", [0.03] * 3)]
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


@pytest.mark.slow
def test_gradients_hold_their_own_tolerance():
    """Around a ball, by the closed form: 99.9 % within it and the rest near, tangential parts too; a trilinear field's do not."""
    pos, asked_for = places(1500), 0.06
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


def test_gradients_alone_may_ask_for_a_finer_lattice_and_the_budget_counts_it(monkeypatch, tmp_path):
    """Around a ball, by the closed form; a byte less than that lattice takes is too few, though the one before it is smaller."""
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path))
    monkeypatch.setattr(moment_fields, "CHOICE_POINTS", 100)
    monkeypatch.setattr(moment_fields, "REPORT_POINTS", 100)
    ball, pos, asked_for = geom_of("sphere", [0.005]), places(60, extent=0.014), 0.2
    true = ball_gradients(pos, 0.005)
    baked = bake_field([ball], R, 0.2, asked_for)
    error = np.linalg.norm(gradients(baked, pos)[1] - true, axis=1) / np.linalg.norm(true, axis=1).max()
    assert error.max() < asked_for
    assert bake_field([ball], R, 0.2, asked_for).errors == baked.errors  # from the cache
    needed = baked.values.nbytes
    with pytest.raises(BakeError, match=rf"needs about .* MiB \({needed} bytes\), and the budget is"):
        bake_field([ball], R, 0.2, asked_for, budget=needed - 1)


def test_gradients_of_sums_are_differences_of_closed_forms():
    """Of S0 and of S1, around a ball."""
    pos, step = places(40), 1e-6
    fine = outer_surface([BALL], R / 30).quadrature(R / 30)
    found = moment_fields.gradient_sums(fine, pos, R)
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        expected = (sphere_moments(pos + shift) - sphere_moments(pos - shift)) / (2 * step)
        for part in (slice(0, 1), slice(1, 4)):
            scale = np.linalg.norm(expected[:, part], axis=1).max()
            assert np.linalg.norm(found[:, part, axis] - expected[:, part], axis=1).max() < 0.01 * scale


@pytest.mark.slow
def test_a_gradient_tolerance_over_the_budget_is_refused_by_name():
    with pytest.raises(BakeError, match=r"a tolerance of 0.05, and of 0.01 of its gradients, at a radius of 10 mm needs about"):
        bake_field([BALL], R, 0.05, 0.01, budget=100_000)

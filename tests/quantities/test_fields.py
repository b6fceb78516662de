"""Precomputed moments, against closed forms and independent sums."""

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
from tgdsl.surfaces.quadrature import Pieces, outer_surface


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
def test_areas_match_closed_forms(geom, area):
    """A prolate ellipsoid has 2π b² (1 + a/(b e) arcsin e)."""
    e = np.sqrt(1 - 0.25)
    area = area or 2 * np.pi * 0.01**2 * (1 + 0.02 / (0.01 * e) * np.arcsin(e))
    assert surface_area([geom]) == pytest.approx(area, rel=1e-3)


@pytest.mark.slow
def test_the_sampled_points_lie_on_both_sides_of_a_sphere():
    pos = places()
    expected = sphere_moments(pos)
    assert (expected[:, 0] > 0).sum() > 200 and (np.linalg.norm(pos, axis=1)[expected[:, 0] > 0] < 0.02).sum() > 50


@pytest.mark.slow
@pytest.mark.parametrize("geoms", [[CAN], [geom_of("box", [0.02, 0.015, 0.01]), geom_of("sphere", [0.012], (0.015, 0, 0.01))]])
def test_fields_hold_the_tolerance_against_a_fine_surface(geoms):
    baked, pos = bake_field(geoms, R, TOLERANCE), places()
    errors = rms(field_reads(baked, pos), sums(geoms, pos, spacing=R / 16))
    assert max(errors) < LIMIT and baked.errors.mass_rms < TOLERANCE and baked.errors.first_rms < TOLERANCE


@pytest.mark.slow
def test_a_meshed_cube_has_the_moments_of_a_cube():
    mesh, pos = geom_of("", [0], surface=surface_of(box((0.04, 0.04, 0.04)))), places(150)
    np.testing.assert_allclose(sums([mesh], pos), sums([CUBE], pos), atol=1e-3 * sums([CUBE], pos)[:, 0].max())
    assert surface_area([mesh]) == pytest.approx(surface_area([CUBE]), rel=1e-9)
    expected = box_moments(pos, [0.02] * 3)
    assert max(rms(field_reads(bake_field([mesh], R, TOLERANCE), pos), expected)) < LIMIT


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
def test_moments_of_boxes_match_their_union(parts):
    geoms, whole = [geom_of("box", size, at) for size, at in parts], [geom_of("box", [0.02, 0.01, 0.01])]
    assert surface_area(geoms) == pytest.approx(surface_area(whole), rel=1e-3)
    pos = places(200)
    assert max(rms(sums(geoms, pos), box_moments(pos, [0.02, 0.01, 0.01]))) < 2e-3


def test_the_area_of_a_union_leaves_out_inner_surfaces():
    """A ball of 1 cm at the centre of a cube's face replaces a disc by half a ball."""
    area = surface_area([CUBE, geom_of("sphere", [0.01], (0, 0, 0.02))])
    assert area == pytest.approx(6 * 0.04**2 + np.pi * 0.01**2, rel=1e-3)


@pytest.mark.slow
def pieces(pos: list[list[float]], normal: list[list[float]]) -> Pieces:
    """Return pieces without extent, of 1, 2, … m²."""
    at = np.array(pos, dtype=float)
    return Pieces(np.repeat(at[:, None], 3, axis=1), at, np.array(normal, dtype=float), np.arange(1.0, len(at) + 1))


def test_pieces_in_a_cube_of_half_the_spacing_share_a_point():
    """Cubes of 1 m from the lowest place: of 0, 0.5 and 0.9 m, and of 1.1 m."""
    points = pieces([[x, 0, 0] for x in (0.0, 0.5, 0.9, 1.1)], [[0, 0, 1]] * 4).quadrature(2.0)
    np.testing.assert_allclose(points.area, [1 + 2 + 3, 4])
    np.testing.assert_allclose(points.pos, [[(2 * 0.5 + 3 * 0.9) / 6, 0, 0], [1.1, 0, 0]])


def test_random_points_are_ordered_by_the_side_they_are_on():
    """Two sides face along z, up and down; their pieces alternate along x."""
    both = pieces([[x, 0, x % 2] for x in range(8)], [[0, 0, 2 * (x % 2) - 1] for x in range(8)])
    is_up = both.random_by_side(200, seed=0)[:, 2] > 0.5
    assert (np.diff(is_up) != 0).sum() == 1


def test_pieces_of_a_sphere_are_on_it_and_not_on_its_chords():
    ball = outer_surface([geom_of("sphere", [R])], R)
    np.testing.assert_allclose(np.linalg.norm(ball.pos, axis=1), R, rtol=1e-12)
    np.testing.assert_allclose(ball.normal, ball.pos / R, atol=1e-12)


def test_derivatives_with_respect_to_the_radius():
    """Slopes of sums equal differences of sums at R ± δ; those of the field are within a few percent."""
    pos, step = places(200), 2e-4
    slopes = sums([CUBE], pos, channels=8, spacing=R / 16)[:, 4:]
    up, down = (sums([CUBE], pos, radius=R + sign * step, spacing=R / 16) for sign in (1, -1))
    assert max(rms((up - down) / (2 * step), slopes)) < 5e-3
    baked = bake_field([CUBE], R, TOLERANCE, with_slope=True)
    assert baked.values.shape[-1] == 8
    assert max(rms(field_reads(baked, pos)[:, 4:], slopes)) < 0.03
    shifted = field_reads(baked, pos)[:, :4] + 5e-4 * field_reads(baked, pos)[:, 4:]
    expected = sums([CUBE], pos, radius=R + 5e-4)
    assert max(rms(shifted, expected)) < 0.02 < max(rms(field_reads(baked, pos)[:, :4], expected))


def test_lists_hold_every_point_within_reach():
    cloud, pos = sample_cloud([CUBE], R, 3000), places(300, extent=0.05)
    for radius in (R, 0.6 * R):
        offset = cloud.points[None] - pos[:, None]
        weight = cloud.weight * np.maximum(radius - np.linalg.norm(offset, axis=2), 0)
        expected = np.concatenate([weight.sum(axis=1)[:, None], (weight[..., None] * offset).sum(axis=1)], axis=1)
        np.testing.assert_allclose(cloud_reads(cloud, pos, radius), expected, atol=1e-13 * expected[:, 0].max())
    assert cloud.weight * 3000 == pytest.approx(6 * 0.04**2, rel=1e-9)


@pytest.mark.slow
def test_sampled_points_err_more_than_the_field():
    """The paper's points have sampling noise far above a field of half a percent."""
    pos = places(200)
    expected = box_moments(pos, [0.02] * 3)
    few = rms(cloud_reads(sample_cloud([CUBE], R, 5_000), pos), expected)
    field = rms(field_reads(bake_field([CUBE], R, TOLERANCE), pos), expected)
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
    cached = bake_field([BALL], R, 0.05)
    assert not calls and cached.values.tobytes() == first.values.tobytes()
    assert (cached.errors, cached.cell) == (first.errors, first.cell) and (cached.origin == first.origin).all()
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path / "other"))
    fresh = bake_field([BALL], R, 0.05)
    assert calls and fresh.values.tobytes() == first.values.tobytes() and fresh.errors == first.errors


def test_a_finer_tolerance_takes_more_bytes_and_has_smaller_errors():
    """Reported errors match those against the closed form at other points within a radius of the surface."""
    coarse, fine = bake_field([BALL], R, 0.05), bake_field([BALL], R, TOLERANCE)
    assert fine.values.nbytes > coarse.values.nbytes and fine.errors.first_rms < coarse.errors.first_rms
    assert bake_field([BALL], R, 0.05).errors == coarse.errors  # from the cache
    direction = np.random.default_rng(3).normal(size=(2, 150, 3))
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    pos = 0.02 * direction[0] + R * np.cbrt(np.linspace(0, 1, 150))[:, None] * direction[1]
    expected = sphere_moments(pos)
    for baked in (coarse, fine):
        assert (baked.errors.mass_rms, baked.errors.first_rms) == pytest.approx(
            rms(field_reads(baked, pos), expected), rel=0.25
        )


def test_objects_of_metres_take_no_more_pieces_than_small_ones(monkeypatch):
    """A large table with a leg has its closed-form area, from as many pieces as a small one."""
    counts = []

    def counted(geoms, spacing):
        pieces = outer_surface(geoms, spacing)
        counts.append(len(pieces.area))
        return pieces

    monkeypatch.setattr(moment_fields, "outer_surface", counted)
    for size in (4.0, 0.3):
        top, leg = geom_of("box", [size, size, size / 4]), geom_of("box", [size / 4] * 2 + [size], (0, 0, -size))
        # The leg's top is hidden down to a quarter of the size; it hides as much of the underside as its lower end adds.
        area = 8 * size**2 + 8 * size * size / 2 + 4 * (size / 2) * (7 / 4 * size)
        assert surface_area([top, leg]) == pytest.approx(area, rel=1e-3)
    assert counts[0] == counts[1] < 1e6


def test_a_field_over_its_budget_is_refused_before_any_work(monkeypatch):
    """Two metres at a radius of 4 mm: 0.9 mm cells, 16 bytes at each of 2250³ nodes."""
    monkeypatch.setattr(moment_fields, "outer_surface", None)
    with pytest.raises(BakeError, match=r"at a radius of 4 mm needs about 1\.7\de\+05 MiB"):
        bake_field([geom_of("box", [1.0, 1.0, 1.0])], 0.004)


@pytest.mark.slow
def test_requests_that_cannot_be_computed_are_refused():
    with pytest.raises(BakeError, match=r"at a radius of 10 mm needs about .* MiB \(\d+ bytes\), and the budget is 0.0954 MiB"):
        bake_field([BALL], R, TOLERANCE, budget=100_000)
    with pytest.raises(BakeError, match=r"needs a radius above 0 and a tolerance between 0 and 1, found 0\.0, 0\.008"):
        bake_field([BALL], 0.0, TOLERANCE)
    with pytest.raises(BakeError, match="there is no surface to bake moments of: planes are exact"):
        bake_field([geom_of("plane", [1, 1, 0.1])], R)
    with pytest.raises(BakeError, match=r"lists of 100000 points within 10 mm need .* and the budget is 0.954 MiB"):
        sample_cloud([BALL], R, 100_000, budget=10**6)


@pytest.mark.parametrize("name", AREAS)
def test_points_share_the_area_of_their_primitive(name):
    """Each of N points stands for A/N, whatever the radius of the pieces."""
    size, area = AREAS[name]
    geom = geom_of(name.split()[0].rstrip(","), size, pos=(0.1, -0.2, 0.3))
    assert outer_surface([geom], 0.004).area.sum() == pytest.approx(area, rel=1e-7 if "almost" in name else 1e-10)
    assert sample_cloud([geom], 0.016, 200).weight * 200 == pytest.approx(surface_area([geom]), rel=1e-14)
    assert sample_points([geom], 50)[1] == pytest.approx(surface_area([geom]), rel=1e-14)


def test_points_share_the_area_of_a_union():
    """A ball half inside a box: half the ball's surface, and the box's without a disc."""
    union = [geom_of("sphere", [0.02], pos=(0, 0, 0.03)), geom_of("box", [0.03] * 3)]
    assert sample_cloud(union, 0.016, 200).weight * 200 == pytest.approx(surface_area(union), rel=1e-14)
    assert surface_area(union) == pytest.approx(2 * np.pi * 0.02**2 + 24 * 0.03**2 - np.pi * 0.02**2, rel=1e-3)


def ball_gradients(pos, b=0.02, radius=R, step=1e-7):
    """Return gradients of the closed form: radial, by differences over the distance to the centre."""
    d = np.linalg.norm(pos, axis=1, keepdims=True)
    up, down = (sphere_moments(pos * (1 + sign * step / d), b, radius)[:, :1] for sign in (1, -1))
    return (up - down) / (2 * step) * pos / d


def gradients(baked, pos):
    flat = torch.tensor(baked.values[..., :4].reshape(-1, 4), dtype=torch.float64)
    place, cell = split(torch.tensor(baked.origin)), torch.tensor(baked.cell, dtype=torch.float64)
    x, y, z = baked.values.shape[:3]
    is_smooth = baked.errors.gradient_p999 is not None
    leaf = torch.tensor(pos, requires_grad=True)
    moments = field_moments(split(leaf), MomentField(flat, 0, (x, y, z), place, cell, is_smooth))
    slope = torch.autograd.grad(moments.mass.sum(), leaf)[0].numpy()
    return torch.stack([moments.mass, *moments.first], dim=1).detach().numpy(), slope


@pytest.mark.slow
def test_gradients_hold_their_tolerance():
    """Around a ball, 99.9 % are within it and the rest near, unlike those of a trilinear field."""
    pos, tolerance = places(1500), 0.06
    expected = ball_gradients(pos)
    full = np.linalg.norm(expected, axis=1).max()
    errors = {}
    for limit in (None, tolerance):
        baked = bake_field([BALL], R, 0.05, limit)
        moments, slope = gradients(baked, pos)
        errors[limit] = np.linalg.norm(slope - expected, axis=1) / full
        assert max(rms(moments, sphere_moments(pos))) < 0.06
    # More of these points than of the compiler's are a radius away from the surface.
    assert np.quantile(errors[tolerance], 0.999) < 1.5 * tolerance and errors[tolerance].max() < 2.5 * tolerance
    assert np.quantile(errors[None], 0.999) > 4 * tolerance
    assert baked.errors.gradient_p999 is not None and baked.errors.gradient_p999 < tolerance
    assert baked.errors.mass_rms < 0.01  # a grid fine enough for gradients is finer than moments need


def test_gradients_can_require_a_finer_lattice_within_the_budget(monkeypatch, tmp_path):
    """Around a ball, by the closed form; one byte less than that lattice needs is refused."""
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path))
    monkeypatch.setattr(moment_fields, "CHOICE_POINTS", 100)
    monkeypatch.setattr(moment_fields, "REPORT_POINTS", 100)
    ball, pos, tolerance = geom_of("sphere", [0.005]), places(60, extent=0.014), 0.2
    expected = ball_gradients(pos, 0.005)
    baked = bake_field([ball], R, 0.2, tolerance)
    error = np.linalg.norm(gradients(baked, pos)[1] - expected, axis=1) / np.linalg.norm(expected, axis=1).max()
    assert error.max() < tolerance
    assert bake_field([ball], R, 0.2, tolerance).errors == baked.errors  # from the cache
    needed = baked.values.nbytes
    with pytest.raises(BakeError, match=rf"needs about .* MiB \({needed} bytes\), and the budget is"):
        bake_field([ball], R, 0.2, tolerance, budget=needed - 1)


def test_gradients_of_sums_match_differences_of_closed_forms():
    """Gradients of S0 and S1 around a ball."""
    pos, step = places(40), 1e-6
    fine = outer_surface([BALL], R / 30).quadrature(R / 30)
    result = moment_fields.gradient_sums(fine, pos, R)
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        expected = (sphere_moments(pos + shift) - sphere_moments(pos - shift)) / (2 * step)
        for part in (slice(0, 1), slice(1, 4)):
            scale = np.linalg.norm(expected[:, part], axis=1).max()
            assert np.linalg.norm(result[:, part, axis] - expected[:, part], axis=1).max() < 0.01 * scale


@pytest.mark.slow
def test_a_gradient_tolerance_over_the_budget_is_refused_by_name():
    with pytest.raises(BakeError, match=r"a tolerance of 0.05, and of 0.01 of its gradients, at a radius of 10 mm needs about"):
        bake_field([BALL], R, 0.05, 0.01, budget=100_000)

"""Moments of the sensing ball's weight: closed forms, exact sums, derivatives."""

import numpy as np
import torch

from tgdsl.geometry.planes import split
from tgdsl.quantities.moment_sums import MomentField, PointCloud, cloud_moments, field_moments, plane_moments
from tgdsl.quantities.moments import percent


def planes_of(points):
    return split(torch.tensor(np.asarray(points, dtype=float)))


def test_a_plane_has_the_derivatives_of_its_integral():
    """dS0/dz is −2π d (R − d) sign z; an inactive probe reads 0 and has no slope."""
    height = torch.tensor([0.004, -0.004, 0.0, 0.02], dtype=torch.float64, requires_grad=True)
    zero = torch.zeros(4, dtype=torch.float64)
    mass, _ = plane_moments((zero, zero, height), torch.tensor(0.01, dtype=torch.float64))
    (slope,) = torch.autograd.grad(mass.sum(), height, retain_graph=True)
    expected = [-2 * np.pi * 0.004 * 0.006, 2 * np.pi * 0.004 * 0.006, 0, 0]
    np.testing.assert_allclose(slope.numpy(), expected, rtol=1e-12, atol=1e-20)
    off, _ = plane_moments((zero, zero, height), torch.zeros(4, dtype=torch.float64))
    assert (off == 0).all()


def linear_field(channels=4, tables=1):
    """Return random values of trilinear fields, zero at the border."""
    rng = np.random.default_rng(0)
    num, cell, origin = (7, 6, 8), 0.01, np.array([-0.03, -0.02, -0.04])
    values = np.zeros((tables, *num, channels))
    values[:, 1:-1, 1:-1, 1:-1] = rng.normal(size=(tables, 5, 4, 6, channels))
    return values, num, cell, origin


def module_field(values, num, cell, origin):
    flat = torch.tensor(values.reshape(-1, values.shape[-1]))
    return MomentField(flat, 0, num, split(torch.tensor(origin)), torch.tensor(cell, dtype=torch.float64))


def test_a_field_is_trilinear_and_zero_outside():
    from scipy.interpolate import RegularGridInterpolator

    values, num, cell, origin = linear_field()
    axes = [start + cell * np.arange(n) for start, n in zip(origin, num, strict=True)]
    points = np.random.default_rng(1).uniform(-0.06, 0.06, (500, 3))
    expected = RegularGridInterpolator(axes, values[0], bounds_error=False, fill_value=0.0)(points)
    mass, first = field_moments(planes_of(points), module_field(values[0], num, cell, origin))
    np.testing.assert_allclose(torch.stack([mass, *first], dim=1).numpy(), expected, atol=1e-13)
    assert (expected[:, 0] != 0).sum() > 50 and (expected[:, 0] == 0).sum() > 50


def test_each_point_reads_its_own_table():
    values, num, cell, origin = linear_field(tables=2)
    table = torch.tensor([0, 1, 1, 0])
    points = planes_of(np.random.default_rng(2).uniform(-0.02, 0.02, (4, 3)))
    counts = tuple(torch.tensor([n, n])[table] for n in num)
    place = torch.tensor(np.stack([origin, origin]))[table]
    field = MomentField(
        torch.tensor(values.reshape(-1, 4)),
        torch.tensor([0, int(np.prod(num))])[table],
        counts,
        split(place),
        torch.tensor([cell, cell], dtype=torch.float64)[table],
    )
    mass, _ = field_moments(points, field)
    alone = [field_moments(points, module_field(values[i], num, cell, origin)).mass for i in (0, 1)]
    torch.testing.assert_close(mass, torch.where(table == 0, *alone))


def test_a_shift_of_the_radius_is_first_order():
    values, num, cell, origin = linear_field(channels=8)
    field, points = module_field(values[0], num, cell, origin), planes_of([[0.001, 0.002, 0.003]])
    slopes = field_moments(points, field._replace(values=field.values[:, 4:]))
    plain = field_moments(points, field)
    mass, first = field_moments(points, field, torch.tensor([0.002], dtype=torch.float64))
    torch.testing.assert_close(mass, plain.mass + 0.002 * slopes.mass)
    torch.testing.assert_close(first[2], plain.first[2] + 0.002 * slopes.first[2])


def test_positions_that_are_nan_give_nan():
    values, num, cell, origin = linear_field()
    for where in range(3):
        point = [0.0, 0.0, 0.0]
        point[where] = np.nan
        mass, first = field_moments(planes_of([point]), module_field(values[0], num, cell, origin))
        assert mass.isnan().all() and first[0].isnan().all()
    assert plane_moments(planes_of([[0, 0, np.nan]]), torch.tensor(0.01, dtype=torch.float64)).mass.isnan().all()


def small_cloud():
    """Return eight points at the corners of a 2 mm cube, in the single list of the lattice with two fillers."""
    points = np.array([[x, y, z] for x in (0, 0.002) for y in (0, 0.002) for z in (0, 0.002)], float)
    rows = np.concatenate([points, [[1e6] * 3]]).T
    low = torch.full((3,), -0.01, dtype=torch.float64)
    cloud = PointCloud(
        split(torch.tensor(rows.T)), torch.tensor(0.5, dtype=torch.float64), torch.tensor([[0, 1, 2, 3, 4, 5, 6, 7, 8, 8]]), 0,
        (1, 1, 1), split(low), torch.tensor(0.022, dtype=torch.float64),
    )  # fmt: skip
    return points, cloud


def test_moments_of_a_cloud_are_sums_over_its_points():
    points, cloud = small_cloud()
    at = np.array([[0.001, 0.0005, 0.0], [0.0, 0.0, 0.0], [0.004, 0, 0], [0.1, 0, 0]])
    offset = points[None] - at[:, None]
    weight = 0.5 * np.maximum(0.003 - np.linalg.norm(offset, axis=2), 0)
    radius = torch.full((4,), 0.003, dtype=torch.float64)
    mass, first = cloud_moments(planes_of(at), cloud, radius)
    np.testing.assert_allclose(mass, weight.sum(axis=1), atol=1e-18)
    np.testing.assert_allclose(torch.stack(first, dim=1), (weight[..., None] * offset).sum(axis=1), atol=1e-20)
    assert (mass[:3] > 0).all() and mass[3] == 0


def test_a_point_on_a_sampled_point_has_finite_derivatives():
    _, cloud = small_cloud()
    at = torch.zeros((1, 3), dtype=torch.float64, requires_grad=True)
    mass, first = cloud_moments(split(at), cloud, torch.tensor([0.003], dtype=torch.float64))
    (slope,) = torch.autograd.grad(mass.sum() + sum(part.sum() for part in first), at)
    assert torch.isfinite(slope).all()
    away = torch.tensor([[0.0007, 0.0003, 0.0011]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda p: cloud_moments(split(p), cloud, torch.tensor([0.003], dtype=torch.float64)).mass, away, eps=1e-8, atol=1e-6
    )


def test_splines_match_scipy_and_have_continuous_slopes():
    """They are constant within half a cell of the border."""
    from scipy.ndimage import map_coordinates

    values, num, cell, origin = linear_field()
    field = module_field(values[0], num, cell, origin)._replace(is_smooth=True)
    points = np.random.default_rng(1).uniform(-0.06, 0.06, (500, 3))
    place = np.clip(((points - origin) / cell), 0.5, np.array(num) - 1.5)
    expected = [map_coordinates(values[0][..., c], place.T, order=2, prefilter=False, mode="nearest") for c in range(4)]
    mass, first = field_moments(planes_of(points), field)
    np.testing.assert_allclose(torch.stack([mass, *first]).numpy(), expected, atol=1e-13)
    leaf = torch.tensor(np.linspace([-0.02, 0.001, 0.002], [0.02, 0.011, -0.003], 4001), requires_grad=True)
    slope = torch.autograd.grad(field_moments(split(leaf), field).mass.sum(), leaf)[0].numpy()
    assert np.abs(np.diff(slope, axis=0)).max() < 0.01 * np.abs(slope).max()
    assert field_moments(planes_of([[0, np.nan, 0]]), field).mass.isnan().all()


def test_percentages_have_two_digits_and_no_exponent():
    assert [percent(share) for share in (1.23e-7, 0.0384, 1.234, 0.0)] == ["0.000012 %", "3.8 %", "120 %", "0 %"]

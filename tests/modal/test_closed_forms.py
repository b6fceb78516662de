"""Frequencies of bodies whose modes are known in closed form, or by Timoshenko's and Mindlin's theories where they are thicker.

Wave numbers κ = ω L/c with c = √(E/ρ) and the longest side L of the bounding box. Quadratic elements give a little too much:
tolerances are what their meshes leave, at most the 2 % asked for.
"""

import numpy as np
import pytest
from ringing_bodies import ball, box, breathing, lamb, surface_of, timoshenko, torsion, turned
from scipy.optimize import brentq

from tgdsl.modal import cells, grid
from tgdsl.modal.closed import closed
from tgdsl.modal.elasticity import Elements
from tgdsl.modal.spectrum import SIGHT, SLIVER, spectrum
from tgdsl.modal.vibration import vibration
from tgdsl.surfaces.surface import Surface


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path))


def all_modes(surface: Surface, cell: float, poissons_ratio: float, count: int) -> np.ndarray:
    """Return κ of all modes, those that are not heard too, on cells of a size over L."""
    vertices, faces = closed(surface)
    vertices = vertices / np.ptp(vertices, axis=0).max()
    vertices = vertices @ grid.axes(vertices, faces).T
    x, y, z = (
        grid.lines(grid.planes(vertices, faces, axis), vertices[:, axis].min(), vertices[:, axis].max(), cell)
        for axis in range(3)
    )
    filled, _ = cells.filled(vertices, faces, (x, y, z), SIGHT, SLIVER)
    return vibration(*Elements.of(filled).matrices(poissons_ratio), count).wave_number


def test_a_slender_free_beam():
    """(βL)² √(I/A)/L with cos βL cosh βL = 1; the beam's sides differ, so that each way of bending is a mode of its own."""
    length, height, width = 0.5, 0.0125, 0.008
    beta = [brentq(lambda b: np.cos(b) - 1 / np.cosh(b), low, low + 3.0) for low in (3.5, 6.5, 9.5)]
    assert beta == pytest.approx([4.73004, 7.85320, 10.99561], abs=1e-5)
    wanted = np.sort([b**2 * side / np.sqrt(12) / length for b in beta for side in (height, width)])
    found, size, _ = spectrum(surface_of(box(length, height, width)), 0.3, 12, 4000)
    assert size == length
    assert found.wave_number[:5] == pytest.approx(wanted[:5], rel=0.01)
    assert found.multiplicity[:5].tolist() == [1] * 5


def test_a_thick_beam_is_timoshenkos():
    """L/h = 8, where Bernoulli's third frequency is 20 % too high."""
    length, height = 1.0, 0.125
    wanted = timoshenko(length, height, height, 0.3, 5.0)[:3]
    assert timoshenko(1.0, 0.002, 0.002, 0.3, 0.1)[:2] == pytest.approx(
        np.array([4.73004, 7.85320]) ** 2 * 0.002 / 12**0.5, rel=1e-3
    )
    found, _, _ = spectrum(surface_of(box(length, height, height)), 0.3, 8, 4000)
    bending = found.wave_number[found.multiplicity == 2]
    assert bending[:3] == pytest.approx(wanted, rel=0.01)
    assert bending[2] < 0.85 * 10.99561**2 * height / np.sqrt(12)


def test_longitudinal_waves_of_a_rod():
    """κ = nπ; its ends are heard, and its sides a little, by Poisson's ratio."""
    found, _, _ = spectrum(surface_of(box(0.02, 0.8, 0.02)), 0.3, 24, 5000)
    for n in (1, 2):
        assert np.abs(found.wave_number / (n * np.pi) - 1).min() < 0.003


def test_lambs_equation():
    """The roots that are printed for some of Poisson's ratios."""
    assert [lamb(2, ratio, 4.0)[0] for ratio in (0.25, 0.3, 1 / 3)] == pytest.approx([2.6399, 2.6462, 2.6501], abs=1e-4)
    assert [breathing(ratio, 4.0)[0] for ratio in (0.25, 0.3)] == pytest.approx([2.5634, 2.6702], abs=1e-4)
    assert [torsion(n, 5.0)[0] for n in (2, 3)] == pytest.approx([2.5011, 3.8647], abs=1e-4)


@pytest.mark.parametrize("poissons_ratio", [0.0, 0.3, 0.4999])
def test_all_modes_of_a_ball(poissons_ratio):
    """All 27 to 35 from the lowest on, no more and no fewer: spheroidal ones by Lamb, and torsion of degree n, 2n + 1 of each.

    The last ratio hardly lets it compress, which elements of lower degree do not bear.
    """
    shear = 1 / np.sqrt(2 * (1 + poissons_ratio))
    each = [(2 * shear * root, 2 * n + 1) for n in (1, 2, 3, 4, 5) for root in lamb(n, poissons_ratio, 6.0) + torsion(n, 6.0)]
    compression = np.sqrt((1 - poissons_ratio) / ((1 + poissons_ratio) * (1 - 2 * poissons_ratio)))
    each += [(2 * compression * root, 1) for root in breathing(poissons_ratio, 4.0)]
    wanted = np.sort(np.concatenate([[wave_number] * times for wave_number, times in each]))
    found = all_modes(surface_of(ball(0.02)), 0.2, poissons_ratio, 24)
    assert found == pytest.approx(wanted[:24], rel=0.01)


def test_modes_of_one_frequency_are_one():
    """Of a ball, at the default resolution: spheroidal modes of degree 2, 1 and 3; torsion, 2.5011 c_s/a, is not heard."""
    shear = 1 / np.sqrt(2.6)
    found, size, _ = spectrum(surface_of(ball(0.02)), 0.3, 32)
    assert size == pytest.approx(0.04)
    wanted = [2 * shear * lamb(n, 0.3, 6.0)[0] for n in (2, 1, 3)]
    assert found.wave_number[:3] == pytest.approx(wanted, rel=3e-3)
    assert found.multiplicity[:3].tolist() == [5, 3, 7]
    assert np.abs(found.wave_number / (2 * shear * torsion(2, 4.0)[0]) - 1).min() > 0.02


def plate_frequencies(poissons_ratio: float, terms: int = 11) -> np.ndarray:
    """Return ωa²√(ρh/D) of a free square plate by Ritz's method with Legendre polynomials (Kirchhoff's theory), side a = 2."""
    polynomials = [np.polynomial.Legendre.basis(n) for n in range(terms)]
    points, weights = np.polynomial.legendre.leggauss(2 * terms)
    value, first, second = (np.array([p.deriv(k)(points) if k else p(points) for p in polynomials]) for k in (0, 1, 2))

    def product(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return (one * weights) @ other.T

    mass, slope, curve, cross = product(value, value), product(first, first), product(second, second), product(second, value)
    stiffness = (
        np.kron(curve, mass) + np.kron(mass, curve) + poissons_ratio * (np.kron(cross, cross.T) + np.kron(cross.T, cross))
    )
    stiffness += 2 * (1 - poissons_ratio) * np.kron(slope, slope)
    scale = 1 / np.sqrt(np.diag(np.kron(mass, mass)))
    squares = np.linalg.eigvalsh(stiffness * scale[:, None] * scale)
    return 4 * np.sqrt(squares[3:])


def test_a_thin_square_plate():
    """a/h = 50: 13.468, 19.596, 24.270, and 34.801 twice, as Leissa's 13.49, 19.79, 24.43, 35.02 are by a shorter series."""
    wanted = plate_frequencies(0.3)[:6]
    assert wanted[:4] == pytest.approx([13.468, 19.596, 24.270, 34.801], rel=1e-3)
    found, _, _ = spectrum(surface_of(box(0.2, 0.2, 0.004)), 0.3, 6, 6000)
    groups = np.repeat(found.wave_number, found.multiplicity) * np.sqrt(12 * (1 - 0.09)) / 0.02
    assert groups[:5] == pytest.approx(wanted[:5], rel=0.01)


def test_a_body_that_is_turned_and_moved():
    """Frequencies do not depend on where a body is in its frame, nor on how it is turned."""
    found, _, _ = spectrum(surface_of(box(0.05, 0.03, 0.02)), 0.3, 6, 4000)
    moved, _, middle = spectrum(surface_of(turned(box(0.05, 0.03, 0.02), (0.3, 0.8, -0.4), (0.1, 0.2, 3.0))), 0.3, 6, 4000)
    size = np.ptp(turned(box(0.05, 0.03, 0.02), (0.3, 0.8, -0.4), (0, 0, 0)).vertices, axis=0).max()
    assert moved.wave_number / size == pytest.approx(found.wave_number / 0.05, rel=1e-6)
    assert moved.gain == pytest.approx(found.gain, rel=1e-5)
    assert middle == pytest.approx([0.1, 0.2, 3.0])

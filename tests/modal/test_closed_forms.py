"""Frequencies of bodies whose modes are known in closed form, or by Timoshenko's and Mindlin's theories where they are thicker.

Wave numbers κ = ω L/c with c = √(E/ρ) and the longest side L of the bounding box. Quadratic elements give a little too much:
tolerances are what their meshes leave, at most the 2 % asked for.
"""

import numpy as np
import pytest
from oracles import modes as oracles
from oracles.setups.solids import ball, box, breathing, lamb, surface_of, timoshenko, torsion
from ringing_bodies import turned

from tgdsl.modal.analysis import spectrum


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path))


def test_a_slender_free_beam():
    """(βL)² √(I/A)/L with cos βL cosh βL = 1; the beam's sides differ, so that each way of bending is a mode of its own."""
    beta = np.array([4.73004, 7.85320, 10.99561])
    found = oracles.slender_beam()
    wanted = np.sort([b**2 * side / np.sqrt(12) / 0.5 for b in beta for side in (0.0125, 0.008)])
    assert found.exact == pytest.approx(wanted[:5], rel=1e-5)


def test_a_thick_beam_is_timoshenkos():
    """L/h = 8, where Bernoulli's third frequency is 20 % too high."""
    assert timoshenko(1.0, 0.002, 0.002, 0.3, 0.1)[:2] == pytest.approx(
        np.array([4.73004, 7.85320]) ** 2 * 0.002 / 12**0.5, rel=1e-3
    )
    found = oracles.thick_beam()
    assert found.ours[2] < 0.85 * 10.99561**2 * 0.125 / np.sqrt(12)


def test_lambs_equation():
    """The roots that are printed for some of Poisson's ratios."""
    assert [lamb(2, ratio, 4.0)[0] for ratio in (0.25, 0.3, 1 / 3)] == pytest.approx([2.6399, 2.6462, 2.6501], abs=1e-4)
    assert [breathing(ratio, 4.0)[0] for ratio in (0.25, 0.3)] == pytest.approx([2.5634, 2.6702], abs=1e-4)
    assert [torsion(n, 5.0)[0] for n in (2, 3)] == pytest.approx([2.5011, 3.8647], abs=1e-4)


def test_modes_of_one_frequency_are_one():
    """Of a ball: spheroidal modes of degree 2, 1 and 3; torsion, 2.5011 c_s/a, is not heard."""
    shear = 1 / np.sqrt(2.6)
    found, size, _ = spectrum(surface_of(ball(0.02)), 0.3, 22, 12_000)
    assert size == pytest.approx(0.04)
    wanted = [2 * shear * lamb(n, 0.3, 6.0)[0] for n in (2, 1, 3)]
    assert found.wave_number[:3] == pytest.approx(wanted, rel=3e-3)
    assert found.multiplicity[:3].tolist() == [5, 3, 7]
    assert np.abs(found.wave_number / (2 * shear * torsion(2, 4.0)[0]) - 1).min() > 0.02


def test_a_thin_square_plate():
    """a/h = 50: 13.468, 19.596, 24.270, and 34.801 twice, as Leissa's 13.49, 19.79, 24.43, 35.02 are by a shorter series."""
    found = oracles.square_plate()
    assert found.exact[:4] == pytest.approx([13.468, 19.596, 24.270, 34.801], rel=1e-3)


def test_a_body_that_is_turned_and_moved():
    """Frequencies do not depend on where a body is in its frame, nor on how it is turned."""
    found, _, _ = spectrum(surface_of(box((0.05, 0.03, 0.02))), 0.3, 6, 4000)
    moved, _, middle = spectrum(surface_of(turned(box((0.05, 0.03, 0.02)), (0.3, 0.8, -0.4), (0.1, 0.2, 3.0))), 0.3, 6, 4000)
    size = np.ptp(turned(box((0.05, 0.03, 0.02)), (0.3, 0.8, -0.4), (0, 0, 0)).vertices, axis=0).max()
    assert moved.wave_number / size == pytest.approx(found.wave_number / 0.05, rel=1e-6)
    assert moved.gain == pytest.approx(found.gain, rel=1e-5)
    assert middle == pytest.approx([0.1, 0.2, 3.0])

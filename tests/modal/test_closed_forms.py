"""The closed forms of `oracles` against textbooks, and modes of symmetric and of moved bodies.

Wave numbers κ = ω L/c use c = √(E/ρ) and the longest side L of the bounding box. Quadratic elements overestimate them a little:
tolerances are the errors of their meshes, at most the required 2 %.
"""

import numpy as np
import pytest
from oracles.setups.solids import ball, box, breathing, lamb, plate_frequencies, roots, surface_of, timoshenko, torsion
from ringing_bodies import turned

from tgdsl.modal.analysis import spectrum


@pytest.fixture(autouse=True)
def shared_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


def test_closed_forms_match_textbooks():
    """Timoshenko's beam equals Bernoulli's if slender, and is 15 % below at L/h = 8; the plate's a/h is 50.

    Leissa's shorter series gives 13.49, 19.79, 24.43 and 35.02 for the plate; Lamb's roots are printed for these Poisson's ratios.
    """
    beta = np.array([4.73004, 7.85320, 10.99561])
    assert roots(lambda b: np.cos(b) - 1 / np.cosh(b), 3.5, 12.0) == pytest.approx(beta, rel=1e-5)
    assert timoshenko(1.0, 0.002, 0.002, 0.3, 0.1)[:2] == pytest.approx(beta[:2] ** 2 * 0.002 / 12**0.5, rel=1e-3)
    assert timoshenko(1.0, 0.125, 0.125, 0.3, 5.0)[2] < 0.85 * beta[2] ** 2 * 0.125 / np.sqrt(12)
    assert plate_frequencies(0.3)[:4] == pytest.approx([13.468, 19.596, 24.270, 34.801], rel=1e-3)
    assert [lamb(2, ratio, 4.0)[0] for ratio in (0.25, 0.3, 1 / 3)] == pytest.approx([2.6399, 2.6462, 2.6501], abs=1e-4)
    assert [breathing(ratio, 4.0)[0] for ratio in (0.25, 0.3)] == pytest.approx([2.5634, 2.6702], abs=1e-4)
    assert [torsion(n, 5.0)[0] for n in (2, 3)] == pytest.approx([2.5011, 3.8647], abs=1e-4)


def test_modes_of_one_frequency_are_merged():
    """A ball has spheroidal modes of degree 2, 1 and 3; torsion, 2.5011 c_s/a, is inaudible."""
    shear = 1 / np.sqrt(2.6)
    modes, size, _ = spectrum(surface_of(ball(0.02)), 0.3, 22, 12_000)
    assert size == pytest.approx(0.04)
    expected = [2 * shear * lamb(n, 0.3, 6.0)[0] for n in (2, 1, 3)]
    assert modes.wave_number[:3] == pytest.approx(expected, rel=3e-3)
    assert modes.multiplicity[:3].tolist() == [5, 3, 7]
    assert np.abs(modes.wave_number / (2 * shear * torsion(2, 4.0)[0]) - 1).min() > 0.02


def test_moving_a_body_keeps_its_frequencies():
    modes, _, _ = spectrum(surface_of(box((0.05, 0.03, 0.02))), 0.3, 6, 1000)
    moved, _, middle = spectrum(surface_of(turned(box((0.05, 0.03, 0.02)), (0.3, 0.8, -0.4), (0.1, 0.2, 3.0))), 0.3, 6, 1000)
    size = np.ptp(turned(box((0.05, 0.03, 0.02)), (0.3, 0.8, -0.4), (0, 0, 0)).vertices, axis=0).max()
    assert moved.wave_number / size == pytest.approx(modes.wave_number / 0.05, rel=1e-6)
    assert moved.gain == pytest.approx(modes.gain, rel=1e-5)
    assert middle == pytest.approx([0.1, 0.2, 3.0])

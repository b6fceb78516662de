"""Gains of modes of one frequency do not depend on how the solver mixes them."""

import numpy as np
import pytest
from scipy.stats import ortho_group

from tgdsl.modal.modes import MERGE_TOLERANCE, Loudness, groups, loudness, of_groups


def shapes(num: int = 6, points: int = 40) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    return rng.standard_normal((points, num)), rng.uniform(0.5, 2.0, points)


def share(result: Loudness, normal: np.ndarray) -> np.ndarray:
    return of_groups(normal @ result.mixture, result.owner, len(result.gain))


def test_groups():
    near = 1 + 0.5 * MERGE_TOLERANCE
    assert groups(np.array([1.0, near, 1.5, 2.0, 2 * near, 2 + 1.9 * MERGE_TOLERANCE])) == [
        slice(0, 2),
        slice(2, 3),
        slice(3, 6),
    ]
    assert groups(np.zeros(0)) == []


def test_mixing_equal_modes_keeps_their_loudness():
    normal, area = shapes()
    wave_number = np.array([1.0, 1.0, 1.0, 2.0, 3.0, 4.0])
    first = loudness(wave_number, normal, area, 2.0)
    mixed = normal.copy()
    mixed[:, :3] = normal[:, :3] @ ortho_group.rvs(3, random_state=1)
    second = loudness(wave_number, mixed, area, 2.0)
    assert first.multiplicity.tolist() == [3, 1, 1], "the last may lack some of its modes"
    assert second.gain == pytest.approx(first.gain, rel=1e-12)
    assert share(second, mixed) == pytest.approx(share(first, normal), abs=1e-12)


def test_signs_do_not_depend_on_the_solver():
    normal, area = shapes()
    wave_number = np.arange(1.0, 7.0)
    flipped = loudness(wave_number, -normal, area, 1.0)
    assert share(flipped, -normal) == pytest.approx(share(loudness(wave_number, normal, area, 1.0), normal))


def test_gains_match_a_response_in_modal_coordinates():
    """An impulse at a point gives each mode q̇ = φ(x) J: root mean squares over the surface, then over the struck points."""
    normal, area = shapes()
    mass, equal = 3.0, slice(0, 3)
    result = loudness(np.array([1.0, 1.0, 1.0, 2.0, 3.0, 4.0]), normal, area, mass)
    velocity = normal[:, equal] @ normal[:, equal].T  # of y per impulse at x
    heard = np.sqrt(area @ velocity**2 / area.sum())
    shares = share(result, normal)
    assert result.gain[0] / mass * shares[:, 0] == pytest.approx(heard)
    assert result.gain[0] / mass == pytest.approx(np.sqrt(area @ heard**2 / area.sum()))
    assert np.sqrt(area @ shares**2 / area.sum()) == pytest.approx(np.ones(3))


@pytest.mark.parametrize("part", [1e-3, 0.0])
def test_modes_that_do_not_move_along_the_normal_are_dropped(part):
    normal, area = shapes()
    normal[:, 1] *= part
    assert loudness(np.arange(1.0, 7.0), normal, area, 1.0).wave_number == pytest.approx([1.0, 3.0, 4.0, 5.0])

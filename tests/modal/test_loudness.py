"""Gains of modes of one frequency do not depend on which of their mixtures were found."""

import numpy as np
import pytest
from scipy.stats import ortho_group

from tgdsl.modal.modes import MERGE_TOLERANCE, Loudness, groups, loudness, of_groups


def shapes(num: int = 6, points: int = 40) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    return rng.standard_normal((points, num)), rng.uniform(0.5, 2.0, points)


def share(found: Loudness, normal: np.ndarray) -> np.ndarray:
    return of_groups(normal @ found.mixture, found.owner, len(found.gain))


def test_groups():
    near = 1 + 0.5 * MERGE_TOLERANCE
    assert groups(np.array([1.0, near, 1.5, 2.0, 2 * near, 2 + 1.9 * MERGE_TOLERANCE])) == [
        slice(0, 2),
        slice(2, 3),
        slice(3, 6),
    ]
    assert groups(np.zeros(0)) == []


def test_a_mixture_of_equal_modes_is_as_loud():
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


def test_a_response_by_modal_coordinates():
    """An impulse at a point, q̇ = φ(x) J for each mode: root mean squares over the surface, then over where it is struck."""
    normal, area = shapes()
    mass, equal = 3.0, slice(0, 3)
    found = loudness(np.array([1.0, 1.0, 1.0, 2.0, 3.0, 4.0]), normal, area, mass)
    velocity = normal[:, equal] @ normal[:, equal].T  # of y per impulse at x
    heard = np.sqrt(area @ velocity**2 / area.sum())
    shares = share(found, normal)
    assert found.gain[0] / mass * shares[:, 0] == pytest.approx(heard)
    assert found.gain[0] / mass == pytest.approx(np.sqrt(area @ heard**2 / area.sum()))
    assert np.sqrt(area @ shares**2 / area.sum()) == pytest.approx(np.ones(3))


def test_what_does_not_move_along_its_normal_is_left_out():
    normal, area = shapes()
    normal[:, 1] *= 1e-3
    assert loudness(np.arange(1.0, 7.0), normal, area, 1.0).wave_number == pytest.approx([1.0, 3.0, 4.0, 5.0])

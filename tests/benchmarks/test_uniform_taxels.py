"""`benchmarks/uniform_taxels.py`: farthest-point sampling."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from uniform_taxels import farthest


def test_points_of_a_line_are_chosen_from_the_middle_outwards():
    """Of 0 … 8: the middle, the ends, then the middles between."""
    points = np.stack([np.arange(9.0), np.zeros(9), np.zeros(9)], axis=1)
    assert farthest(points, 5).tolist() == [4, 0, 8, 2, 6]
    assert sorted(farthest(points, 9).tolist()) == list(range(9))


@pytest.mark.parametrize("count", [1, 10, 60])
def test_each_point_is_the_farthest_from_those_before(count):
    points = np.random.default_rng(0).normal(size=(60, 3))
    rows = farthest(points, count)
    for i in range(1, count):
        distance = np.linalg.norm(points[:, None] - points[rows[:i]], axis=2).min(axis=1)
        assert distance[rows[i]] == distance.max()

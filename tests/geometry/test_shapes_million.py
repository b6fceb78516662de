"""A million points per primitive against an oracle that computes no distance: points are built at a known one."""

import pytest
from held import assert_holds
from oracles import geometry

NUM = 1_000_000


@pytest.mark.parametrize(("shape", "size"), geometry.PRIMITIVES)
def test_a_million_points_at_known_distances(shape, size):
    assert_holds(geometry.at_known_distances(shape, size, NUM))

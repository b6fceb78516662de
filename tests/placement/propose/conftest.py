"""Fewer points on surfaces than a user's proposals have: sampling takes most of a proposal's time."""

import pytest

from tgdsl.placement.sample import poisson


@pytest.fixture(scope="module", autouse=True)
def few_points():
    """Lower the least number of points on a surface."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(poisson, "MIN_POOL", 1000)
        yield

"""Fewer surface points than in real proposals, because sampling takes most of the time."""

import pytest

from tgdsl.placement.sample import poisson


@pytest.fixture(scope="module", autouse=True)
def few_points():
    """Lower the minimum number of points on a surface."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(poisson, "MIN_POOL", 1000)
        yield

"""Comparisons of `oracles` and hard cases of `oracles.hard` in tests."""

import numpy as np
from oracles.hard.results import HardCase
from oracles.results import Comparison


def assert_holds(found: Comparison) -> None:
    """Assert that each number is as near to its exact value as the comparison allows."""
    assert len(found.over.values) == found.exact.shape[-1]
    np.testing.assert_allclose(found.ours, found.exact, rtol=found.rtol, atol=found.atol, err_msg=found.name)
    assert found.holds, found.name


def assert_stands(case: HardCase) -> None:
    """Assert that each error of a hard case is as small as it must be, in each precision."""
    for precision, own in case.errors.items():
        assert len(own.errors) == len(case.parts)
        for part, error in zip(case.parts, own.errors, strict=True):
            assert error <= own.most, f"{case.name}, {part}, {precision}: {error:.2g} {case.unit}"
    assert case.holds and case.is_finite

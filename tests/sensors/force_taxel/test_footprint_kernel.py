"""The Triton kernel of contact shares, interpreted on the CPU, against the torch code in float64."""

import sys

import numpy as np
import pytest
import torch
from kernels import interpreted, needs_triton, use_kernels
from shared_contacts import RADIUS, arguments, cases

from tgdsl.sensors.force_taxel.footprint import SHARED_FORCES

TOLERANCE = 1e-5
"""Relative to the largest force, and to that times a footprint: float32 steps from differences of moments."""

pytestmark = needs_triton


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Return the interpreter's results of all cases."""
    path = tmp_path_factory.mktemp("kernel") / "found.pt"
    interpreted(__file__, str(path))
    return torch.load(path)


@pytest.mark.slow
@pytest.mark.parametrize("name", cases())
def test_the_kernel_matches_the_torch_code(results, name):
    case = cases()[name]
    expected = SHARED_FORCES(*arguments(case, torch.float64))
    largest = max(1.0, float(np.nanmax(np.abs(case[4]), initial=0.0)))
    for part, exact, scale in zip(results[name], expected, (1, 1, RADIUS), strict=True):
        torch.testing.assert_close(part.double(), exact, rtol=0, atol=TOLERANCE * scale * largest, equal_nan=True)


if __name__ == "__main__":
    use_kernels()
    torch.save({name: tuple(SHARED_FORCES(*arguments(case, torch.float32))) for name, case in cases().items()}, sys.argv[1])

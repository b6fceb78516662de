"""The Triton kernel of moments from fields, run on the CPU by Triton's interpreter, against the torch code in float64."""

import pytest
import torch
from kernels import interpreted, needs_triton, use_kernels
from moment_fields import CASES, made

from tgdsl.geometry.planes import Vec
from tgdsl.quantities.moment_sums import FELT_MOMENTS

TOLERANCE = 1e-5
"""Fraction of full scale: float32 rounding within a cell of 8 nodes, times the slope of a random field."""


def stacked(mass: torch.Tensor, first: Vec) -> torch.Tensor:
    return torch.stack([mass, *first])


def compare() -> None:
    """Compare the kernel with the torch code in all cases: run where `TRITON_INTERPRET` is set."""
    use_kernels()

    def moments(pairs, pos, source, is_kernel):
        implementation = FELT_MOMENTS.kernel if is_kernel else FELT_MOMENTS.definition
        return stacked(*implementation(pairs, source.target.pairs, pos, source))

    for case in CASES:
        expected = moments(*made(case, torch.float64), False)
        result = moments(*made(case, torch.float32), True)
        assert result.dtype == torch.float32 and result.shape == expected.shape, case
        torch.testing.assert_close(
            result.double(), expected, rtol=0, atol=TOLERANCE * (expected.numel() and float(expected.abs().max()))
        )
        if expected.numel() > 100:
            assert (expected[0] == 0).sum() > 5 and (expected[0] != 0).sum() > 5, case
    for case, vector in (("several links", "rotation"), ("by both", "offset")):
        pairs, pos, source = made(case, torch.float32)
        getattr(pairs, vector)[1][1, 1] = torch.nan
        expected, result = (moments(pairs, pos, source, is_kernel) for is_kernel in (False, True))
        assert expected.isnan().any()
        torch.testing.assert_close(result, expected, rtol=1e-4, atol=1e-4, equal_nan=True)
    for offset in (torch.inf, -1e30):
        pairs, pos, source = made("several links", torch.float32)
        pairs.offset[2][:] = offset
        assert (moments(pairs, pos, source, True) == 0).all()


@pytest.mark.slow
@needs_triton
def test_the_kernel_matches_the_torch_code():
    interpreted(__file__)


if __name__ == "__main__":
    compare()

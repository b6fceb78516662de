"""The Triton kernel of the links' products, interpreted on the CPU, against products in float64."""

import json

import pytest
import torch
from kernels import interpreted, needs_triton, use_kernels

from tgdsl.tensors.link_products import LINK_PRODUCTS, products

pytestmark = needs_triton
EPS = torch.finfo(torch.float32).eps
CASES = {
    "one taxel": (1, [1], 1),
    "a block of 16": (64, [16], 1),
    "one more": (65, [17], 3),
    "the largest block": (130, [64], 1),
    "a short rest": (5, [65], 2),
    "a rest of 32": (70, [81], 1),
    "one link": (67, [100], 3),
    "a full rest": (64, [128], 1),
    "two tiles, small links": (140, [3, 90, 1], 3),
    "many links": (70, [20, 33, 1, 15, 16, 17, 60, 2], 2),
    "a rest in some": (9, [65, 4, 100, 64], 3),
    "half a block": (70, [35, 16, 20, 12, 20], 2),
    "too large to hold": (65, [129, 3], 2),
    "a palm": (70, [219, 56, 40], 3),
    "the largest": (3, [256], 1),
    "no taxels": (4, [3, 0, 5], 2),
    "several steps": (1500, [16] * 70, 1),
}
"""Lines, taxels of the links, and planes."""


def inputs(num_lines: int, sizes: list[int], num_planes: int) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Return lines and matrices with both signs, as views into larger tensors, some transposed."""
    random = torch.Generator().manual_seed(num_lines)
    lines = torch.randn((num_lines, sum(sizes)), generator=random)
    matrices = [torch.randn((2, size, num_planes, size), generator=random)[1] for size in sizes]
    return lines, [matrix.transpose(0, 2) if i % 3 == 2 else matrix for i, matrix in enumerate(matrices)]


def exact_products(lines: torch.Tensor, matrices: list[torch.Tensor]) -> torch.Tensor:
    """Return the products of all rows by one matrix for each plane, zero between links, in float64."""
    planes = [torch.block_diag(*(matrix[:, plane] for matrix in matrices)) for plane in range(matrices[0].shape[1])]
    return torch.stack([lines.double() @ plane.double() for plane in planes])


def errors() -> dict[str, float]:
    """Return the largest error of each case over its bound."""
    ratios = {}
    for name, case in CASES.items():
        lines, matrices = inputs(*case)
        error = (LINK_PRODUCTS(lines, matrices) - exact_products(lines, matrices)).abs()
        # Each of n products and n sums rounds by half of eps of the sum so far.
        bound = max(case[1]) * EPS * exact_products(lines.abs(), [matrix.abs() for matrix in matrices])
        ratios[name] = float((error / bound.clamp(min=1e-30)).max())
    return ratios


def edges() -> dict[str, list]:
    """Return whether NaNs stay in place, and the shape of the product of zero lines."""
    are_equal = []
    for last in (65, 140):
        lines, matrices = inputs(70, [20, 33, 1, last], 2)
        lines[3, 30], lines[66, 53], lines[69, -1] = torch.nan, torch.nan, torch.nan
        are_equal.append(torch.equal(LINK_PRODUCTS(lines, matrices).isnan(), products(lines, matrices).isnan()))
    return {"not a number": are_equal, "no line": list(LINK_PRODUCTS(*inputs(0, [20, 99], 2)).shape)}


@pytest.fixture(scope="module")
def results() -> dict:
    """Return the results of a process that interprets kernels."""
    return json.loads(interpreted(__file__))


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_kernel_returns_the_product(results, name):
    assert results[name] < 1


@pytest.mark.parametrize("name", CASES)
def test_torch_code_returns_the_product(name):
    lines, matrices = inputs(*CASES[name])
    doubles = lines.double(), [matrix.double() for matrix in matrices]
    torch.testing.assert_close(products(*doubles), exact_products(*doubles), rtol=1e-13, atol=1e-12)


@pytest.mark.slow
def test_nans_stay_in_their_line_and_link(results):
    assert results["not a number"] == [True, True]


@pytest.mark.slow
def test_zero_lines_give_an_empty_product(results):
    assert results["no line"] == [2, 0, 119]


if __name__ == "__main__":
    use_kernels()
    print(json.dumps(errors() | edges()))

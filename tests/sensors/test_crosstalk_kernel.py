"""The kernel of crosstalk's products, by Triton's interpreter on the CPU, against products in float64."""

import json

import pytest
import torch
from kernels import interpreted, needs_triton

pytestmark = needs_triton
EPS = torch.finfo(torch.float32).eps
CASES = {
    "one taxel": (1, [1]),
    "a block of 16": (64, [16]),
    "one more": (65, [17]),
    "the largest block": (130, [64]),
    "a short rest": (5, [65]),
    "a rest of 32": (70, [81]),
    "one link": (67, [100]),
    "a full rest": (64, [128]),
    "two tiles, small links": (140, [3, 90, 1]),
    "many links": (70, [20, 33, 1, 15, 16, 17, 60, 2]),
    "a rest in some": (9, [65, 4, 100, 64]),
    "no taxels": (4, [3, 0, 5]),
    "several steps": (1500, [16] * 70),
}
"""Lines, and taxels of the links."""


def given(num_lines: int, sizes: list[int]) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Return a signal and operators with both signs, as views of what holds two, some transposed."""
    random = torch.Generator().manual_seed(num_lines)
    signal = torch.randn((num_lines, sum(sizes)), generator=random)
    operators = [torch.randn((2, size, size), generator=random)[1] for size in sizes]
    return signal, [operator.T if i % 3 == 2 else operator for i, operator in enumerate(operators)]


def main() -> None:
    """Print the results of all cases, as a process that interprets kernels."""
    from tgdsl.sensors.noise.crosstalk_kernel import kernel, launch

    found = {}
    for name, case in CASES.items():
        signal, operators = given(*case)
        exact = torch.block_diag(*operators).double().T
        error = (launch(kernel, signal, operators) - signal.double() @ exact).abs()
        # Each of n products and n sums rounds, by half of eps of what was added up.
        bound = max(case[1]) * EPS * (signal.double().abs() @ exact.abs())
        found[name] = float((error / bound.clamp(min=1e-30)).max())

    sizes = [20, 33, 1, 65]
    signal, operators = given(70, sizes)
    signal[3, 30], signal[66, 53], signal[69, -1] = torch.nan, torch.nan, torch.nan
    expected = torch.cat([a @ w.T for a, w in zip(signal.split(sizes, dim=1), operators, strict=True)], dim=1)
    found["not a number"] = torch.equal(launch(kernel, signal, operators).isnan(), expected.isnan())
    found["no line"] = list(launch(kernel, *given(0, sizes)).shape)
    print(json.dumps(found))


@pytest.fixture(scope="module")
def found() -> dict:
    return json.loads(interpreted(__file__))


@pytest.mark.parametrize("name", CASES)
def test_kernel_is_the_product(found, name):
    assert found[name] < 1


def test_not_a_number_stays_in_its_line_and_link(found):
    assert found["not a number"]


def test_no_line_is_nothing(found):
    assert found["no line"] == [0, 119]


if __name__ == "__main__":
    main()

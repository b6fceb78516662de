"""The Triton kernel that has points meet links, run on the CPU by Triton's interpreter, against the torch code in float64."""

import pytest
import torch
from kernels import interpreted, needs_triton, use_kernels
from meetings import CASES, made, nums_of

from tgdsl.geometry import planes
from tgdsl.geometry.planes import vec
from tgdsl.quantities.points import LINK_POINTS, ObjectPoints, link_points

TOLERANCE = 3e-7
"""Of places within a decimetre in float32 [m]."""
TURN = 1e-3
"""Of gradients: a place that is off by as much, over the cell."""


def by_kernel(pairs, source):
    found = LINK_POINTS.kernel(ObjectPoints(pairs, source))
    return found.pos, found.distance, found.gradient


def is_within(case, pairs, source, pos, slack):
    """Return which points the gate is open for, and that are inside a grid of their link or at most so far out of it [m]."""
    found = torch.zeros_like(pos[0], dtype=torch.bool)
    links = source.links
    for g, grid in enumerate(links.surfaces):
        for link, num in enumerate(nums_of(case, g)):
            turn = planes.rot(links.rotation[link, g])
            at = planes.rotate_back(turn, planes.sub(vec(part[:, link] for part in pos), vec(links.pos[link, g])))
            half = 0.5 * grid.cell[link] * (num - 1)
            beyond = torch.stack([part.abs() - size for part, size in zip(at, half, strict=True)]).amax(dim=0)
            if links.is_absent is None or not links.is_absent[link, g]:
                found[:, link] |= beyond < slack
    return found if pairs.gate is None else found & (pairs.gate[:, source.pair, None] == 0)


def check(case):
    """Compare what the kernel finds with the torch code: all places, and distances within the grids."""
    exact, arguments = made(case, torch.float64), made(case, torch.float32)
    expected, (pos, distance, gradient) = link_points(exact), by_kernel(*arguments)
    torch.testing.assert_close(torch.stack(pos).double(), torch.stack(expected.pos), rtol=0, atol=TOLERANCE)
    found = distance.isfinite()
    assert 0.02 < found.double().mean() < 0.98, case
    assert (found | ~is_within(case, *exact, expected.pos, -1e-6)).all(), case
    assert (~found | is_within(case, *exact, expected.pos, 1e-6)).all(), case
    assert (distance[~found] == torch.inf).all() and all((part[~found] == 0).all() for part in gradient)
    # A point that is out of one grid and in another reads the latter, though it may be nearer to what the former holds.
    is_known = found & (expected.distance > distance.double() - TOLERANCE)
    assert is_known.sum() > (0.7 if len(CASES[case][2]) > 1 else 0.999) * found.sum(), case
    torch.testing.assert_close(distance[is_known].double(), expected.distance[is_known], rtol=0, atol=TOLERANCE)
    # In the middle of a sphere the gradient is next to nothing, and between two linear cells it jumps.
    apart = torch.stack([(a - b)[is_known].abs() for a, b in zip(gradient, expected.gradient, strict=True)])
    assert (apart < TURN).all(dim=0).double().mean() > 0.97, case


def check_strange_poses():
    """What is not a number comes out, gated or not, and in no other link or environment."""
    pairs, source = made("cubes", torch.float32)
    clean = by_kernel(pairs, source)
    pairs.offset[1][2, source.pair[0]] = torch.nan
    pairs.gate[2, source.pair[0]] = torch.nan
    for gate in (pairs.gate, None):
        (x, y, z), distance, _ = by_kernel(pairs._replace(gate=gate), source)
        assert distance[2, 0].isnan().all() and distance.isnan().sum() == distance.shape[2]
        assert all(part[2, 0].isnan().all() for part in (x, y, z))
    torch.testing.assert_close(by_kernel(pairs, source)[1][:2], clean[1][:2])
    pairs.offset[1][2, source.pair[0]] = torch.inf
    assert (by_kernel(pairs._replace(gate=None), source)[1][2, 0] == torch.inf).all()


def compare() -> None:
    """Make all comparisons: run where `TRITON_INTERPRET` is set."""
    use_kernels()
    for case in CASES:
        check(case)
    check_strange_poses()


@pytest.mark.slow
@needs_triton
def test_the_kernel_is_the_torch_code():
    interpreted(__file__)


if __name__ == "__main__":
    compare()

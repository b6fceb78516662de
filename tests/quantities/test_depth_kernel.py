"""The Triton kernel of points against links, run on the CPU by Triton's interpreter, against the torch code in float64."""

import pytest
import torch
from kernels import interpreted, needs_triton, use_kernels
from meetings import CASES, made, nums_of

from tgdsl.geometry import planes
from tgdsl.geometry.planes import vec
from tgdsl.quantities.points import LINK_POINTS, ObjectPoints, link_points

TOLERANCE = 3e-7
"""Float32 error of positions within a decimetre [m]."""
TURN = 1e-3
"""Error of gradients: that of a position over the size of a cell."""


def by_kernel(pairs, source):
    result = LINK_POINTS.kernel(ObjectPoints(pairs, source))
    return result.pos, result.distance, result.gradient


def is_within(case, pairs, source, pos, slack):
    """Return which points have an open gate and lie inside a grid of their link, or at most `slack` [m] outside."""
    result = torch.zeros_like(pos[0], dtype=torch.bool)
    links = source.links
    for g, grid in enumerate(links.surfaces):
        for link, num in enumerate(nums_of(case, g)):
            turn = planes.rot(links.rotation[link, g])
            at = planes.rotate_back(turn, planes.sub(vec(part[:, link] for part in pos), vec(links.pos[link, g])))
            half = 0.5 * grid.cell[link] * (num - 1)
            beyond = torch.stack([part.abs() - size for part, size in zip(at, half, strict=True)]).amax(dim=0)
            if links.is_absent is None or not links.is_absent[link, g]:
                result[:, link] |= beyond < slack
    return result if pairs.gate is None else result & (pairs.gate[:, source.pair, None] == 0)


def check(case):
    """Compare the kernel with the torch code: all positions, and distances within the grids."""
    exact, arguments = made(case, torch.float64), made(case, torch.float32)
    expected, (pos, distance, gradient) = link_points(exact), by_kernel(*arguments)
    torch.testing.assert_close(torch.stack(pos).double(), torch.stack(expected.pos), rtol=0, atol=TOLERANCE)
    is_found = distance.isfinite()
    assert 0.02 < is_found.double().mean() < 0.98, case
    assert (is_found | ~is_within(case, *exact, expected.pos, -1e-6)).all(), case
    assert (~is_found | is_within(case, *exact, expected.pos, 1e-6)).all(), case
    assert (distance[~is_found] == torch.inf).all() and all((part[~is_found] == 0).all() for part in gradient)
    # A point in only one of two grids reads that one, though the other geom may be nearer.
    is_comparable = is_found & (expected.distance > distance.double() - TOLERANCE)
    assert is_comparable.sum() > (0.7 if len(CASES[case][2]) > 1 else 0.999) * is_found.sum(), case
    torch.testing.assert_close(distance[is_comparable].double(), expected.distance[is_comparable], rtol=0, atol=TOLERANCE)
    # The gradient vanishes at the centre of a sphere and jumps between two linear cells.
    error = torch.stack([(a - b)[is_comparable].abs() for a, b in zip(gradient, expected.gradient, strict=True)])
    assert (error < TURN).all(dim=0).double().mean() > 0.97, case


def check_strange_poses():
    """NaN comes out, gated or not, only in its own link and environment."""
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
def test_the_kernel_matches_the_torch_code():
    interpreted(__file__)


if __name__ == "__main__":
    compare()

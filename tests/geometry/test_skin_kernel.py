"""The Triton kernel that has points meet links, run on the CPU by Triton's interpreter, against the torch code in float64."""

from functools import partial

import torch
from kernels import interpreted, needs_triton

from tgdsl.geometry import planes
from tgdsl.geometry.grid import Grid
from tgdsl.geometry.planes import rot, split, vec
from tgdsl.geometry.points import PointSource, _met
from tgdsl.geometry.query import FeltObject, Pairs

NUM_ENVS, CELL = 4, 0.002
TOLERANCE = 3e-7
"""Of places within a decimetre in float32 [m]."""
TURN = 1e-3
"""Of gradients: a place that is off by as much, over the cell."""
CASES = {
    # points, links, how grids are interpolated, whether the object differs between environments, is it gated
    "one link": (10, 1, "trilinear", False, False),
    "cubes": (70, 3, "tricubic", False, True),
    "many points": (130, 2, "tricubic", True, True),
    "two nodes": (64, 2, "trilinear", True, False),
}
NUMS = ((9, 7, 8), (6, 11, 5), (2, 2, 2))


def nums_of(case):
    """Return the numbers of nodes along the axes of each link's grid."""
    return NUMS[: CASES[case][1]] if case != "two nodes" else NUMS[-2:]


def made(case, dtype):
    """Return pairs, and an object's points with the links that they may meet: spheres in grids of their own."""
    num_points, num_links, shape, differs, is_gated = CASES[case]
    rng = torch.Generator().manual_seed(len(case))
    draw = partial(torch.randn, generator=rng, dtype=torch.float64)
    nums = nums_of(case)
    cells = CELL * (1 + torch.arange(num_links)).to(dtype)
    values, first = [], [0]
    for num, cell in zip(nums, cells.double(), strict=True):
        middle = [(n - 1) / 2 for n in num]
        places = torch.cartesian_prod(*(torch.arange(n, dtype=torch.float64) - m for n, m in zip(num, middle, strict=True)))
        values.append(cell * places.norm(dim=1) - 0.003)
        first.append(first[-1] + len(places))
    origins = torch.stack([-0.5 * c * (torch.tensor(n) - 1.0) for n, c in zip(nums, cells, strict=True)]).to(dtype)
    grid = Grid(
        torch.cat(values).float().to(dtype),
        torch.tensor(first[:-1])[:, None],
        split(torch.tensor(nums)[:, None]),
        split(origins[:, None]),
        cells[:, None],
    )
    place = (0.002 * draw(num_links, 1, 3)).to(dtype)
    turns = torch.stack(planes.rotation(draw(num_links, 1, 4)), dim=-1).to(dtype)
    links = FeltObject("links", 0, 0, (shape,), (False,), place, place, turns, None, torch.arange(num_links), (grid,))
    num_pairs = num_links + 2
    parts = [*planes.rotation(draw(NUM_ENVS, num_pairs, 4)), *(0.003 * draw(3, NUM_ENVS, num_pairs))]
    parts = torch.stack(list(parts), dim=1).to(dtype)
    parts[:, :, 0] = torch.nan  # a pair that nobody asks for
    gate = torch.where(draw(NUM_ENVS, num_pairs) > 0.4, -torch.inf, 0.0).to(dtype) if is_gated else None
    pairs = Pairs(rot(parts[:, :9].unbind(1)), vec(parts[:, 9:].unbind(1)), None, gate)
    points = vec((0.006 * draw(3, NUM_ENVS if differs else 1, 1, num_points)).to(dtype))
    pair = 1 + torch.randperm(num_links, generator=rng)
    return pairs, PointSource("cube", pair, ((0, 1),) * num_links, points, torch.ones(1, 1), links)


def by_kernel(pairs, source):
    from tgdsl.geometry.skin_kernel import meet

    return meet(pairs, source.pair, source.points, source.links, source.links.surfaces[0])


def check(case):
    """Compare what the kernel finds with the torch code: all places, and distances within the grids."""
    exact, arguments = made(case, torch.float64), made(case, torch.float32)
    expected, (pos, distance, gradient) = _met(*exact), by_kernel(*arguments)
    torch.testing.assert_close(torch.stack(pos).double(), torch.stack(expected.pos), rtol=0, atol=TOLERANCE)
    found = distance.isfinite()
    assert 0.02 < found.double().mean() < 0.98, case
    torch.testing.assert_close(distance[found].double(), expected.distance[found], rtol=0, atol=TOLERANCE)
    apart = torch.stack([(a - b)[found].abs() for a, b in zip(gradient, expected.gradient, strict=True)])
    # In the middle of a sphere the gradient is next to nothing, and between two linear cells it jumps.
    is_sure = (apart < TURN).all(dim=0)
    assert is_sure.double().mean() > 0.98, case
    source = exact[1]
    inside = torch.zeros_like(found)
    for link, own in enumerate(torch.tensor(nums_of(case))):
        turn = planes.rot(part[None, None] for part in source.links.rotation[link, 0])
        at = planes.rotate_back(turn, planes.sub(vec(part[:, link] for part in expected.pos), vec(source.links.pos[link, 0])))
        half = 0.5 * source.links.surfaces[0].cell[link] * (own - 1)
        margin = torch.stack([part.abs() - size for part, size in zip(at, half, strict=True)]).amax(dim=0)
        gate = exact[0].gate
        is_open = torch.ones_like(margin[:, :1]) if gate is None else (gate[:, source.pair[link], None] == 0)
        inside[:, link] = (margin < -1e-6) & (is_open > 0)
        assert (~found[:, link] | (margin < 1e-6)).all(), case
    assert found[inside].all(), case
    assert (distance[~found] == torch.inf).all() and all((part[~found] == 0).all() for part in gradient)


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
    from tgdsl.geometry import skin_kernel

    skin_kernel._meet = partial(skin_kernel.launch, skin_kernel.kernel)
    for case in CASES:
        check(case)
    check_strange_poses()


@needs_triton
def test_the_kernel_is_the_torch_code():
    interpreted(__file__)


if __name__ == "__main__":
    compare()

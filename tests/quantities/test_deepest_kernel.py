"""The Triton kernel of the deepest geom, run on the CPU by Triton's interpreter, against the torch code in float64."""

import pytest
import torch
from kernels import interpreted, needs_triton, use_kernels
from searches import CASES, SHAPES, made, paired

from tgdsl.geometry import planes
from tgdsl.geometry.planes import rot, split, vec
from tgdsl.quantities.contact_depth import DEEPEST, Probes, Target, measure, penetration
from tgdsl.quantities.geoms import Geoms
from tgdsl.quantities.pairs import Motion, Pairs

TOLERANCE = 3e-7
"""Float32 error of positions within half a metre [m]; directions err by this over their distance."""
TURN = 2e-3
WANTS = frozenset({"normal", "motion"})


def by_torch(pairs, probes, which, targets, reach):
    """Return depth, normal and motion of the deepest geom."""
    near = measure(pairs, probes, targets)
    felt = penetration(pairs, probes, [near[index] for index in which], reach, WANTS)
    return felt.depth, torch.stack(felt.normal), torch.stack([*felt.velocity, *felt.angular])


def deepest_of(pairs, probes, which, targets, reach):
    """Return the kernel's result."""
    felt = [targets[index] for index in which]
    pair = torch.stack([probes.pair[index] + targets[index].object.first_pair for index in which]).int()
    return DEEPEST.kernel(pairs, probes, felt, {"pair": pair}, reach)


def by_kernel(pairs, probes, which, targets, reach):
    result = deepest_of(pairs, probes, which, targets, reach)
    assert result.pair.dtype == torch.int32 and result.depth.dtype == torch.float32

    def of_deepest(part):
        return torch.where(result.pair >= 0, part.gather(1, result.pair.clamp(min=0).long()), 0.0)

    linear, angular = (vec(map(of_deepest, part)) for part in pairs.motion[:2])
    velocity = planes.add(linear, planes.cross(angular, probes.pos))
    return result.depth, torch.stack(result.normal), torch.stack([*velocity, *angular])


def check(case):
    """Compare the kernel with the torch code."""
    exact, arguments = made(case, torch.float64), made(case, torch.float32)
    depth, normal, motion = by_torch(*exact)
    result = by_kernel(*arguments)
    torch.testing.assert_close(result[0].double(), depth, rtol=0, atol=TOLERANCE)
    # Where float32 cannot decide which geom is deepest, the torch code in float32 cannot either.
    is_sure = ((by_torch(*arguments)[2].double() - motion).abs().amax(0) < 1e-4) & ~((depth > 0) & (depth < 1e-6))
    assert not depth.numel() or is_sure.double().mean() > 0.97, case
    torch.testing.assert_close((result[1] * is_sure).double(), normal * is_sure, rtol=0, atol=TURN)
    torch.testing.assert_close((result[2] * is_sure).double(), motion * is_sure, rtol=1e-4, atol=1e-4)
    assert not depth.numel() or ((depth > 0).sum() > 2 and (depth == 0).sum() > 5), case


def check_strange_poses():
    """NaN shows where the torch code shows it, gated or not; far poses reach nothing."""
    num_nan = {"open": 0, "closed": 0}
    for case, pair, axes in (("several geoms", 1, "rotation"), ("several geoms", 7, "offset"), ("variants", 2, "rotation")):
        pairs, *rest = made(case, torch.float32)
        for part in getattr(pairs, axes):
            part[:3, pair] = torch.nan
        for gate in (pairs.gate, None, torch.full_like(pairs.gate, -torch.inf)):
            arguments = pairs._replace(gate=gate), *rest
            (expected, *_), (result, *_) = by_torch(*arguments), by_kernel(*arguments)
            assert (expected[3:] == expected[3:]).all() and torch.equal(expected.isnan(), result.isnan())
            torch.testing.assert_close(result, expected, rtol=1e-4, atol=TOLERANCE, equal_nan=True)
            num_nan["closed" if gate is not None and (gate < 0).all() else "open"] += int(result.isnan().sum())
    assert min(num_nan.values()) > 10
    for offset in (torch.inf, -1e30):
        pairs, *rest = made("boxes", torch.float32)
        pairs.offset[1][:] = offset
        result = by_kernel(pairs, *rest)
        assert all((part == 0).all() for part in result)


def scene(shapes, size, pos, depths):
    """Return the arguments of equal objects and one probe at these depths in them, from above."""
    num = len(depths)
    one = torch.ones(1, num)
    turn = planes.rotation(torch.tensor([1.0, 0.0, 0.0, 0.0]))
    zero, height = 0 * one, 0.02 - torch.tensor([depths])
    still = (zero, zero, zero)
    geoms = [torch.tensor(part, dtype=torch.float32)[None] for part in (size, pos)]
    rotation = torch.eye(3).flatten().expand(1, len(shapes), 9)
    geoms_of_object = Geoms(shapes, (False,) * len(shapes), *geoms, rotation, None, None, (None,) * len(shapes))
    targets = [Target(paired(str(i), i, 1), geoms_of_object) for i in range(num)]
    pairs = Pairs(rot(part * one for part in turn), (zero, zero, height), Motion(still, still, still), None)
    probes = Probes(split(torch.zeros(1, 3)), torch.zeros((num, 1), dtype=torch.int64))
    return pairs, probes, range(num), targets, torch.full((num, 1), 0.01)


def check_ties():
    """The first of equally deep objects, geoms and faces of a box wins."""
    box = ("box",), [[0.01, 0.01, 0.01]], [[0.0, 0.0, 0.0]]
    for depths, winner in (((0.001, 0.001), 0), ((0.001, 0.001 + 5e-8), 0), ((0.001, 0.001 + 5e-7), 1), ((-0.001, 0.0), -1)):
        result = deepest_of(*scene(*box, depths))
        assert result.pair.item() == winner, depths
        assert result.normal[2].item() == (winner >= 0)
    for nearer, x in ((0.0, 0.0), (5e-8, 0.0), (5e-7, -1.0)):  # one box below, and a second as near or nearer at the side
        arguments = scene(("box", "box"), [[0.01] * 3] * 2, [[0.0, 0.0, 0.0], [0.018 - nearer, 0.0, 0.018]], (0.002,))
        result, expected = by_kernel(*arguments), by_torch(*arguments)
        assert expected[1][0].item() == x
        torch.testing.assert_close(result[:2], expected[:2], rtol=0, atol=1e-7)
    exact = ([0.0, 0.0, 0.0], [0.0, 0.0, 0.007], [0.01, 0.01, 0.01], [0.01, 0.01, 0.0])
    perturbed = ([5e-8, 2e-8, -5e-8], [5e-8, 2e-7, -5e-8], [0.0, 0.005, 0.00500005], [0.005, 0.0, 5e-8], [2e-8, 0.0, 0.005])
    for shape in SHAPES:  # centres, axes, edges and corners
        for center in (*exact, *perturbed):
            arguments = scene((shape, "box"), [[0.01, 0.01, 0.01]] * 2, [center, [1.0, 1.0, 1.0]], (0.02,))
            torch.testing.assert_close(by_kernel(*arguments)[:2], by_torch(*arguments)[:2], rtol=0, atol=2e-7)


def compare() -> None:
    """Make all comparisons: run where `TRITON_INTERPRET` is set."""
    use_kernels()
    for case in CASES:
        check(case)
    check_strange_poses()
    check_ties()


@pytest.mark.slow
@needs_triton
def test_the_kernel_matches_the_torch_code():
    interpreted(__file__)


if __name__ == "__main__":
    compare()

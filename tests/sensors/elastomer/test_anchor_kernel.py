"""The Triton kernel of anchors of points, interpreted on the CPU, against the torch code."""

import json
from pathlib import Path

import pytest
import torch
from kernels import interpreted, needs_triton, use_kernels
from meetings import NUM_ENVS, made

import tgdsl
from tgdsl.geometry.grid import METHODS, one_grid
from tgdsl.geometry.planes import rot, vec
from tgdsl.quantities.points import link_points
from tgdsl.sensors.elastomer import point_anchors
from tgdsl.sensors.elastomer.anchors import StickSlip
from tgdsl.sensors.elastomer.point_anchors import PLANES, SHEAR_LOADS, advance, shear_loads

PALM = Path(__file__).parents[3] / "examples" / "xhand1_palm.yaml"
STICKS, SLIDES = StickSlip(1e-3, 1e-5, 1e-3, None), StickSlip(1e-3, 1e-5, 1e-3, 0.4)
CONTACT_LAWS = {"sticks": STICKS, "slides": SLIDES}
CASES = ("one link", "cubes", "many points")
STEPS, BEFORE = 4, 7
"""Steps of a run, and the number of other objects' points that precede the compared ones."""
PLACE, STRENGTH = 3e-7, 3e-9
"""Errors of places [m], and of their products with depths [m²], in float32."""


def moved(meeting, step):
    """Return a meeting whose object has moved on; at the third step some links are no longer felt."""
    pairs = meeting.pairs
    angle = torch.tensor(0.02 * step, dtype=pairs.offset[0].dtype)
    x, y, z = pairs.offset
    turn = [part.clone() for part in pairs.rotation]
    for first, second in ((0, 3), (1, 4), (2, 5)):
        a, b = turn[first].clone(), turn[second].clone()
        turn[first], turn[second] = angle.cos() * a - angle.sin() * b, angle.sin() * a + angle.cos() * b
    gate = pairs.gate
    if gate is not None and step == 2:
        gate = torch.where(torch.arange(gate.shape[1]) % 2 == 1, -torch.inf, gate)
    offset = vec((x + 2e-4 * step, y - 1e-4 * step, z + 3e-4 * step))
    return meeting._replace(pairs=pairs._replace(rotation=rot(turn), offset=offset, gate=gate))


def to_dtype(stick_slip, dtype):
    """Return the law's numbers as a module has them."""
    return StickSlip(*(None if part is None else torch.tensor(part, dtype=torch.float32).to(dtype) for part in stick_slip))


def free_state(meeting):
    """Return the state of points that hold nothing, preceded by other objects' points."""
    num = meeting.source.pair.shape[0] * meeting.source.points[0].shape[2]
    return {name: torch.cat([torch.full((NUM_ENVS, BEFORE), 9.0), torch.zeros(NUM_ENVS, num)], dim=1) for name in PLANES}


def advance_by_kernel(meeting, stick_slip, state):
    """Return the active points and advance the state in place, as `shear_loads` does by the kernel on a GPU."""
    from tgdsl.quantities.depth_kernel import grid_tables
    from tgdsl.sensors.elastomer.anchor_kernel import advance_anchors

    (rotation, offset, _, gate), source = meeting
    places, numbers = torch.stack(source.points)[:, :, 0], [part for part in stick_slip if part is not None]
    how = (*grid_tables(source.links, 0), source.links.shapes[0] == "tricubic")
    held = [state[name] for name in PLANES]
    return advance_anchors([*rotation, *offset], gate, source.pair, places, *how, numbers, held, BEFORE)


def first_ones(count, num_points):
    """Return a mask of the columns of (env, link, point) that hold an active point."""
    return torch.arange(num_points) < count[..., None]


def check(case, stick_slip):
    """Run some steps, and compare each with the torch code in float64 from the same anchors.

    Returns how many points took hold, let go, slid and pulled.
    """
    exact, meeting = made(case, torch.float64), made(case, torch.float32)
    state, totals = free_state(meeting), torch.zeros(4)
    for step in range(STEPS):
        previous = {name: plane[:, BEFORE:].double() for name, plane in state.items()}
        (load,), expected = advance([link_points(moved(exact, step))], to_dtype(stick_slip, torch.float64), previous)
        active, count = advance_by_kernel(moved(meeting, step), to_dtype(stick_slip, torch.float32), state)
        for name, plane in state.items():
            assert (plane[:, :BEFORE] == 9).all()
            torch.testing.assert_close(plane[:, BEFORE:].double(), expected[name], rtol=0, atol=PLACE)
        is_active = torch.stack(load.strength).ne(0).any(dim=0)
        assert torch.equal(count, is_active.sum(dim=-1)), (case, step)
        error = (
            active[:, first_ones(count, is_active.shape[2])].double() - torch.stack([*load.pos, *load.strength])[:, is_active]
        ).abs()
        assert not error.numel() or (error[:3].max() <= PLACE and error[3:].max() <= STRENGTH), (case, step)
        held, after = previous["held"] > 0, expected["held"] > 0
        dragged = held & after & (expected["anchor_x"] != previous["anchor_x"])
        totals += torch.stack([part.sum() for part in (after & ~held, held & ~after, dragged, is_active)])
    return totals


def check_strange_poses():
    """A NaN in a pose is returned, gated or not, is not remembered, and reaches no other link or environment."""
    meeting, stick_slip = made("cubes", torch.float32), to_dtype(SLIDES, torch.float32)
    state = free_state(meeting)
    for step in range(2):
        advance_by_kernel(moved(meeting, step), stick_slip, state)
    num_points = meeting.source.points[0].shape[2]
    clean, count = advance_by_kernel(moved(meeting, 1), stick_slip, {name: plane.clone() for name, plane in state.items()})
    points, unaffected = slice(BEFORE, BEFORE + num_points), torch.ones(count.shape, dtype=torch.bool)
    unaffected[2, 0] = False
    for gate in (0.0, -torch.inf, torch.nan):
        broken, after = moved(meeting, 1), {name: plane.clone() for name, plane in state.items()}
        pair = int(broken.source.pair[0])
        broken.pairs.offset[1][2, pair], broken.pairs.gate[2, pair] = torch.nan, gate
        result, num_active = advance_by_kernel(broken, stick_slip, after)
        assert num_active[2, 0] == num_points and result[0, 2, 0].isnan().all()
        for name, plane in after.items():
            expected = state[name][2, points] if gate != -torch.inf else torch.zeros(num_points)
            assert torch.equal(plane[2, points], expected) or name != "held"
        assert torch.equal(num_active[unaffected], count[unaffected])
        is_active = first_ones(num_active, num_points) & unaffected[..., None]
        assert torch.equal(result[:, is_active], clean[:, is_active])


def check_sums():
    """A module's path through both kernels moves the markers like the torch code."""
    meeting, exact = made("cubes", torch.float32), made("cubes", torch.float64)
    state = {name: plane[:, BEFORE:].contiguous() for name, plane in free_state(meeting).items()}
    places = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0.6, 0, 0.8]], dtype=torch.float64)
    numbers = torch.tensor([2000.0, 6e-6], dtype=torch.float64)
    for step in range(3):
        previous = {name: plane.double() for name, plane in state.items()}
        loads, _ = advance([link_points(moved(exact, step))], to_dtype(SLIDES, torch.float64), previous)
        markers = point_anchors.Markers(vec(0.003 * places.T), vec(places.T), *numbers)
        expected = torch.stack(point_anchors.drag(loads, markers, NUM_ENVS))
        loads, after = SHEAR_LOADS([moved(meeting, step)], to_dtype(SLIDES, torch.float32), state)
        markers = point_anchors.Markers(vec(0.003 * places.T.float()), vec(places.T.float()), *numbers.float())
        displacement = torch.stack(point_anchors.drag(loads, markers, NUM_ENVS))
        assert after == {} and (step != 1 or expected.abs().max() > 1e-9)
        torch.testing.assert_close(displacement.double(), expected, rtol=0, atol=1e-5 * float(expected.abs().max()))


def compare() -> None:
    """Make all comparisons; `TRITON_INTERPRET` must be set."""
    use_kernels()
    for stick_slip in CONTACT_LAWS.values():
        totals = torch.stack([check(case, stick_slip) for case in CASES]).sum(dim=0)
        assert (totals[[0, 1, 3]] > 10).all() and (totals[2] > 10) == (stick_slip.slip is not None), totals
    check_strange_poses()
    check_sums()


@pytest.mark.slow
@needs_triton
def test_the_kernel_matches_the_torch_code():
    interpreted(__file__)


def test_a_distance_is_less_than_a_cell_below_the_next_nodes():
    """The kernel skips points by this bound: half a cell's diagonal is 0.87 cells, the rest allows for interpolation."""
    sensor = {"kind": "elastomer", "links": "tips", "feels": ["cube"], "anchors": "points", "points": 50}
    touch = tgdsl.compile(PALM, resolution="low", overrides={"sensors": json.dumps({"s": sensor}), "observations": "{}"})
    (shape,), below = touch.plan.quantities["points"].surfaces.shapes, []
    random = torch.Generator().manual_seed(0)
    nums, firsts, cells, values = (
        touch.constants[f"quantities/points/surfaces/surfaces/0/{name}"] for name in ("num", "first", "cell", "values")
    )
    for num, first, cell in zip(nums, firsts, cells.double(), strict=True):
        nodes = values[first : first + num.prod()].double().view(*num)
        at = torch.rand((100_000, 3), generator=random, dtype=torch.float64) * (num - 1)
        grid = one_grid(nodes, torch.zeros(3, dtype=torch.float64), cell)
        distance, _ = METHODS[shape](vec((cell * at).T), grid)
        below.append(float((nodes[tuple((at + 0.5).long().T)] - distance).max() / cell))
    assert 0.5 < max(below) < 0.95


@pytest.mark.parametrize("stick_slip", CONTACT_LAWS)
def test_without_a_kernel_torch_advances_all_objects(stick_slip):
    """Links with several meshes too."""
    for case in ("cubes", "several meshes"):
        meeting = made(case, torch.float64)
        state = {name: plane[:, BEFORE:].double() for name, plane in free_state(meeting).items()}
        (load,), after = shear_loads([meeting], to_dtype(CONTACT_LAWS[stick_slip], torch.float64), state)
        (expected,), expected_state = advance([link_points(meeting)], to_dtype(CONTACT_LAWS[stick_slip], torch.float64), state)
        assert load.num_active is None and all(torch.equal(after[name], expected_state[name]) for name in PLANES)
        assert torch.equal(torch.stack(load.strength), torch.stack(expected.strength))


if __name__ == "__main__":
    compare()

"""The Triton kernel of a step, run on the CPU by Triton's interpreter, against the torch code in float64."""

import heat_steps
import pytest
import torch
from kernels import interpreted, needs_triton, use_kernels

from tgdsl.sensors.temperature_grid.step import HEAT_STEP, step

RESOLUTION = 3e-6
"""Of a kelvin per kelvin of what there is, of joules per joule that flow: some roundings of float32."""


def parts(found):
    return [("cells", found.cells), ("nodes", found.nodes)], [*found.got, *found.nodes_got]


def held(cells, nodes, rows, patches):
    """Return what cells and nodes of finite capacity gained (env,) [J]."""
    capacity = patches.objects.volumetric_heat * patches.objects.volume
    own = torch.where(capacity.isfinite(), nodes, 0.0) * torch.where(capacity.isfinite(), capacity, 0.0)
    return (cells.double().sum(dim=(2, 3, 4)) * rows.capacity).sum(dim=1) + own.sum(dim=1)


def check(case):
    """What the kernel finds is what the definition does; what is gained is what came in; nothing leaves the range."""
    exact, arguments = (heat_steps.arguments(case, dtype) for dtype in (torch.float64, torch.float32))
    assert HEAT_STEP.takes_kernel(*arguments), case
    expected, found = step(*exact), HEAT_STEP(*arguments)
    temperatures, joules = parts(found)
    for (name, part), (_, other) in zip(temperatures, parts(expected)[0], strict=True):
        assert (part.double() - other).abs().max() < RESOLUTION * 80.0, (case, name)
    for part, other in zip(joules, parts(expected)[1], strict=True):
        scale = max(1e-3, float(other.abs().max()))
        assert (part.double() - other).abs().max() < 10 * RESOLUTION * scale, (case, part, other)
    cells, nodes, rows, patches, constants, _ = arguments
    if "source" not in constants:
        after = torch.cat([(cells + found.cells).flatten(1), nodes + found.nodes], dim=1)
        before = torch.cat([cells.flatten(1), nodes, torch.zeros(len(nodes), 1)], dim=1)
        assert (after.amax(dim=1) <= before.amax(dim=1) + 1e-5).all() and (after.amin(dim=1) >= before.amin(dim=1) - 1e-5).all()
    rows, patches = exact[2], exact[3]
    finite = torch.isfinite(patches.objects.volume)
    if bool(finite.all()):
        came = sum(part.double().sum(dim=1) for part in (*found.got[:3], *found.nodes_got[:2]))
        flown = sum(part.double().abs().sum(dim=1) for part in (*found.got, *found.nodes_got))
        error = (held(found.cells, found.nodes.double(), rows, patches) - came).abs()
        assert (error <= 1e-5 * flown + 1e-6).all(), (case, error, flown)


def check_strange_numbers():
    """A pose that is not a number comes out, in no other environment."""
    arguments = heat_steps.arguments("one object", torch.float32)
    arguments[3].pos[1][2] = torch.nan
    found = HEAT_STEP(*arguments)
    assert found.cells[2].isnan().all(dim=1).any() and not found.cells[[0, 1, 3]].isnan().any()
    assert found.nodes[2].isnan().all() and not found.nodes[[0, 1, 3]].isnan().any()


def compare() -> None:
    """Make all comparisons: run where `TRITON_INTERPRET` is set."""
    use_kernels()
    for case in heat_steps.CASES:
        check(case)
    check_strange_numbers()


@pytest.mark.slow
@needs_triton
def test_the_kernel_is_the_torch_code():
    interpreted(__file__)


if __name__ == "__main__":
    compare()

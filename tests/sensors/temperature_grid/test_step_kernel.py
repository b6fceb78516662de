"""The Triton kernel of a step, interpreted on the CPU, against the torch code in float64."""

import heat_steps
import pytest
import torch
from kernels import interpreted, needs_triton, use_kernels

from tgdsl.sensors.temperature_grid.step import HEAT_STEP, step

RESOLUTION = 3e-6
"""In kelvin per kelvin of range, and joules per joule that flows: a few roundings of float32."""


def parts(result):
    return [("cells", result.cells), ("nodes", result.nodes)], [*result.got, *result.nodes_got]


def gained_heat(cells, nodes, rows, patches):
    """Return the heat gained by cells and nodes of finite capacity (env,) [J]."""
    capacity = patches.objects.volumetric_heat * patches.objects.volume
    gains = torch.where(capacity.isfinite(), nodes, 0.0) * torch.where(capacity.isfinite(), capacity, 0.0)
    return (cells.double().sum(dim=(2, 3, 4)) * rows.capacity).sum(dim=1) + gains.sum(dim=1)


def check(case):
    """The kernel equals the definition; heat gained is heat received; temperatures stay in range."""
    exact, arguments = (heat_steps.arguments(case, dtype) for dtype in (torch.float64, torch.float32))
    assert HEAT_STEP.takes_kernel(*arguments), case
    expected, result = step(*exact), HEAT_STEP(*arguments)
    temperatures, joules = parts(result)
    for (name, part), (_, other) in zip(temperatures, parts(expected)[0], strict=True):
        assert (part.double() - other).abs().max() < RESOLUTION * 80.0, (case, name)
    for part, other in zip(joules, parts(expected)[1], strict=True):
        scale = max(1e-3, float(other.abs().max()))
        assert (part.double() - other).abs().max() < 10 * RESOLUTION * scale, (case, part, other)
    cells, nodes, rows, patches, constants, _ = arguments
    if "source" not in constants:
        after = torch.cat([(cells + result.cells).flatten(1), nodes + result.nodes], dim=1)
        initial = torch.cat([cells.flatten(1), nodes, torch.zeros(len(nodes), 1)], dim=1)
        assert (after.amax(dim=1) <= initial.amax(dim=1) + 1e-5).all() and (
            after.amin(dim=1) >= initial.amin(dim=1) - 1e-5
        ).all()
    rows, patches = exact[2], exact[3]
    finite = torch.isfinite(patches.objects.volume)
    if bool(finite.all()):
        received = sum(part.double().sum(dim=1) for part in (*result.got[:3], *result.nodes_got[:2]))
        exchanged = sum(part.double().abs().sum(dim=1) for part in (*result.got, *result.nodes_got))
        error = (gained_heat(result.cells, result.nodes.double(), rows, patches) - received).abs()
        assert (error <= 1e-5 * exchanged + 1e-6).all(), (case, error, exchanged)


def check_strange_numbers():
    """A NaN in a pose is returned, and reaches no other environment."""
    arguments = heat_steps.arguments("one object", torch.float32)
    arguments[3].pos[1][2] = torch.nan
    result = HEAT_STEP(*arguments)
    assert result.cells[2].isnan().all(dim=1).any() and not result.cells[[0, 1, 3]].isnan().any()
    assert result.nodes[2].isnan().all() and not result.nodes[[0, 1, 3]].isnan().any()


def compare() -> None:
    """Make all comparisons; `TRITON_INTERPRET` must be set."""
    use_kernels()
    for case in heat_steps.CASES:
        check(case)
    check_strange_numbers()


@pytest.mark.slow
@needs_triton
def test_the_kernel_matches_the_torch_code():
    interpreted(__file__)


if __name__ == "__main__":
    compare()

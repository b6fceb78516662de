"""The Triton kernel that sums over points, interpreted on the CPU, against the torch code that it replaces."""

import json

import pytest
import torch
from kernels import interpreted, needs_triton, use_kernels
from pulling_points import CASES, given

from tgdsl.geometry.planes import vec
from tgdsl.sensors.elastomer.point_anchors import POINT_SUM, Markers, ShearLoad

pytestmark = [needs_triton, pytest.mark.slow]
TOLERANCE = 1e-5
"""Relative to the largest sum: float32 errors of positions of some centimetres and of a few hundred terms."""


def sum_in_double(load: ShearLoad, markers: Markers) -> torch.Tensor:
    pos, strength, marker, normal = (
        vec(part.double() for part in planes) for planes in (load.pos, load.strength, markers.pos, markers.normal)
    )
    exact = Markers(marker, normal, markers.falloff.double(), None)
    return torch.stack(POINT_SUM(load._replace(pos=pos, strength=strength), exact))


def with_counts(load: ShearLoad) -> ShearLoad:
    """Return points with the loading ones first, and their number; the other points' numbers are NaN."""
    loads = torch.stack(load.strength).ne(0).any(dim=0)
    order = torch.argsort(loads.int(), dim=-1, descending=True, stable=True)
    count = loads.sum(dim=-1, dtype=torch.int32)
    is_one = torch.arange(loads.shape[-1]) < count[..., None]
    pos, strength = (
        vec(torch.where(is_one, part.gather(-1, order), torch.nan) for part in planes) for planes in (load.pos, load.strength)
    )
    return load._replace(pos=pos, strength=strength, num_active=count)


def main() -> None:
    """Print the results of all cases, as a process that interprets kernels."""
    use_kernels()

    def run(load: ShearLoad, markers: Markers) -> torch.Tensor:
        return torch.stack(POINT_SUM(load, markers))

    results = {}
    for name, case in CASES.items():
        load, markers = given(*case)
        expected = sum_in_double(load, markers)
        scale = expected.abs().max().clamp(min=1e-12)
        results[name] = [
            float((run(selected, markers) - expected).abs().max() / scale) for selected in (load, with_counts(load))
        ]

    load, markers = given(3, 20, 10, 0.5)
    wide = load._replace(
        pos=vec(torch.cat([0 * part, part], dim=1)[:, 3:] for part in load.pos),
        strength=vec(torch.cat([0 * part, part], dim=1)[:, 3:] for part in load.strength),
    )
    results["rows apart"] = float((run(wide, markers) - run(load, markers)).abs().max())

    load.pos[1][0, 1] = torch.nan  # a pose
    load.strength[2][1, 1, 13] = torch.nan
    for part in load.strength:
        part[0] = 0
    isnan = run(load, markers).isnan()
    selected = slice(1, -1)
    results["not a number"] = [
        isnan[:, 0, selected].all().item(),
        isnan[:2, 1].any().item(),
        isnan[2, 1, selected].all().item(),
        isnan[:, 2].any().item() or isnan[..., [0, -1]].any().item(),
    ]
    results["no environment"] = list(run(*given(0, 20, 10, 0.5)).shape)
    print(json.dumps(results))


@pytest.fixture(scope="module")
def results() -> dict:
    return json.loads(interpreted(__file__))


@pytest.mark.parametrize("name", CASES)
def test_the_kernel_returns_the_sum(results, name):
    assert max(results[name]) < TOLERANCE  # without and with counts


def test_rows_may_lie_apart(results):
    """As the rows of some of several links do."""
    assert results["rows apart"] == 0


def test_nan_stays_in_its_environment_and_link(results):
    """A NaN in a pose, though no point is active, and one in a strength, in its component."""
    assert results["not a number"] == [True, False, True, False]


def test_no_environment_gives_an_empty_sum(results):
    assert results["no environment"] == [3, 0, 10]


if __name__ == "__main__":
    main()

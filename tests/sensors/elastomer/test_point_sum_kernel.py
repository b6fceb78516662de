"""The kernel that sums over points, by Triton's interpreter on the CPU, against the torch code that it stands in for."""

import json

import pytest
import torch
from kernels import interpreted, needs_triton, use_kernels
from pulling_points import CASES, given

from tgdsl.geometry.planes import vec
from tgdsl.sensors.elastomer.point_anchors import POINT_SUM, Markers, ShearLoad

pytestmark = [needs_triton, pytest.mark.slow]
TOLERANCE = 1e-5
"""Of the largest sum: what float32 leaves of positions of some centimetres and of a few hundred terms."""


def in_double(load: ShearLoad, markers: Markers) -> torch.Tensor:
    pos, strength, marker, normal = (
        vec(part.double() for part in planes) for planes in (load.pos, load.strength, markers.pos, markers.normal)
    )
    exact = Markers(marker, normal, markers.falloff.double(), None)
    return torch.stack(POINT_SUM(load._replace(pos=pos, strength=strength), exact))


def counted(load: ShearLoad) -> ShearLoad:
    """Return points, those that load first, and how many they are; the others' numbers are none at all."""
    loads = torch.stack(load.strength).ne(0).any(dim=0)
    order = torch.argsort(loads.int(), dim=-1, descending=True, stable=True)
    count = loads.sum(dim=-1, dtype=torch.int32)
    is_one = torch.arange(loads.shape[-1]) < count[..., None]
    pos, strength = (
        vec(torch.where(is_one, part.gather(-1, order), torch.nan) for part in planes) for planes in (load.pos, load.strength)
    )
    return load._replace(pos=pos, strength=strength, count=count)


def main() -> None:
    """Print the results of all cases, as a process that interprets kernels."""
    use_kernels()

    def run(load: ShearLoad, markers: Markers) -> torch.Tensor:
        return torch.stack(POINT_SUM(load, markers))

    found = {}
    for name, case in CASES.items():
        load, markers = given(*case)
        expected = in_double(load, markers)
        scale = expected.abs().max().clamp(min=1e-12)
        found[name] = [float((run(own, markers) - expected).abs().max() / scale) for own in (load, counted(load))]

    load, markers = given(3, 20, 10, 0.5)
    wide = load._replace(
        pos=vec(torch.cat([0 * part, part], dim=1)[:, 3:] for part in load.pos),
        strength=vec(torch.cat([0 * part, part], dim=1)[:, 3:] for part in load.strength),
    )
    found["rows apart"] = float((run(wide, markers) - run(load, markers)).abs().max())

    load.pos[1][0, 1] = torch.nan  # a pose
    load.strength[2][1, 1, 13] = torch.nan
    for part in load.strength:
        part[0] = 0
    isnan = run(load, markers).isnan()
    own = slice(1, -1)
    found["not a number"] = [
        isnan[:, 0, own].all().item(),
        isnan[:2, 1].any().item(),
        isnan[2, 1, own].all().item(),
        isnan[:, 2].any().item() or isnan[..., [0, -1]].any().item(),
    ]
    found["no environment"] = list(run(*given(0, 20, 10, 0.5)).shape)
    print(json.dumps(found))


@pytest.fixture(scope="module")
def found() -> dict:
    return json.loads(interpreted(__file__))


@pytest.mark.parametrize("name", CASES)
def test_kernel_is_the_sum(found, name):
    assert max(found[name]) < TOLERANCE  # of strengths, and of how many there are


def test_rows_may_lie_apart(found):
    """As those of some links of several do."""
    assert found["rows apart"] == 0


def test_not_a_number_comes_out(found):
    """Of a pose, though no point is active; of a strength in its own component; and of no other environment or link."""
    assert found["not a number"] == [True, False, True, False]


def test_no_environment_is_nothing(found):
    assert found["no environment"] == [3, 0, 10]


if __name__ == "__main__":
    main()

"""The kernel that sums over points, by Triton's interpreter on the CPU, against the torch code that it stands in for."""

import json

import pytest
import torch
from kernels import interpreted, needs_triton, use_kernels
from pulling_points import CASES, given

from tgdsl.geometry.planes import vec
from tgdsl.sensors.elastomer.point_anchors import POINT_SUM, Markers, Pull

pytestmark = needs_triton
TOLERANCE = 1e-5
"""Of the largest sum: what float32 leaves of positions of some centimetres and of a few hundred terms."""


def in_double(pull: Pull, markers: Markers) -> torch.Tensor:
    pos, strength, marker, normal = (
        vec(part.double() for part in planes) for planes in (pull.pos, pull.strength, markers.pos, markers.normal)
    )
    exact = Markers(marker, normal, markers.falloff.double(), None)
    return torch.stack(POINT_SUM(pull._replace(pos=pos, strength=strength), exact))


def counted(pull: Pull) -> Pull:
    """Return points, those that pull first, and how many they are; the others' numbers are none at all."""
    pulls = torch.stack(pull.strength).ne(0).any(dim=0)
    order = torch.argsort(pulls.int(), dim=-1, descending=True, stable=True)
    count = pulls.sum(dim=-1, dtype=torch.int32)
    is_one = torch.arange(pulls.shape[-1]) < count[..., None]
    pos, strength = (
        vec(torch.where(is_one, part.gather(-1, order), torch.nan) for part in planes) for planes in (pull.pos, pull.strength)
    )
    return pull._replace(pos=pos, strength=strength, count=count)


def main() -> None:
    """Print the results of all cases, as a process that interprets kernels."""
    use_kernels()

    def run(pull: Pull, markers: Markers) -> torch.Tensor:
        return torch.stack(POINT_SUM(pull, markers))

    found = {}
    for name, case in CASES.items():
        pull, markers = given(*case)
        expected = in_double(pull, markers)
        scale = expected.abs().max().clamp(min=1e-12)
        found[name] = [float((run(own, markers) - expected).abs().max() / scale) for own in (pull, counted(pull))]

    pull, markers = given(3, 20, 10, 0.5)
    wide = pull._replace(
        pos=vec(torch.cat([0 * part, part], dim=1)[:, 3:] for part in pull.pos),
        strength=vec(torch.cat([0 * part, part], dim=1)[:, 3:] for part in pull.strength),
    )
    found["rows apart"] = float((run(wide, markers) - run(pull, markers)).abs().max())

    pull.pos[1][0, 1] = torch.nan  # a pose
    pull.strength[2][1, 1, 13] = torch.nan
    for part in pull.strength:
        part[0] = 0
    isnan = run(pull, markers).isnan()
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
    """Of a pose, though nothing pulls; of a strength in its own component; and of no other environment or link."""
    assert found["not a number"] == [True, False, True, False]


def test_no_environment_is_nothing(found):
    assert found["no environment"] == [3, 0, 10]


if __name__ == "__main__":
    main()

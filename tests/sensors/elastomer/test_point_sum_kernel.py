"""The kernel that sums over points, by Triton's interpreter on the CPU, against the torch code that it stands in for."""

import json

import pytest
import torch
from kernels import interpreted, needs_triton

from tgdsl.geometry.planes import Vec, vec
from tgdsl.quantities.points.points import point_tiles, tile_size
from tgdsl.sensors.elastomer.point_anchors import Markers, ShearLoad, _summed

pytestmark = needs_triton
TOLERANCE = 1e-5
"""Of the largest sum: what float32 leaves of positions of some centimetres and of a few hundred terms."""
FALLOFF = 2000.0
CASES = {
    "one": (1, 1, 1, 1.0),
    "few": (3, 7, 5, 0.5),
    "a group that is not full": (2, 41, 33, 0.3),
    "two chunks, a block that is not full": (2, 300, 100, 0.2),
    "two blocks": (2, 70, 150, 1.0),
    "nothing active": (2, 50, 40, 0.0),
}
"""Environments, points, markers, and share of active points."""


def given(num_envs: int, num_points: int, num_markers: int, share: float) -> tuple[ShearLoad, Markers]:
    """Return active points in float32, in runs, and markers with normals all around, both signs of z among them.

    There are three links: one has most of the markers, one the last, the third none; the first marker is of no link.
    """
    random = torch.Generator().manual_seed(num_points)

    def drawn(scale: float, *shape: int) -> Vec:
        return vec(scale * torch.randn(shape, generator=random) for _ in range(3))

    start = torch.randint(num_points, (num_envs, 3, 1), generator=random)
    is_active = (torch.arange(num_points) - start) % num_points < share * num_points
    strength = vec(part * is_active for part in drawn(1e-7, num_envs, 3, num_points))
    normal = torch.nn.functional.normalize(torch.stack(drawn(1.0, num_markers)), dim=0)
    normal[:, 0] = torch.tensor([0.0, 0.0, -1.0])
    markers = Markers(drawn(0.03, num_markers), vec(normal.unbind()), torch.tensor(FALLOFF), None)
    last = num_markers - 1
    taxels = ((last, num_markers), (min(1, last), last), (0, 0))
    tiles = torch.tensor(point_tiles(taxels, num_markers), dtype=torch.int32)
    return ShearLoad(taxels, tiles, torch.ones(1, 1), drawn(0.03, num_envs, 3, num_points), strength), markers


def in_double(load: ShearLoad, markers: Markers) -> torch.Tensor:
    pos, strength, marker, normal = (
        vec(part.double() for part in planes) for planes in (load.pos, load.strength, markers.pos, markers.normal)
    )
    exact = Markers(marker, normal, markers.falloff.double(), None)
    return torch.stack(_summed(load._replace(pos=pos, strength=strength), exact))


def told(load: ShearLoad) -> ShearLoad:
    """Return points, the active ones first, and their number; the others' numbers are none at all."""
    is_active = torch.stack(load.strength).ne(0).any(dim=0)
    order = torch.argsort(is_active.int(), dim=-1, descending=True, stable=True)
    count = is_active.sum(dim=-1, dtype=torch.int32)
    is_one = torch.arange(is_active.shape[-1]) < count[..., None]
    pos, strength = (
        vec(torch.where(is_one, part.gather(-1, order), torch.nan) for part in planes) for planes in (load.pos, load.strength)
    )
    return load._replace(pos=pos, strength=strength, count=count)


def main() -> None:
    """Print the results of all cases, as a process that interprets kernels."""
    from tgdsl.sensors.elastomer.point_sum_kernel import launch, point_sum_kernel

    def run(load: ShearLoad, markers: Markers) -> torch.Tensor:
        how = (load.count, load.tiles, tile_size(load.taxels))
        return launch(point_sum_kernel, load.pos, load.strength, *how, markers.pos, markers.normal, markers.falloff)

    found = {}
    for name, case in CASES.items():
        load, markers = given(*case)
        expected = in_double(load, markers)
        scale = expected.abs().max().clamp(min=1e-12)
        found[name] = [float((run(own, markers) - expected).abs().max() / scale) for own in (load, told(load))]

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

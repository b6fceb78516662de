"""Points that load at markers at random: what tests of the sum over points are given."""

import torch

from tgdsl.geometry.planes import Vec, vec
from tgdsl.quantities.points import point_tiles
from tgdsl.sensors.elastomer.point_anchors import Markers, ShearLoad

FALLOFF = 2000.0


CASES = {
    "one": (1, 1, 1, 1.0),
    "few": (3, 7, 5, 0.5),
    "a group that is not full": (2, 41, 33, 0.3),
    "two chunks, a block that is not full": (2, 300, 100, 0.2),
    "two blocks": (2, 70, 150, 1.0),
    "nothing loads": (2, 50, 40, 0.0),
}
"""Environments, points, markers, and which part of the points loads."""


def given(num_envs: int, num_points: int, num_markers: int, share: float) -> tuple[ShearLoad, Markers]:
    """Return points in float32 that load in runs, and markers with normals all around, both signs of z among them.

    There are three links: one has most of the markers, one the last, the third none; the first marker is of no link.
    """
    random = torch.Generator().manual_seed(num_points)

    def drawn(scale: float, *shape: int) -> Vec:
        return vec(scale * torch.randn(shape, generator=random) for _ in range(3))

    start = torch.randint(num_points, (num_envs, 3, 1), generator=random)
    loads = (torch.arange(num_points) - start) % num_points < share * num_points
    strength = vec(part * loads for part in drawn(1e-7, num_envs, 3, num_points))
    normal = torch.nn.functional.normalize(torch.stack(drawn(1.0, num_markers)), dim=0)
    normal[:, 0] = torch.tensor([0.0, 0.0, -1.0])
    markers = Markers(drawn(0.03, num_markers), vec(normal.unbind()), torch.tensor(FALLOFF), None)
    last = num_markers - 1
    taxels = ((last, num_markers), (min(1, last), last), (0, 0))
    tiles = torch.tensor(point_tiles(taxels, num_markers), dtype=torch.int32)
    return ShearLoad(taxels, tiles, torch.ones(1, 1), drawn(0.03, num_envs, 3, num_points), strength), markers

"""Points of an object that meet links in grids of spheres, at random: what tests of kernels are given."""

from functools import partial

import torch

from tgdsl.geometry import planes
from tgdsl.geometry.grid import Grid
from tgdsl.geometry.planes import rot, split, vec
from tgdsl.quantities.geoms import Geoms
from tgdsl.quantities.pairs import Pairs
from tgdsl.quantities.points import ObjectPoints, PointSource, point_tiles

NUM_ENVS, CELL = 4, 0.002
CASES = {
    # points, links, how each geom's grids are interpolated, whether the object differs between environments, is it gated
    "one link": (10, 1, ["trilinear"], False, False),
    "cubes": (70, 3, ["tricubic"], False, True),
    "many points": (130, 2, ["tricubic"], True, True),
    "several meshes": (40, 3, ["trilinear", "tricubic"], False, False),
}
NUMS = ((9, 7, 8), (6, 11, 5), (2, 2, 2))
"""Nodes along the axes of each link's grid of the first geom; of the second those of the next link."""


def nums_of(case, g):
    """Return the numbers of nodes along the axes of each link's grid of a geom."""
    return torch.tensor([NUMS[(link + g) % 3] for link in range(CASES[case][1])])


def spheres(nums, cells, dtype):
    """Return grids of distances to spheres about their middles."""
    values, first = [], [0]
    for num, cell in zip(nums, cells.double(), strict=True):
        places = torch.cartesian_prod(*(torch.arange(n, dtype=torch.float64) - (n - 1) / 2 for n in num.tolist()))
        values.append(cell * places.norm(dim=1) - 0.003)
        first.append(first[-1] + len(places))
    origins = -0.5 * cells[:, None] * (nums - 1)
    return Grid(
        torch.cat(values).float().to(dtype),
        torch.tensor(first[:-1])[:, None],
        split(nums[:, None]),
        split(origins[:, None]),
        cells[:, None],
    )


def made(case, dtype):
    """Return pairs, and an object's points with the links that they may meet: spheres in grids of their own."""
    num_points, num_links, shapes, differs, is_gated = CASES[case]
    rng = torch.Generator().manual_seed(len(case))
    draw = partial(torch.randn, generator=rng, dtype=torch.float64)
    cells = CELL * (1 + torch.arange(num_links)).to(dtype)
    grids = tuple(spheres(nums_of(case, g), cells, dtype) for g in range(len(shapes)))
    place = (0.002 * draw(num_links, len(shapes), 3)).to(dtype)
    turns = torch.stack(planes.rotation(draw(num_links, len(shapes), 4)), dim=-1).to(dtype)
    is_absent = None
    if len(shapes) > 1:
        is_absent = torch.zeros((num_links, len(shapes)), dtype=torch.bool)
        is_absent[0, 1] = is_absent[2, 0] = True
    every = torch.arange(num_links)
    links = Geoms(tuple(shapes), (False,) * len(shapes), place, place, turns, is_absent, every, grids)
    num_pairs = num_links + 2
    parts = [*planes.rotation(draw(NUM_ENVS, num_pairs, 4)), *(0.003 * draw(3, NUM_ENVS, num_pairs))]
    parts = torch.stack(list(parts), dim=1).to(dtype)
    parts[:, :, 0] = torch.nan  # a pair that nobody asks for
    gate = torch.where(draw(NUM_ENVS, num_pairs) > 0.4, -torch.inf, 0.0).to(dtype) if is_gated else None
    pairs = Pairs(rot(parts[:, :9].unbind(1)), vec(parts[:, 9:].unbind(1)), None, gate)
    points = vec((0.006 * draw(3, NUM_ENVS if differs else 1, 1, num_points)).to(dtype))
    pair, taxels = 1 + torch.randperm(num_links, generator=rng), tuple((k, k + 1) for k in range(num_links))
    tiles = torch.tensor(point_tiles(taxels, num_links), dtype=torch.int32)
    return ObjectPoints(pairs, PointSource("cube", pair, taxels, tiles, points, torch.ones(1, 1, dtype=dtype), links))

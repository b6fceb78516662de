"""The kernel's results for one geom at a time combine to the definition."""

import sys
from types import SimpleNamespace

import pytest
import torch
from meetings import CASES, made

from tgdsl.geometry import planes
from tgdsl.quantities.geoms import body_distance
from tgdsl.quantities.points import LINK_POINTS, link_points


def meet(pairs, pair, points, links, g):
    """Do what the kernel does for one geom: return positions in the links' frames, distances and gradients."""
    rotation, offset = ([part[:, pair, None] for part in parts] for parts in (pairs.rotation, pairs.offset))
    pos = planes.rotate_back(planes.rot(rotation), planes.sub(points, planes.vec(offset)))
    parts = {name: getattr(links, name)[:, g : g + 1] for name in ("size", "pos", "rotation")}
    alone = {name: getattr(links, name)[g : g + 1] for name in ("shapes", "is_centred", "surfaces")}
    distance, gradient = body_distance(pos, links._replace(**parts, **alone, is_absent=None))
    is_closed = False if pairs.gate is None else pairs.gate[:, pair, None] < 0
    return pos, torch.where(torch.as_tensor(is_closed), torch.inf, distance), gradient


@pytest.mark.parametrize("case", CASES)
def test_combined_kernel_results_match_the_definition(monkeypatch, case):
    monkeypatch.setitem(sys.modules, "tgdsl.quantities.depth_kernel", SimpleNamespace(meet=meet))
    points = made(case, torch.float64)
    result, expected = LINK_POINTS.kernel(points), link_points(points)
    for name in ("pos", "distance", "gradient", "area"):
        torch.testing.assert_close(getattr(result, name), getattr(expected, name), rtol=0, atol=1e-12)
    assert result.taxels == points.source.taxels and torch.equal(result.tiles, points.source.tiles)
    assert (result.distance == torch.inf).any() == (points.pairs.gate is not None)

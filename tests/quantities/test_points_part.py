"""Which indices a plan of points may hold: tiles of links that are met and of taxels that are there."""

import re
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from tgdsl.errors import ArtifactError
from tgdsl.plan.ranges import check
from tgdsl.quantities.points import CloudPart, MetObject, PointsPart, PointsUse

NUM_TAXELS = 40


@dataclass(frozen=True)
class Plan:
    """As much of a plan as is looked at."""

    objects: tuple[str, ...]
    layout: SimpleNamespace
    pairs: SimpleNamespace
    quantities: dict[str, PointsPart]


def checked(*tile):
    """Look at a plan of two links and one object with a tile: its link, its first taxel, one beyond its last."""
    tiles = np.array([[0, 0, 32], [1, 32, NUM_TAXELS], tile], dtype=np.int32)
    met = MetObject(0, (0, 1), ((0, 32), (32, NUM_TAXELS)), np.array([0, 1]), np.array([0, 1]), tiles)
    part = PointsPart(("pad", "tip"), None, (CloudPart(0, np.zeros((3, 1, 5)), np.ones(1)),), (PointsUse(False, (met,)),))
    layout, pairs = SimpleNamespace(num_taxels=NUM_TAXELS), SimpleNamespace(link=np.array([0, 1]))
    check(Plan(("ball",), layout, pairs, {"points": part}))


@pytest.mark.parametrize("tile", [(-1, 0, 32), (1, 0, NUM_TAXELS), (1, NUM_TAXELS, NUM_TAXELS)])
def test_tiles_of_no_link_and_up_to_the_last_taxel_are_right(tile):
    checked(*tile)


@pytest.mark.parametrize(
    ("tile", "found"),
    [
        ((-2, 0, 32), "-2, expected -1 to 1"),
        ((2, 0, 32), "2, expected -1 to 1"),
        ((0, NUM_TAXELS + 1, 32), "41, expected -1 to 40"),
        ((0, 0, NUM_TAXELS + 1), "41, expected -1 to 40"),
    ],
)
def test_tiles_of_what_is_not_there_are_refused_by_name(tile, found):
    message = re.escape(f'"quantities/points/uses/0/objects/0/tiles" holds {found}')
    with pytest.raises(ArtifactError, match=f"{message}$"):
        checked(*tile)

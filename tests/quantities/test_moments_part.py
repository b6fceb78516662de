"""Which indices a plan of moments may hold: each of a node that is there."""

import re
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from tgdsl.errors import ArtifactError
from tgdsl.plan.ranges import check
from tgdsl.quantities.moments import FieldTable, MomentsPart, MomentTable, MomentUse

FIELDS = FieldTable(
    values=np.zeros((2 * 2 * 2 + 3 * 4 * 5, 4), np.float32),
    first=np.array([0, 8]),
    num=np.array([[2, 2, 2], [3, 4, 5]]),
    origin=np.zeros((2, 3)),
    cell=np.ones(2),
    counts=(2, 2, 2),
    is_smooth=False,
)
"""Fields of 8 and of 60 nodes, one after the other."""


@dataclass(frozen=True)
class Plan:
    """As much of a plan as is looked at."""

    objects: tuple[SimpleNamespace, ...]
    quantities: dict[str, MomentsPart]


def checked(radius_id=(0, 1), **changed):
    """Look at a plan with these fields of moments, by a variant and two radii, and two probes."""
    table = MomentTable(0, (0.01, 0.02), np.ones(1), np.zeros((0, 3)), np.zeros((0, 9)), replace(FIELDS, **changed), ())
    pair, reach = np.zeros((1, 2), int), np.full((1, 2), 0.01)
    use = MomentUse((0,), np.zeros((3, 2)), pair, reach, np.array([radius_id]), "", False)
    check(Plan((SimpleNamespace(num_pairs=1),), {"moments": MomentsPart((table,), (use,))}))


def test_fields_that_end_where_the_nodes_do_are_right():
    """The second one's last node is the last of all; two nodes along an axis are one cell."""
    checked()


@pytest.mark.parametrize(
    ("name", "value", "found"),
    [
        ("first", np.array([0, 9]), "9, expected 0 to 8"),
        ("first", np.array([61, 8]), "61, expected 0 to 60"),
        ("first", np.array([-1, 8]), "-1, expected 0 to 60"),
        ("num", np.array([[2, 2, 1], [3, 4, 5]]), "1, expected at least 2"),
    ],
)
def test_nodes_that_are_not_there_are_refused_by_name(name, value, found):
    with pytest.raises(ArtifactError, match=re.escape(f'"quantities/moments/tables/0/surface/{name}" holds {found}') + "$"):
        checked(**{name: value})


def test_radii_that_are_not_there_are_refused_by_name():
    with pytest.raises(ArtifactError, match=r'"quantities/moments/uses/0/radius_id" holds 2, expected 0 to 1$'):
        checked(radius_id=(0, 2))

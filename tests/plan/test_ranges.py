"""Indices of nothing are refused with the place where they are: arrays, members of tuples and values of mappings."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pytest

from tgdsl.errors import ArtifactError
from tgdsl.fields.indices import indices
from tgdsl.plan.ranges import check, check_constants


@dataclass(frozen=True, eq=False)
class Part:
    name: str
    array: np.ndarray | None = field(metadata=indices(lambda own, part, plan: plan.count))
    each: tuple[np.ndarray, ...] = field(metadata=indices(lambda own, part, plan: (2, np.array([1, 5]))))
    rows: Mapping[str, np.ndarray] = field(metadata=indices(lambda own, part, plan: {"taxels": 4}))
    cell: np.ndarray = field(metadata=indices(None, least=-1))


@dataclass(frozen=True, eq=False)
class Whole:
    parts: tuple[Part, ...]
    count: int = 3


def whole(array=(0, 2), each=((0, 1), (0, 4)), rows=(0, 3), other=(99,), cell=(-1, 1000)) -> Whole:
    ints = [np.array(values) for values in (rows, other, cell)]
    own = None if array is None else np.array(array)
    part = Part("a", own, tuple(map(np.array, each)), {"taxels": ints[0], "weights": ints[1]}, ints[2])
    return Whole((part,))


@pytest.mark.parametrize("given", [{}, {"array": None}, {"array": np.zeros(0)}])
def test_indices_of_what_is_there_pass(given):
    check(whole(**given))


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"array": (0, 3)}, 'the array "parts/a/array" holds 3, expected 0 to 2'),
        ({"array": (-1, 0)}, 'the array "parts/a/array" holds -1, expected 0 to 2'),
        ({"array": (0.0, 1.0)}, 'the array "parts/a/array" is float64, expected integers'),
        ({"each": ((0, 2), (0, 4))}, 'the array "parts/a/each/0" holds 2, expected 0 to 1'),
        ({"each": ((0, 1), (1, 4))}, 'the array "parts/a/each/1" holds 1, expected 0 to 0'),
        ({"rows": (4,)}, 'the array "parts/a/rows/taxels" holds 4, expected 0 to 3'),
        ({"cell": (-2, 0)}, 'the array "parts/a/cell" holds -2, expected at least -1'),
    ],
)
def test_indices_of_nothing_are_named(given, says):
    with pytest.raises(ArtifactError) as caught:
        check(whole(**given))
    assert str(caught.value) == says


def test_a_tuple_of_another_length_does_not_fit():
    with pytest.raises(ArtifactError, match="not a plan: parts/a/each does not fit the rest of it"):
        check(whole(each=((0, 1),)))


def test_constants_of_a_kind_are_looked_at_by_name():
    check_constants("touch", {"taxels": np.array([0, 4]), "weight": np.array([0.5])}, {"taxels": 5, "absent": 1})
    with pytest.raises(ArtifactError) as caught:
        check_constants("touch", {"taxels": np.array([0, 5])}, {"taxels": 5})
    assert str(caught.value) == 'the array "touch/taxels" holds 5, expected 0 to 4'

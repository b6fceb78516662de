"""Trees of frozen dataclasses with arrays as leaves: names, values and types come back, and nothing else is taken for them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, Literal, TypeVar

import numpy as np
import pytest

from tgdsl.plan import tree

Array = TypeVar("Array")


@dataclass(frozen=True, eq=False)
class Leaf(Generic[Array]):
    name: str
    values: Mapping[str, Array] = field(metadata=tree.INLINE)
    extra: Array | None = None


@dataclass(frozen=True, eq=False)
class Other(Generic[Array]):
    size: tuple[int, int]
    way: Literal["a", "b"]
    array: Array


@dataclass(frozen=True, eq=False)
class Root(Generic[Array]):
    parts: tuple[Leaf[Array] | Other[Array] | None, ...]
    scale: float
    shared: Array


def made() -> Root[np.ndarray]:
    one = np.arange(3.0)
    leaf = Leaf("first", {"k": one, "m": np.array([[1, 2]])}, np.ones((2, 2)))
    return Root((leaf, None, Other((1, 2), "b", one)), 2.0, one)


def test_leaves_have_the_names_of_their_places_and_an_array_in_two_places_has_one():
    plain, arrays = tree.flatten(made())
    assert sorted(arrays) == ["parts/first/extra", "parts/first/k", "parts/first/m"]
    assert plain["parts"][2]["array"] == plain["shared"] == {"array": "parts/first/k"}


def test_what_was_flattened_comes_back():
    plain, arrays = tree.flatten(made())
    again = tree.restored(Root, plain, arrays)
    assert tree.flatten(again)[0] == plain
    assert again.parts[1] is None and again.parts[2].size == (1, 2) and again.shared is again.parts[0].values["k"]


def test_a_mapped_tree_changes_each_array_once_and_keeps_what_has_none():
    root, seen = made(), []
    again = tree.mapped(root, lambda array: seen.append(array) or array.astype(np.float32))
    assert len(seen) == 3 and again.shared is again.parts[2].array and again.shared.dtype == np.float32
    assert tree.mapped(root, lambda array: array) is root


def test_a_mapping_of_which_one_part_changes_is_another():
    assert tree.mapped({"name": "k", "array": np.zeros(2)}, lambda array: "leaf") == {"name": "k", "array": "leaf"}


@pytest.mark.parametrize(
    ("place", "value"),
    [(("shared",), {"array": "nowhere"}), (("parts", 2, "size"), [1]), (("parts", 0), {"name": "x"}), (("more",), 1)],
)
def test_what_is_not_of_the_type_is_refused(place, value):
    plain, arrays = tree.flatten(made())
    *way, last = place
    holder = plain
    for part in way:
        holder = holder[part]
    holder[last] = value
    with pytest.raises((TypeError, KeyError, ValueError)):
        tree.restored(Root, plain, arrays)


@pytest.mark.parametrize(
    ("given", "kind"),
    [(np.int32, np.int32), (np.uint8, np.int64), (bool, np.int64), (np.float32, np.float32), (float, np.float64)],
)
def test_frozen_arrays_are_of_the_plans_dtypes(given, kind):
    array = tree.frozen(np.array([[0, 1], [1, 0]], dtype=given).T)
    assert array.dtype == kind and array.flags.c_contiguous and not array.flags.writeable


def test_numbers_of_numpy_are_plain_and_lists_are_walked():
    assert tree.flatten({"a": np.int64(3), "b": [np.float64(0.5), np.bool_(True)]})[0] == {"a": 3, "b": [0.5, True]}
    assert tree.mapped([np.zeros(2)], lambda array: "leaf") == ("leaf",)

"""Fields of dataclasses that hold indices: from how many things they choose is declared beside them.

What a compiled module is built from is checked against it once, when an artefact is loaded: see `plan.ranges`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

KEY = "indices"
"""Key of the declaration in a field's metadata."""
Count = Callable[[Any, Any, Any], Any]
"""Called with the record that has the field, the part of the Plan that the record is in, such as a quantity's, and the Plan.

Returns how many things there are: a number; an array that broadcasts against the field's; of a tuple's members a tuple; of a
mapping's values a mapping, where those it lacks are no indices.
"""


@dataclass(frozen=True)
class Indices:
    """Integers from `least` on, less than a count; with None there is no largest one."""

    count: Count | None
    least: int = 0


def indices(count: Count | None, least: int = 0, **metadata: Any) -> dict[str, Any]:
    """Return the metadata of a dataclass's field of indices: an array, an integer, or a tuple or mapping of these.

    Args:
        count: How many things they choose from.
        least: The least one: −1 where that stands for none, 1 of a number of things.
        metadata: What else is said of the field.
    """
    return {KEY: Indices(count, least), **metadata}

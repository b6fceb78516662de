"""Tensors that are kept by name: copied out, and put back in place."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from tgdsl.errors import SimulationError, listed


def refuse_other(own: Mapping[str, Mapping[str, Tensor]], given: Mapping[str, Mapping[str, Tensor]]) -> None:
    """Refuse tensors, by part and name, that were saved of something else.

    Raises:
        SimulationError: If parts, or names or shapes in one, differ.
    """
    if wrong := sorted(own.keys() ^ given.keys()):
        raise SimulationError(f"the state that was saved is of other environments: {listed(wrong)} missing or not known")
    for part, tensors in own.items():
        shapes, saved = ({name: value.shape for name, value in each.items()} for each in (tensors, given[part]))
        if wrong := [name for name in {**shapes, **saved} if shapes.get(name) != saved.get(name)]:
            problem = f"{listed(wrong)} missing or of another shape"
            raise SimulationError(f"the {part} that was saved is of other environments: {problem}")


def restore(own: Mapping[str, Tensor], given: Mapping[str, Tensor]) -> None:
    """Put what was saved into the tensors of the same names."""
    with torch.no_grad():
        for name, value in given.items():
            own[name].copy_(value)


def copied(made: Any) -> Any:
    """Return copies of all tensors in dictionaries and named tuples: a graph's own are overwritten at its next replay."""
    if isinstance(made, Tensor):
        return made.clone()
    if isinstance(made, Mapping):
        return {name: copied(value) for name, value in made.items()}
    return type(made)(*(copied(value) for value in made))

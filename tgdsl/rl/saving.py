"""Tensors that are kept by name: copied out, and put back in place."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from tgdsl.errors import SimulationError, listed


def saved(memory: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return copies."""
    return {name: value.clone() for name, value in memory.items()}


def refuse_other(own: Mapping[str, Tensor], given: Mapping[str, Tensor], what: str) -> None:
    """Refuse what was saved of something else.

    Raises:
        SimulationError: If names or shapes differ.
    """
    wrong = [name for name in {**own, **given} if name not in own or name not in given or own[name].shape != given[name].shape]
    if wrong:
        raise SimulationError(
            f"the {what} that was saved is of other environments: {listed(wrong)} missing or of another shape"
        )


def refuse_other_parts(own: Mapping[str, Mapping[str, Tensor]], given: Mapping[str, Mapping[str, Tensor]]) -> None:
    """Refuse what was saved of something else, part by part.

    Raises:
        SimulationError: If parts, or names or shapes in one, differ.
    """
    if wrong := sorted(own.keys() ^ given.keys()):
        raise SimulationError(f"the state that was saved is of other environments: {listed(wrong)} missing or not known")
    for part, tensors in own.items():
        refuse_other(tensors, given[part], part)


def restore(own: Mapping[str, Tensor], given: Mapping[str, Tensor]) -> None:
    """Put what was saved into the tensors of the same names."""
    with torch.no_grad():
        for name, value in given.items():
            own[name].copy_(value)


def copied(made: Any) -> Any:
    """Return copies of all tensors in dictionaries and named tuples: a graph's own are overwritten at its next replay."""
    if isinstance(made, Tensor):
        return made.clone()
    if isinstance(made, dict):
        return {name: copied(value) for name, value in made.items()}
    return type(made)(*(copied(value) for value in made))

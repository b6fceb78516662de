"""Numbers that change while a policy is learned: tensors on the device, which captured steps read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import torch
from torch import Tensor

from tgdsl.fields.models import SpecModel
from tgdsl.rl.load import LoadedTask
from tgdsl.rl.spec import TaskSpec
from tgdsl.rl.terms import CurriculumTerm, Term

M = TypeVar("M", bound=SpecModel)


class Curricula:
    """The curricula of a task's document.

    Attributes:
        values: The numbers that they change, by dotted path: tensors without axes.
        spec: The task's document, with these tensors in place of its own numbers.
        terms: The terms that it adds, in the same way.
    """

    def __init__(self, loaded: LoadedTask, like: Tensor):
        self._terms = {name: term for name, term in loaded.terms.items() if isinstance(term, CurriculumTerm)}
        self.values = {term.of: torch.zeros((), dtype=like.dtype, device=like.device) for term in self._terms.values()}
        self.spec: TaskSpec = _with(loaded.spec, {path: v for path, v in self.values.items() if not path.startswith("terms.")})
        other_terms = {name: term for name, term in loaded.terms.items() if name not in self._terms}
        self.terms: Mapping[str, Term] = {
            name: _with(term, _below(f"terms.{name}", self.values)) for name, term in other_terms.items()
        }
        self.advance(0, None)

    def advance(self, iteration: int, score: float | None) -> None:
        """Write the numbers at an iteration; a GPU is not waited for."""
        for term in self._terms.values():
            self.values[term.of].fill_(term.value(iteration, score))


def _below(start: str, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {path.removeprefix(f"{start}."): value for path, value in values.items() if path.startswith(f"{start}.")}


def _with(model: M, values: Mapping[str, Tensor]) -> M:
    """Return a model with other values by dotted path, which are not checked."""
    update: dict[str, Any] = {path: value for path, value in values.items() if "." not in path}
    for name in {path.partition(".")[0] for path in values} - update.keys():
        update[name] = _with(getattr(model, name), _below(name, values))
    return model.model_copy(update=update)

"""Numbers of terms that change while a policy is learned: tensors on the device, which captured steps read."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from tgdsl.rl.load import LoadedTask
from tgdsl.rl.spec import TaskSpec
from tgdsl.rl.terms import CurriculumTerm, Term


class Curricula:
    """The curricula of a task's document.

    Attributes:
        values: The numbers that they change, by dotted path: tensors without axes.
        spec: The task's document, with these weights instead of its own.
        terms: The terms that it adds, in the same way.
    """

    def __init__(self, loaded: LoadedTask, like: Tensor):
        """Begin with the numbers before the first iteration, of the dtype and on the device of `like`."""
        self._terms = {name: term for name, term in loaded.terms.items() if isinstance(term, CurriculumTerm)}
        self.values = {term.of: torch.zeros((), dtype=like.dtype, device=like.device) for term in self._terms.values()}
        self.spec: TaskSpec = loaded.spec
        if weights := self._changed("rewards."):
            rewards = getattr(loaded.spec, "rewards")  # noqa: B009 (of the task's own model)
            self.spec = loaded.spec.model_copy(update={"rewards": rewards.model_copy(update=weights)})
        other_terms = {name: term for name, term in loaded.terms.items() if name not in self._terms}
        self.terms: Mapping[str, Term] = {
            name: term.model_copy(update=self._changed(f"terms.{name}.")) for name, term in other_terms.items()
        }
        self.advance(0, None)

    def advance(self, iteration: int, score: float | None) -> None:
        """Write the numbers at an iteration; a GPU is not waited for.

        Args:
            iteration: Number of iterations so far.
            score: Mean score of the episodes that have ended last; None: none has ended yet.
        """
        for term in self._terms.values():
            self.values[term.of].fill_(term.value(iteration, score))

    def _changed(self, start: str) -> dict[str, Tensor]:
        return {path.removeprefix(start): value for path, value in self.values.items() if path.startswith(start)}

"""What it means that a module agrees with its kind's float64 reference, whose answers a suite computes once."""

from __future__ import annotations

import copy
import dataclasses
import functools
import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

from tgdsl.module.accuracy.reference import ReferenceModule, full_scale_error, row_errors
from tgdsl.module.state import SceneState

__all__ = ["assert_agrees", "full_scale_error"]


def assert_agrees(found: Tensor, reference: ReferenceModule, state: SceneState, tolerance: float) -> None:
    """Assert that readings equal the reference's, at ties that of one side; the reference then remembers this state."""
    worst = row_errors(found, reference, state, tolerance)
    env, *_, row = np.unravel_index(int(worst.argmax()), worst.shape)
    assert worst.max() <= tolerance, f"error {worst.max():.2e} of full scale in environment {env}, row {row}"


@functools.lru_cache(maxsize=8)
def answers_of(suite: type, document: str) -> dict[bytes, Any]:
    """Return what the reference of a suite's document has answered so far, by what it was asked."""
    return {}


class KnownReference(ReferenceModule):
    """A reference that computes each answer once for a whole suite, whose tests ask for readings of the same states."""

    def __init__(self, answers: dict[bytes, Any], *arguments: Any) -> None:
        super().__init__(*arguments)
        self._answers = answers

    def __call__(self, state: SceneState, shift: np.ndarray) -> tuple[np.ndarray, dict[int, dict[str, np.ndarray]]]:
        """Return what the reference does: a copy of it where it was asked that before."""
        if self.upstream:  # those remember too
            return super().__call__(state, shift)
        asked = _digest(state, shift, self.num_calls, self.memory)
        if asked not in self._answers:
            self._answers[asked] = super().__call__(state, shift)
        return copy.deepcopy(self._answers[asked])


def _digest(*values: Any) -> bytes:
    """Return a digest of states, dictionaries, sequences, tensors, arrays and plain values: of all that is in them."""
    result = hashlib.sha256()

    def add(value: Any) -> None:
        if isinstance(value, SceneState):
            add([getattr(value, field.name) for field in dataclasses.fields(value)])
        elif isinstance(value, Mapping):
            add([part for item in value.items() for part in item])
        elif isinstance(value, list | tuple):
            result.update(f"{len(value)} parts:".encode())
            for part in value:
                add(part)
        elif isinstance(value, Tensor | np.ndarray):
            array = np.ascontiguousarray(value)
            result.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
        else:
            result.update(f"{value!r};".encode())

    add(values)
    return result.digest()

"""When a reading is made, and with which random numbers.

Shapes: `env` environments, `taxel` rows of the reading.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.random import Stream

Planes = list[Tensor]
"""The channels of a signal: tensors (env, taxel)."""


class Now(NamedTuple):
    """When a reading is made.

    Attributes:
        dt: Time since the last call [s].
        step: Number of this call.
        age: Calls since each environment's reset, (env, 1); 0 at the first one.
        ages: Time since each of the calls before this one, the last one first [s]; None if no sensor wants to know.
        is_sample: Whether each environment's sensor takes a sample now, (env, 1); None: always.
        streams: The sensor's random numbers, by purpose.
    """

    dt: Tensor | None
    step: Tensor
    age: Tensor
    ages: Tensor | None
    is_sample: Tensor | None
    streams: Mapping[int, Stream]


def of(values: Tensor, c: int) -> Tensor:
    """Return a knob's values for one channel."""
    return values[:, c if values.shape[1] > 1 else 0]


def row_index(row: int, like: Tensor) -> Tensor:
    """Return the numbers of a row's random words: as many as there are taxels."""
    return torch.arange(like.shape[-1], dtype=torch.int32, device=like.device) + row * like.shape[-1]


def uniform(now: Now, purpose: int, row: int, like: Tensor) -> Tensor:
    """Return a uniform number between 0 and 1 for each taxel of `like`: those of a row of a purpose."""
    return random.uniform(random.words(now.streams[purpose], row_index(row, like)), like.dtype)

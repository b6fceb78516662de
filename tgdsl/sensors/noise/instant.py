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
        is_sample: Whether each environment's sensor takes a sample now, (env, 1); None: always.
        streams: The sensor's random numbers, by purpose.
    """

    dt: Tensor | None
    step: Tensor
    age: Tensor
    is_sample: Tensor | None
    streams: Mapping[int, Stream]


def of(values: Tensor, c: int) -> Tensor:
    """Return a knob's values for one channel."""
    return values[:, c if values.shape[1] > 1 else 0]


def row_index(row: int, like: Tensor | int) -> Tensor:
    """Return the numbers of a row's random words: as many as there are taxels."""
    count = like if isinstance(like, int) else like.shape[-1]
    device = None if isinstance(like, int) else like.device
    return torch.arange(count, dtype=torch.int32, device=device) + row * count


def uniform(now: Now, purpose: int, row: int, like: Tensor) -> Tensor:
    """Return a uniform number between 0 and 1 for each taxel of `like`: those of a row of a purpose."""
    return random.uniform(random.words(now.streams[purpose], row_index(row, like)), like.dtype)

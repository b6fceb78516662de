"""When a reading is made, and with which random numbers.

Shapes: `env` environments, `channel` numbers of a signal, `row` its rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.sensors.noise import random
from tgdsl.sensors.noise.random import Stream

Signal = Float[Tensor, "env channel row"]
"""What noise is done to."""


class Now(NamedTuple):
    """When a reading is made.

    Attributes:
        dt: Time since the last call [s].
        step: Number of this call of each environment, (env, 1).
        age: Calls since each environment's reset, (env, 1); 0 at the first one.
        ages: Time since each of the calls before this one, the last one first (env, call) [s]; None if no sensor wants to know.
        is_sample: Whether each environment's sensor takes a sample now, (env, 1); None: always.
        period: Time between samples [s], a scalar; None: one is taken at every call.
        streams: The sensor's random numbers, by purpose.
    """

    dt: Tensor | None
    step: Tensor
    age: Tensor
    ages: Tensor | None
    is_sample: Tensor | None
    period: Tensor | None
    streams: Mapping[int, Stream]


def uniform(now: Now, purpose: int, row: int, like: Tensor) -> Tensor:
    """Return a uniform number between 0 and 1 for each of the last axis of `like`: those of a row of a purpose, (env, …)."""
    count = like.shape[-1]
    index = torch.arange(count, dtype=torch.int32, device=like.device) + row * count
    return random.uniform(random.words(now.streams[purpose], index), like.dtype)

"""Reading some of many environments: of all that is computed their rows count; few on a CPU are a batch of their own.

Shapes: `env` environments, `n` those that are read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from tgdsl.module.memory.clock import ENV, SHARED
from tgdsl.module.memory.history import reduced
from tgdsl.module.memory.memory import KEPT, WINDOW, chosen_only
from tgdsl.tensors.env_ids import broadcast_over, few_ids

Tensors = dict[str, Tensor]


def chosen_rows(
    mask: Bool[Tensor, " env"], readings: Tensors, updated: Tensors, memory: Mapping[str, Tensor]
) -> tuple[Tensors, Tensors]:
    """Return readings and new state of the environments of a mask; of the others what they had, as it was handed out before."""
    updated, result = chosen_only(memory, updated, mask), dict(readings)
    for name, reading in readings.items():
        if f"{KEPT}{name}" in memory:
            result[name] = torch.where(
                broadcast_over(mask, reading), reading.transpose(-2, -1), memory[f"{KEPT}{name}"]
            ).transpose(-2, -1)
        elif f"{WINDOW}{name}" in memory:
            result[name] = reduced(updated[f"{WINDOW}{name}"], "stack")
    return result, updated


def few_rows(mask: Bool[Tensor, " env"]) -> Int[Tensor, " n"] | None:
    """Return the environments of a mask, if they are on a CPU and few enough to be read as a batch of their own.

    One alone is read twice: compiled code that serves every batch from two on is then not made again for it.
    """
    rows = None if torch.is_grad_enabled() else few_ids(mask)
    if rows is None or not len(rows):
        return None
    return rows if len(rows) > 1 else rows.repeat(2)


def rows_of(tensors: Mapping[str, Tensor], rows: Int[Tensor, " n"]) -> Tensors:
    """Return some environments' rows of a state's fields."""
    return {name: value[rows] if value.ndim else value for name, value in tensors.items() if name != "mask"}


def read_rows(
    core: Callable[[Tensors, Tensors], Tensors],
    rows: Int[Tensor, " n"],
    tensors: Mapping[str, Tensor],
    memory: Mapping[str, Tensor],
) -> Tensors:
    """Read some environments, put their new state in the place of the old one, and return the readings of all.

    `core` returns readings as `reading/<name>`, and new state as `state/<name>`.
    """
    held = {name: value if name in SHARED else value[rows] for name, value in memory.items()}
    outputs = core(dict(tensors), held | {ENV: rows})
    for path, value in outputs.items():
        part, _, name = path.partition("/")
        if part == "state" and value.ndim < memory[name].ndim:
            memory[name].index_put_((rows, held["clock/step"] % memory[name].shape[1]), value)
        elif part == "state":
            memory[name][rows] = value
    readings: Tensors = {}
    for path, value in outputs.items():
        part, _, name = path.partition("/")
        if part != "reading":
            continue
        if f"{KEPT}{name}" in memory:
            memory[f"{KEPT}{name}"][rows] = value.transpose(-2, -1)
            readings[name] = memory[f"{KEPT}{name}"].clone().transpose(-2, -1)
        else:
            readings[name] = reduced(memory[f"{WINDOW}{name}"].clone(), "stack")
    return readings

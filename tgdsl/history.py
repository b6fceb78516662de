"""What a sensor read at its last calls: one ring per reading, written once per call, and read without a copy.

The ring holds every reading twice, so that the last ones always stand together in order: `stack` is a view of them.

Shapes: `env` environments, `step` calls, oldest first, `row` taxels or bodies, `channel` numbers per row.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from tgdsl.plan import PlannedHistory


class History(nn.Module):
    """The last readings of one kind, for all environments.

    Buffers: `ring` (env, 2 length, channel, row), and `is_new` (env,), which have no reading since their reset. The extra state
    is where in the ring's first half the next reading goes.

    Attributes:
        home: Has the device of readings that are loaded before the first call.
    """

    def __init__(self, planned: PlannedHistory):
        """Make an empty history."""
        super().__init__()
        self._length, self._reduce, self._place = planned.length, planned.reduce, 0
        self._any_new = True
        self.home = torch.empty(0)

    def push(self, reading: Float[Tensor, "env row channel"]) -> Tensor:
        """Note a reading, and return what is read of the last ones.

        Returns:
            `stack`: (env, step, row, channel), a view that the next call changes; else (env, row, channel).
        """
        if self._reduce == "last":
            return reading
        by_channel = reading.detach().transpose(1, 2)
        ring = self._ring_for(by_channel)
        with torch.no_grad():
            ring[:, self._place] = by_channel
            ring[:, self._place + self._length] = by_channel
            if self._any_new:  # before there are enough, the first one stands for the missing
                is_new = self._buffers["is_new"]
                assert is_new is not None
                ring.copy_(torch.where(is_new[:, None, None, None], by_channel[:, None], ring))
                is_new.zero_()
                self._any_new = False
        self._place = (self._place + 1) % self._length
        last = ring[:, self._place : self._place + self._length]
        if self._reduce == "stack":
            return last.transpose(2, 3)
        reduced = last.mean(dim=1) if self._reduce == "mean" else _median(last)
        return reduced.transpose(1, 2)

    def reset(self, chosen: Tensor) -> None:
        """Forget what the environments of a mask read."""
        if "is_new" in self._buffers:
            self._buffers["is_new"] |= chosen  # type: ignore[operator]
            self._any_new = True

    def _ring_for(self, reading: Float[Tensor, "env channel row"]) -> Tensor:
        if "ring" not in self._buffers:
            with torch.inference_mode(False):
                shape = (len(reading), 2 * self._length, *reading.shape[1:])
                self.register_buffer("ring", torch.zeros(shape, dtype=reading.dtype, device=reading.device))
                self.register_buffer("is_new", torch.ones(len(reading), dtype=torch.bool, device=reading.device))
        return self._buffers["ring"]  # type: ignore[return-value]

    def get_extra_state(self) -> Tensor:
        """Return where the next reading goes."""
        return torch.tensor(self._place)

    def set_extra_state(self, state: Tensor) -> None:
        """Go on where another history stopped."""
        self._place, self._any_new = int(state), True

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Make room for the readings that are loaded."""
        for name in ("ring", "is_new"):
            value = state_dict.get(prefix + name)
            if isinstance(value, Tensor):
                self.register_buffer(name, torch.zeros_like(value, device=self.home.device))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def last_step(reading: Float[Tensor, "env *step row channel"]) -> Float[Tensor, "env row channel"]:
    """Return the last one of stacked calls, or a reading that is of one call."""
    return reading[:, -1] if reading.ndim == 4 else reading


def _median(readings: Float[Tensor, "env step channel row"]) -> Float[Tensor, "env channel row"]:
    """Return the middle of each number's readings, the mean of both middle ones if their count is even."""
    ordered, count = readings.sort(dim=1).values, readings.shape[1]
    return 0.5 * (ordered[:, (count - 1) // 2] + ordered[:, count // 2])

"""Warns of what kinds see in what their sensors remember, without making the host wait for a GPU.

Shapes: `env` environments.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from tgdsl.plan.sensors import PlannedSensor
from tgdsl.sensors.base import Kind

EVERY = 16
"""On a GPU one call in so many is looked at: a small kernel takes as long to launch as a module's own."""


class StateWatch:
    """Looks at state that kinds warn of, see `Kind.warns`: what the calls before have left. Each message comes once."""

    def __init__(self, sensors: Sequence[PlannedSensor], kinds: Mapping[str, Kind]):
        """Note what is to be looked at."""
        rows = {own.name: [f"{own.sensor}[{i}]" for i in range(own.readings[0].num_rows)] for own in sensors}
        self._watched = [
            (f"{own.name}:{state}", own, tuple(row for name in own.upstream for row in rows[name]), warn)
            for own in sensors
            for state, warn in (kinds[own.name].warns if own.name in kinds else ())
        ]
        self._said: set[str] = set()
        self._num_calls = 0
        self._copies: dict[str, tuple[Tensor, torch.cuda.Event]] = {}

    def look(self, memory: Mapping[str, Tensor]) -> None:
        """Look at what is remembered, and warn of what is new. What a GPU holds may be seen some calls later."""
        if not self._watched or torch.compiler.is_compiling():
            return
        self._num_calls += 1
        for path, sensor, rows, warn in self._watched:
            found = self._shown(path, memory[path])
            for message in () if found is None else warn(sensor.sensor, sensor.constants, rows, found):
                if message not in self._said:
                    self._said.add(message)
                    warnings.warn(message, stacklevel=6)

    def _shown(self, path: str, state: Tensor) -> np.ndarray | None:
        """Return the largest numbers of all environments, on the host; None if they are not there yet."""
        if state.device.type != "cuda":
            return state.detach().amax(dim=0).numpy()
        if torch.cuda.is_current_stream_capturing():
            return None
        before = self._copies.get(path)
        if before is not None and before[1].query():
            del self._copies[path]
            return before[0].numpy()
        if before is None and self._num_calls % EVERY == 1:
            with torch.inference_mode(False), torch.no_grad():
                largest = state.amax(dim=0)
                copy = torch.empty(largest.shape, dtype=largest.dtype, pin_memory=True)
                copy.copy_(largest, non_blocking=True)
            event = torch.cuda.Event()
            event.record(torch.cuda.current_stream(state.device))
            self._copies[path] = copy, event
        return None

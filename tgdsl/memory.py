"""What a module carries from one call to the next: buffers of each sensor, and its clock.

Shapes: `env` environments, `call` calls that a ring remembers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from tgdsl.clock import Clock
from tgdsl.errors import StateError
from tgdsl.fusion import stored
from tgdsl.plan import PlannedMemory, PlannedSensor


class Memory(nn.Module):
    """Buffers `sensor:name`, (env, …) or (env, call, …); none before the first call, nor if no sensor carries anything.

    Attributes:
        home: Has the device of state that is loaded before the first call.
    """

    def __init__(self, sensors: Sequence[PlannedSensor]):
        """Note what sensors carry."""
        super().__init__()
        self._planned = {f"{s.name}:{name}": (s, name, part) for s in sensors for name, part in s.state.items()}
        self._rings = {path: found for path, found in self._planned.items() if found[2].past > 0}
        self.clock = Clock(sensors)
        self.home = torch.empty(0)

    @property
    def is_wanted(self) -> bool:
        """Whether any sensor carries something."""
        return bool(self._planned) or self.clock.is_wanted

    @property
    def num_envs(self) -> int | None:
        """Number of environments whose state is held; None before the first call."""
        return next((len(buffer) for buffer in self._buffers.values() if buffer is not None), self.clock.num_envs)

    def tensors(self, num_envs: int, dt: float | None, dtype: torch.dtype, device: torch.device) -> dict[str, Tensor]:
        """Return all buffers by name; at the first call they are allocated, as ordinary tensors even under `inference_mode`.

        Args:
            num_envs: Number of environments: of those whose state is held, if there are any.
            dt: Time since the last call [s], if some sensor wants to know it.
            dtype: Dtype of what is remembered.
            device: Where.

        Raises:
            StateError: If dt is so short that a ring is too short.
        """
        if not self.is_wanted:
            return {}
        if self.num_envs is None:
            with torch.inference_mode(False):
                for path, (_, _, planned) in self._planned.items():
                    shape = (num_envs, *_calls(planned, dt), *planned.shape)
                    self.register_buffer(path, torch.full(shape, planned.rest, dtype=dtype, device=device))
                if self.clock.is_wanted:
                    calls = max((_calls(part, dt)[0] for _, _, part in self._rings.values()), default=0)
                    self.clock.start(num_envs, calls, torch.empty(0, dtype=dtype, device=device))
        held: dict[str, Tensor] = {name: buffer for name, buffer in self._buffers.items() if buffer is not None}
        for path, (sensor, _, planned) in self._rings.items():
            if _calls(planned, dt)[0] > held[path].shape[1]:
                what = f'SceneState.dt is {dt:g} s, shorter than at first: the ring of "{sensor.sensor}" does not hold'
                raise StateError(f"{what} {planned.past:g} s of so many calls; begin with the shortest dt")
        return held | self.clock.tensors()

    def reset(self, chosen: Tensor) -> None:
        """Begin a new episode in the environments of a mask; what noise remembers starts anew by its age."""
        for path, (_, name, planned) in self._planned.items():
            if path in self._buffers and "/" not in name:
                buffer = self._buffers[path]
                assert buffer is not None
                buffer.masked_fill_(chosen.view(-1, *[1] * (buffer.ndim - 1)), planned.rest)
        self.clock.reset(chosen)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Make room for the state that is loaded: before the first call there is none."""
        for path in self._planned:
            value = state_dict.get(prefix + path)
            if isinstance(value, Tensor):
                self.register_buffer(path, torch.zeros_like(value, device=self.home.device))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def store(memory: dict[str, Tensor], updated: dict[str, Tensor]) -> None:
    """Put new state in the place of the old one; of a ring, this call's entry."""
    with torch.no_grad():
        for name, value in updated.items():
            if value.ndim < memory[name].ndim:
                place = stored(memory["clock/step"] % memory[name].shape[1])[None]
                memory[name].index_copy_(1, place, value.detach()[:, None])
        for name, value in updated.items():
            if value.ndim == memory[name].ndim:
                memory[name].copy_(value.detach())


def _calls(planned: PlannedMemory, dt: float | None) -> tuple[int, ...]:
    """Return how many calls before the present one a ring holds; nothing if it is none."""
    if planned.past == 0 or dt is None:
        return ()
    return (max(math.ceil(planned.past / dt - 1e-6), 1),)

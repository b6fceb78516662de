"""When a reading is made, and with which random numbers: what a module counts where its sensors are imperfect or have rates.

Shapes: `env` environments.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Integral
from typing import Any

import torch
from torch import Tensor, nn

from tgdsl.errors import TgdslError
from tgdsl.plan import PlannedSensor
from tgdsl.sensors.noise.instant import Now
from tgdsl.sensors.noise.random import Stream, sensor_key, streams

_INT64 = 2**63
"""First number beyond an int64."""


class Clock(nn.Module):
    """Counts calls and episodes. It holds nothing until `start`, nor if no sensor asks for it.

    Buffers, all int64: `seed`, `first_env` (number of the first environment among those of all processes), `step` (calls so
    far), `episode` (resets of each environment, (env,)), `age` (calls since the last one, (env,)); and `ages` (call,), how long
    before the last call each one was [s], itself first.

    Attributes:
        home: Has device and dtype of counts that are loaded before the start.
    """

    def __init__(self, sensors: Sequence[PlannedSensor]):
        """Note which sensors want to know."""
        super().__init__()
        self._sensors = [sensor for sensor in sensors if sensor.is_timed]
        self._drawing = list(dict.fromkeys(own.sensor for own in self._sensors if own.noise is not None and own.noise.streams))
        self._seed, self._first_env = 0, None
        self.home = torch.empty(0)

    @property
    def is_wanted(self) -> bool:
        """Whether any sensor wants to know."""
        return len(self._sensors) > 0

    @property
    def num_envs(self) -> int | None:
        """Number of environments; None before the start."""
        return len(self._buffers["age"]) if "age" in self._buffers else None  # type: ignore[arg-type]

    def start(self, num_envs: int, calls: int, like: Tensor) -> None:
        """Begin to count.

        Args:
            num_envs: Number of environments.
            calls: How many calls before the present one some ring remembers.
            like: Has the module's device and dtype.
        """
        first = _rank() * num_envs if self._first_env is None else self._first_env
        for name, value in {"seed": self._seed, "first_env": first, "step": 0}.items():
            self.register_buffer(name, torch.tensor(value, dtype=torch.int64, device=like.device))
        for name in ("episode", "age"):
            self.register_buffer(name, torch.zeros(num_envs, dtype=torch.int64, device=like.device))
        if calls:
            self.register_buffer("ages", torch.zeros(calls, dtype=like.dtype, device=like.device))
        # No number of a plan is read in `nows`: compiled code would be made twice, as it may be another at the next call.
        periods = torch.tensor([sensor.period for sensor in self._sensors], dtype=like.dtype, device=like.device)
        self.register_buffer("periods", periods, persistent=False)
        self._set_keys()

    def seed_with(self, seed: int, first_env: int | None) -> None:
        """Choose other random numbers, from the next call on; environments are counted from `first_env`.

        Raises:
            TgdslError: If they are no integers, or `first_env` is negative or no int64.
        """
        if not isinstance(seed, Integral):
            raise TgdslError(f"seed is {seed!r}, expected an integer")
        if first_env is not None and not (isinstance(first_env, Integral) and 0 <= first_env < _INT64):
            raise TgdslError(f"first_env is {first_env!r}, expected an integer from 0 to 2**63 - 1")
        # It is kept as an int64: whoever loads a state dict draws the same numbers.
        self._seed, self._first_env = (int(seed) + _INT64) % (2 * _INT64) - _INT64, first_env
        if self.num_envs is not None:
            ages = self._buffers.get("ages")
            like = self._buffers["age"] if ages is None else ages
            assert like is not None
            self.start(self.num_envs, 0 if ages is None else len(ages), like)

    def reset(self, chosen: Tensor) -> None:
        """Begin a new episode in the environments of a mask."""
        if self.num_envs is not None:
            self._buffers["episode"] += chosen  # type: ignore[operator]
            self._buffers["age"].masked_fill_(chosen, 0)  # type: ignore[union-attr]

    def tensors(self) -> dict[str, Tensor]:
        """Return what `nows` and `after` want, by name."""
        return {f"clock/{name}": buffer for name, buffer in self._buffers.items() if buffer is not None}

    def nows(self, memory: Mapping[str, Tensor], dt: Tensor | None) -> dict[str, Now]:
        """Return when each sensor that wants to know is read, by its name.

        Args:
            memory: What `tensors` returned; and for each sensor with a rate of its own `<sensor>:sample/phase`, the time since
                its last sample was due, (env,) [s].
            dt: Time since the last call [s].
        """
        if not self.is_wanted:
            return {}
        step, age = memory["clock/step"], memory["clock/age"][:, None]
        ages = memory["clock/ages"] + dt if "clock/ages" in memory and dt is not None else None
        drawn: dict[str, Mapping[int, Stream]] = {}
        if self._drawing:
            env = torch.arange(len(age), device=age.device) + memory["clock/first_env"]
            found = streams(memory["clock/keys"], env, step, memory["clock/episode"])
            drawn = dict(zip(self._drawing, found, strict=True))
        nows = {}
        for i, sensor in enumerate(self._sensors):
            phase, is_due, period = memory.get(f"{sensor.name}:sample/phase"), None, None
            if phase is not None and dt is not None:
                period = memory["clock/periods"][i]
                is_due = (phase[:, None] + 1.5 * dt >= period) | (age == 0)
            nows[sensor.name] = Now(dt, step, age, ages, is_due, period, drawn.get(sensor.sensor, {}))
        return nows

    @staticmethod
    def after(clock: Mapping[str, Tensor], dt: Tensor | None) -> dict[str, Tensor]:
        """Return the counts after a call."""
        counts = {name: clock[name] + 1 for name in ("clock/step", "clock/age") if name in clock}
        if "clock/ages" in clock and dt is not None:
            ages = clock["clock/ages"]
            counts["clock/ages"] = torch.cat([torch.zeros_like(ages[:1]), ages[:-1] + dt])
        return counts

    def _set_keys(self) -> None:
        seed, device = int(self._buffers["seed"]), self._buffers["seed"].device  # type: ignore[arg-type, union-attr]
        if self._drawing:
            keys = [sensor_key(seed, sensor) for sensor in self._drawing]
            self.register_buffer("keys", torch.tensor(keys, dtype=torch.int32, device=device), persistent=False)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        """Make room for the counts that are loaded, and go on with their seed."""
        age = state_dict.get(f"{prefix}age")
        if self.is_wanted and isinstance(age, Tensor):
            ages = state_dict.get(f"{prefix}ages")
            self.start(len(age), len(ages) if isinstance(ages, Tensor) else 0, self.home)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
        if self.num_envs is not None:
            self._seed, self._first_env = int(self._buffers["seed"]), int(self._buffers["first_env"])  # type: ignore[arg-type]
            self._set_keys()


def _rank() -> int:
    """Return the number of this process among those of a distributed run; 0 if there is none."""
    distributed = torch.distributed
    return distributed.get_rank() if distributed.is_available() and distributed.is_initialized() else 0

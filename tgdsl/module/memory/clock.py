"""The time of a reading and its random numbers: what a module counts where its sensors are imperfect or have rates.

Shapes: `env` environments.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from numbers import Integral
from typing import Any

import torch
from torch import Tensor

from tgdsl.errors import TgdslError
from tgdsl.plan.sensors import PlannedSensor
from tgdsl.sensors.base import UNTIMED, Context
from tgdsl.sensors.noise.random import Stream, kind_stream, sensor_key, streams
from tgdsl.sensors.noise.stage import Now
from tgdsl.tensors.torch_internals import HookedModule, held_buffers

ENV = "clock/env"
"""Numbers of the environments that are read, counted from this module's first; only given where these are some of them."""
SHARED = ("clock/seed", "clock/first_env", "clock/periods", "clock/keys")  # what all environments have in common
_INT64 = 2**63  # first number beyond an int64


class Clock(HookedModule):
    """Counts calls and episodes, of each environment alone. It holds nothing until `start`, nor if no sensor asks for it.

    Buffers, all int64: `seed`, `first_env` (number of the first environment among those of all processes); per environment,
    (env,): `step` (calls so far), `episode` (resets), `age` (calls since the last reset); and of the module's dtype `ages`
    (env, call), how long before the last call each one was [s], itself first, and `time` (env,), of the last call since the
    reset [s].

    Attributes:
        home: Has device and dtype of counts that are loaded before the start.
    """

    def __init__(self, sensors: Sequence[PlannedSensor]):
        """Note which sensors want to know."""
        super().__init__()
        self._sensors = [sensor for sensor in sensors if sensor.wants_clock]
        self._has_history = any(sensor.windows for sensor in sensors)
        noisy = dict.fromkeys(sensor.sensor for sensor in self._sensors if sensor.noise is not None and sensor.noise.streams)
        self._drawing = list(noisy)
        self._keyed = list(noisy | dict.fromkeys(sensor.sensor for sensor in self._sensors if sensor.is_random))
        self._seed, self._first_env = 0, None
        self.home = torch.empty(0)

    @property
    def is_wanted(self) -> bool:
        """Whether any sensor wants to know."""
        return len(self._sensors) > 0 or self._has_history

    @property
    def num_envs(self) -> int | None:
        """Number of environments; None before the start."""
        return len(self.get_buffer("age")) if hasattr(self, "age") else None

    @property
    def _num_calls(self) -> int:
        return self.get_buffer("ages").shape[-1] if hasattr(self, "ages") else 0

    def start(self, num_envs: int, calls: int, like: Tensor) -> None:
        """Begin to count; some ring remembers so many calls before the present one. `like`: the module's device and dtype."""
        whole = {"device": like.device, "dtype": torch.int64}
        for name in ("seed", "first_env"):
            self.register_buffer(name, torch.zeros((), **whole))
        for name in ("step", "episode", "age"):
            self.register_buffer(name, torch.zeros(num_envs, **whole))
        if any(sensor.is_timed for sensor in self._sensors):
            self.register_buffer("time", torch.zeros(num_envs, dtype=like.dtype, device=like.device))
        if calls:
            self.register_buffer("ages", torch.zeros(num_envs, calls, dtype=like.dtype, device=like.device))
        # No number of a plan is read in `nows`: compiled code would be made twice, as it may be another at the next call.
        periods = torch.tensor([sensor.period for sensor in self._sensors], dtype=like.dtype, device=like.device)
        self.register_buffer("periods", periods, persistent=False)
        if self._keyed:
            keys = torch.zeros(len(self._keyed), 2, dtype=torch.int32, device=like.device)
            self.register_buffer("keys", keys, persistent=False)
        self._count_anew()

    def free(self) -> None:
        """Hold nothing again; the seed is kept."""
        for name in [name for name, _ in self.named_buffers(recurse=False)]:
            delattr(self, name)

    def seed_with(self, seed: int, first_env: int | None) -> None:
        """Choose other random numbers, from the next call on; environments are counted from `first_env`.

        Raises:
            TgdslError: If they are no integers, or `first_env` is negative or no int64.
        """
        if not isinstance(seed, Integral):
            raise TgdslError(f"seed is {seed!r}, expected an integer")
        if first_env is not None and not (isinstance(first_env, Integral) and 0 <= first_env < _INT64):
            raise TgdslError(f"first_env is {first_env!r}, expected an integer from 0 to 2**63 - 1")
        # An int64 in the state dict: whoever loads it draws the same numbers.
        self._seed, self._first_env = (int(seed) + _INT64) % (2 * _INT64) - _INT64, first_env
        if self.num_envs is not None:
            self._count_anew()

    def copy_seed(self, other: Clock) -> None:
        """Draw the random numbers that another clock draws after `seed`."""
        self._seed, self._first_env = other._seed, other._first_env

    def reset(self, chosen: Tensor) -> None:
        """Begin a new episode in the environments of a mask."""
        if self.num_envs is not None:
            self.get_buffer("episode").add_(chosen)
            self.get_buffer("age").masked_fill_(chosen, 0)

    @staticmethod
    def restarted(memory: Mapping[str, Tensor], chosen: Tensor) -> dict[str, Tensor]:
        """Return the counts that `reset` changes, of memory that is not this clock's own."""
        if "clock/age" not in memory:
            return {}
        return {"clock/episode": memory["clock/episode"] + chosen, "clock/age": memory["clock/age"].masked_fill(chosen, 0)}

    def tensors(self) -> dict[str, Tensor]:
        """Return what `nows` and `after` want, by name."""
        return {f"clock/{name}": buffer for name, buffer in held_buffers(self).items()}

    def nows(self, memory: Mapping[str, Tensor], dt: Tensor | None) -> dict[str, Now]:
        """Return when each sensor that wants to know is read, by its name.

        Args:
            memory: What `tensors` returned; and for each sensor with a rate of its own `<sensor>:sample/phase`, the time since
                its last sample was due, (env,) [s].
            dt: Time since the last call [s].
        """
        if not self.is_wanted:
            return {}
        step, age = memory["clock/step"][:, None], memory["clock/age"][:, None]
        ages = memory["clock/ages"] + dt if "clock/ages" in memory and dt is not None else None
        drawn: dict[str, Mapping[int, Stream]] = {}
        if self._drawing:
            streams_now = streams(memory["clock/keys"][: len(self._drawing)], _env(memory), step[:, 0], memory["clock/episode"])
            drawn = dict(zip(self._drawing, streams_now, strict=True))
        nows = {}
        for i, sensor in enumerate(self._sensors):
            phase, is_due, period = memory.get(f"{sensor.name}:sample/phase"), None, None
            if phase is not None and dt is not None:
                period = memory["clock/periods"][i]
                is_due = (phase[:, None] + 1.5 * dt >= period) | (age == 0)
            nows[sensor.name] = Now(dt, step, age, ages, is_due, period, drawn.get(sensor.sensor, {}))
        return nows

    def context(self, sensor: PlannedSensor, memory: Mapping[str, Tensor], dt: Tensor | None, substep: int = 0) -> Context:
        """Return when a sensor's kind is called at one of its substeps; nothing of it if the kind does not want to know."""
        if not sensor.is_timed:
            return UNTIMED
        assert dt is not None
        count = max(sensor.substeps, 1)
        age, step_dt = memory["clock/age"][:, None], dt / count if count > 1 else dt
        time = torch.where(age == 0, 0.0, memory["clock/time"][:, None] + (substep + 1) * step_dt)
        is_first = (age == 0) & (substep == 0)
        stream = None
        if sensor.is_random:
            key = memory["clock/keys"][self._keyed.index(sensor.sensor)]
            stream = kind_stream(key, _env(memory), memory["clock/step"] * count + substep)
        return Context(step_dt, memory["clock/step"][:, None], substep, time, is_first, stream)

    @staticmethod
    def after(clock: Mapping[str, Tensor], dt: Tensor | None) -> dict[str, Tensor]:
        """Return the counts after a call."""
        counts = {name: clock[name] + 1 for name in ("clock/step", "clock/age") if name in clock}
        if "clock/time" in clock and dt is not None:
            counts["clock/time"] = torch.where(clock["clock/age"] == 0, 0.0, clock["clock/time"] + dt)
        if "clock/ages" in clock and dt is not None:
            ages = clock["clock/ages"]
            counts["clock/ages"] = torch.cat([torch.zeros_like(ages[:, :1]), ages[:, :-1] + dt], dim=1)
        return counts

    def _count_anew(self) -> None:
        """Write the seed and what follows from it, and start all counts from 0, in place: captured graphs go on with them."""
        assert self.num_envs is not None
        first = _rank() * self.num_envs if self._first_env is None else self._first_env
        with torch.no_grad():
            self.get_buffer("seed").fill_(self._seed)
            self.get_buffer("first_env").fill_(first)
            for name in ("step", "episode", "age"):
                self.get_buffer(name).zero_()
        self._set_keys()

    def _set_keys(self) -> None:
        if self._keyed:
            keys = [sensor_key(int(self.get_buffer("seed")), sensor) for sensor in self._keyed]
            self.get_buffer("keys").copy_(torch.tensor(keys, dtype=torch.int32))

    def on_load(self, state_dict: dict[str, Any], prefix: str, errors: list[str], load: Callable[[], object]) -> None:
        """Make room for the counts that are loaded, and go on with their seed; do nothing if `Memory` has found errors."""
        if errors:
            return
        age = state_dict.get(f"{prefix}age")
        if self.is_wanted and isinstance(age, Tensor):
            ages = state_dict.get(f"{prefix}ages")
            calls = ages.shape[-1] if isinstance(ages, Tensor) else 0
            if (len(age), calls) != (self.num_envs, self._num_calls):  # else captured graphs go on with what is there
                with torch.inference_mode(False):
                    self.start(len(age), calls, self.home)
        load()
        if self.num_envs is not None:
            self._seed, self._first_env = int(self.get_buffer("seed")), int(self.get_buffer("first_env"))
            self._set_keys()


def _env(memory: Mapping[str, Tensor]) -> Tensor:
    age = memory["clock/age"]
    return (memory[ENV] if ENV in memory else torch.arange(age.shape[0], device=age.device)) + memory["clock/first_env"]


def _rank() -> int:
    distributed = torch.distributed
    return distributed.get_rank() if distributed.is_available() and distributed.is_initialized() else 0

"""A module's state between calls: buffers of each sensor, windows over the last readings, and the clock.

Shapes: `env` environments, `call` calls in a ring, `step` calls in a window, oldest first, `row` taxels or bodies,
`channel` numbers per row.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from numbers import Integral
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.errors import StateError, TgdslError, listed
from tgdsl.plan.sensors import PlannedMemory, PlannedReading, PlannedSensor
from tgdsl.sensors.base import UNTIMED, Context, Kind
from tgdsl.sensors.noise.random import Stream, kind_stream, sensor_key, streams
from tgdsl.sensors.noise.stage import Now
from tgdsl.tensors.env_ids import broadcast_over
from tgdsl.tensors.fusion import materialised
from tgdsl.tensors.on_host import HostCopy
from tgdsl.tensors.torch_internals import HookedModule, held_buffers, num_writes

Tensors = dict[str, Tensor]
Window = Float[Tensor, "env step channel row"]
COUNTS = ("step", "episode", "reset_step")  # buffers `clock/<name>` of each environment
WINDOW, KEPT = "history/", "kept/"  # buffers `history/<reading>`, a window; `kept/<reading>`, the last reading
SHARED = ("clock/seed", "clock/first_env", "clock/periods", "clock/keys")  # buffers that all environments share
EVERY = 16  # on a GPU one call in so many is checked: a small kernel takes as long to launch as a module's
_INT64 = 2**63


class Clock(HookedModule):
    """Counts calls and episodes of each environment. It has no buffers before `start`, or if no sensor needs it.

    Buffers, all int64: `seed`, `first_env` (number of the first environment, counted over all processes); per environment,
    (env,): `step` (calls so far), `episode` (resets), `reset_step` (`step` at the last reset). In the module's dtype: `ages`
    (env, call), time from each call to the last one [s], the last call first; `time` (env,), from the reset to the last call
    [s].
    """

    def __init__(self, sensors: Sequence[PlannedSensor]):
        super().__init__()
        self._sensors = [sensor for sensor in sensors if sensor.wants_clock]
        self._has_history = any(sensor.windows for sensor in sensors)
        noisy = dict.fromkeys(sensor.sensor for sensor in self._sensors if sensor.noise is not None and sensor.noise.streams)
        self._drawing = list(noisy)
        self._keyed = list(noisy | dict.fromkeys(sensor.sensor for sensor in self._sensors if sensor.is_random))
        self._seed, self._first_env = 0, None
        self.home = torch.empty(0)  # has device and dtype of counts that are loaded before the start

    @property
    def is_wanted(self) -> bool:
        """Whether any sensor reads it."""
        return len(self._sensors) > 0 or self._has_history

    @property
    def num_envs(self) -> int | None:
        """Number of environments; None before the start."""
        return len(self.get_buffer("step")) if hasattr(self, "step") else None

    def start(self, num_envs: int, calls: int, like: Tensor) -> None:
        """Begin to count. `calls`: length of the longest ring [calls]; `like`: the module's device and dtype."""
        whole = {"device": like.device, "dtype": torch.int64}
        for name in ("seed", "first_env"):
            self.register_buffer(name, torch.zeros((), **whole))
        for name in COUNTS:
            self.register_buffer(name, torch.zeros(num_envs, **whole))
        if any(sensor.is_timed for sensor in self._sensors):
            self.register_buffer("time", like.new_zeros(num_envs))
        if calls:
            self.register_buffer("ages", like.new_zeros(num_envs, calls))
        # `nows` reads no number from the plan: the graph would be recompiled when the number changes.
        self.register_buffer("periods", like.new_tensor([sensor.period for sensor in self._sensors]), persistent=False)
        if self._keyed:
            self.register_buffer("keys", like.new_zeros(len(self._keyed), 2, dtype=torch.int32), persistent=False)
        self._restart()

    def free(self) -> None:
        """Free all buffers; the seed stays."""
        _drop(self, "")

    def seed_with(self, seed: int, first_env: int | None) -> None:
        """Choose other random numbers, from the next call on; environments are counted from `first_env`."""
        if not isinstance(seed, Integral):
            raise TgdslError(f"seed is {seed!r}, expected an integer")
        if first_env is not None and not (isinstance(first_env, Integral) and 0 <= first_env < _INT64):
            raise TgdslError(f"first_env is {first_env!r}, expected an integer from 0 to 2**63 - 1")
        # An int64 in the state dict: whoever loads it draws the same numbers.
        self._seed, self._first_env = (int(seed) + _INT64) % (2 * _INT64) - _INT64, first_env
        if self.num_envs is not None:
            self._restart()

    def copy_seed(self, other: Clock) -> None:
        """Draw the random numbers that another clock draws after `seed`."""
        self._seed, self._first_env = other._seed, other._first_env

    def reset(self, chosen: Tensor) -> None:
        """Begin a new episode in the environments of a mask."""
        if self.num_envs is not None:
            self.get_buffer("episode").add_(chosen)
            self.get_buffer("reset_step").copy_(torch.where(chosen, self.get_buffer("step"), self.get_buffer("reset_step")))

    def tensors(self) -> Tensors:
        """Return the buffers as `clock/<name>`."""
        return {f"clock/{name}": buffer for name, buffer in held_buffers(self).items()}

    def nows(self, memory: Mapping[str, Tensor], dt: Tensor | None) -> dict[str, Now]:
        """Return the time of the call for each sensor that reads the clock, by name; `dt`: time since the last call [s].

        `memory` has the clock's tensors, and for each sensor with a rate `<sensor>:sample/phase` (env,), the time since its
        last sample was due [s].
        """
        if not self.is_wanted:
            return {}
        step, age = memory["clock/step"][:, None], age_of(memory)[:, None]
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
        """Return the time of a call of a sensor's kind at one of its substeps; untimed if the kind does not read it."""
        if not sensor.is_timed:
            return UNTIMED
        assert dt is not None
        count = max(sensor.substeps, 1)
        age, step_dt = age_of(memory)[:, None], dt / count if count > 1 else dt
        time = torch.where(age == 0, 0.0, memory["clock/time"][:, None] + (substep + 1) * step_dt)
        is_first = (age == 0) & (substep == 0)
        stream = None
        if sensor.is_random:
            key = memory["clock/keys"][self._keyed.index(sensor.sensor)]
            stream = kind_stream(key, _env(memory), memory["clock/step"] * count + substep)
        return Context(step_dt, memory["clock/step"][:, None], substep, time, is_first, stream)

    @staticmethod
    def after(clock: Mapping[str, Tensor], dt: Tensor | None) -> Tensors:
        """Return the counts after a call."""
        counts = {"clock/step": clock["clock/step"] + 1} if "clock/step" in clock else {}
        if "clock/time" in clock and dt is not None:
            counts["clock/time"] = torch.where(age_of(clock) == 0, 0.0, clock["clock/time"] + dt)
        if "clock/ages" in clock and dt is not None:
            ages = clock["clock/ages"]
            counts["clock/ages"] = torch.cat([torch.zeros_like(ages[:, :1]), ages[:, :-1] + dt], dim=1)
        return counts

    def _restart(self) -> None:
        """Write the seed and its keys, and reset all counts to 0, in place: captured graphs refer to these buffers."""
        assert self.num_envs is not None
        distributed = torch.distributed
        rank = distributed.get_rank() if distributed.is_available() and distributed.is_initialized() else 0
        with torch.no_grad():
            self.get_buffer("seed").fill_(self._seed)
            self.get_buffer("first_env").fill_(rank * self.num_envs if self._first_env is None else self._first_env)
            for name in COUNTS:
                self.get_buffer(name).zero_()
        self._set_keys()

    def _set_keys(self) -> None:
        if self._keyed:
            keys = [sensor_key(int(self.get_buffer("seed")), sensor) for sensor in self._keyed]
            self.get_buffer("keys").copy_(torch.tensor(keys, dtype=torch.int32))

    def on_load(self, state_dict: dict[str, Any], prefix: str, errors: list[str], load: Callable[[], object]) -> None:
        """Allocate buffers for the loaded counts, and continue with their seed; do nothing if `Memory` reports errors."""
        if errors:
            return
        step, ages = state_dict.get(f"{prefix}step"), state_dict.get(f"{prefix}ages")
        if self.is_wanted and isinstance(step, Tensor):
            calls = ages.shape[-1] if isinstance(ages, Tensor) else 0
            held = self.get_buffer("ages").shape[-1] if hasattr(self, "ages") else 0
            if (len(step), calls) != (self.num_envs, held):  # else captured graphs keep using the buffers
                with torch.inference_mode(False):
                    self.start(len(step), calls, self.home)
        load()
        if self.num_envs is not None:
            self._seed, self._first_env = int(self.get_buffer("seed")), int(self.get_buffer("first_env"))
            self._set_keys()


def _env(memory: Mapping[str, Tensor]) -> Tensor:
    """Return the numbers of the environments that are read, (env,), counted over all processes."""
    step = memory["clock/step"]
    return torch.arange(step.shape[0], device=step.device) + memory["clock/first_env"]


def age_of(memory: Mapping[str, Tensor]) -> Tensor:
    """Return the number of calls since each environment's reset, (env,); 0 at the first one."""
    return memory["clock/step"] - memory["clock/reset_step"]


def _drop(module: HookedModule, prefix: str) -> None:
    for name in [name for name in held_buffers(module) if name.startswith(prefix)]:
        delattr(module, name)


class StateWatch:
    """Emits the warnings of kinds about their state, each once, see `Kind.warns`; it checks the previous calls' state."""

    def __init__(self, sensors: Sequence[PlannedSensor], kinds: Mapping[str, Kind]):
        rows = {sensor.name: [f"{sensor.sensor}[{i}]" for i in range(sensor.readings[0].num_rows)] for sensor in sensors}
        self._watched = [
            (f"{sensor.name}:{state}", sensor, tuple(row for name in sensor.upstream for row in rows[name]), warn, HostCopy())
            for sensor in sensors
            for state, warn in (kinds[sensor.name].warns if sensor.name in kinds else ())
        ]
        self._said: set[str] = set()
        self._num_calls = 0

    def look(self, memory: Mapping[str, Tensor]) -> None:
        """Emit new warnings. State on a GPU may be checked some calls later."""
        if not self._watched or torch.compiler.is_compiling():
            return
        self._num_calls += 1
        for path, sensor, rows, warn, copy in self._watched:
            if memory[path].is_cuda and self._num_calls % EVERY != 1:
                continue
            largest = copy.poll(memory[path].detach().amax(dim=0))
            for message in () if largest is None else warn(sensor.sensor, sensor.constants, rows, largest.numpy()):
                if message not in self._said:
                    self._said.add(message)
                    warnings.warn(message, stacklevel=6)


class Memory(HookedModule):
    """Buffers `sensor:name`, (env, …) or (env, call, …), and `history/<reading>`; none before the first call."""

    def __init__(
        self,
        sensors: Sequence[PlannedSensor],
        readings: Mapping[str, PlannedReading],
        kinds: Mapping[str, Kind] | None = None,
    ):
        """Plan the buffers; `kinds` by sensor, where their warnings are wanted."""
        super().__init__()
        self._watch = StateWatch(sensors, kinds or {})
        self.planned = {f"{s.name}:{name}": part for s in sensors for name, part in s.state.items()}
        windows = [(s.history, reading) for s in sensors if s.history is not None for reading in s.windows]
        for history, reading in windows:
            shape = (history.length, len(reading.channels), reading.num_rows)
            self.planned[f"{WINDOW}{reading.name}"] = PlannedMemory(0.0, shape)
        self._restarted = {f"{s.name}:{n}": part.rest for s in sensors for n, part in s.state.items() if "/" not in n}
        self._rings = {f"{s.name}:{n}": (s.sensor, part) for s in sensors for n, part in s.state.items() if part.past > 0}
        stacks = {reading.name for _, reading in windows if reading.steps}  # their windows hold them already
        shapes = {name: reading.shape for name, reading in readings.items() if name not in stacks}
        self._kept = {name: (*shape[:-2], shape[-1], shape[-2]) for name, shape in shapes.items()}
        self._views = [reading.name for history, reading in windows if history.view]
        self._last: dict[str, tuple[Tensor, int]] = {}
        self._is_filled = False  # whether the stored readings have been returned
        # Whether the last readings are stored from the first call on, not only once a masked call needs them: code compiled for
        # the first call then serves all later calls.
        self.keeps_last = False
        self.clock = Clock(sensors)
        self.home = torch.empty(0)  # has device and dtype of state that is loaded before the first call

    @property
    def is_wanted(self) -> bool:
        """Whether any sensor carries something."""
        return bool(self.planned) or self.clock.is_wanted

    @property
    def num_envs(self) -> int | None:
        """Number of environments whose state is held; None before the first call."""
        sizes = (buffer.shape[0] for name, buffer in held_buffers(self).items() if not name.startswith(KEPT))
        return next(sizes, self.clock.num_envs)

    @property
    def num_kept(self) -> int | None:
        """Number of environments whose last readings it stores; None if it stores none."""
        return next((buffer.shape[0] for name, buffer in held_buffers(self).items() if name.startswith(KEPT)), None)

    def tensors(self, num_envs: int, dt: float | None, dtype: torch.dtype, device: torch.device) -> Tensors:
        """Return all buffers by name; at the first call they are allocated, as ordinary tensors even under `inference_mode`."""
        with torch.inference_mode(False):
            if self.is_wanted and self.num_envs is None:
                for path, planned in self.planned.items():
                    shape = (num_envs, *_calls(planned, dt), *planned.shape)
                    self.register_buffer(path, torch.full(shape, planned.rest, dtype=dtype, device=device))
                if self.clock.is_wanted:
                    calls = max((_calls(part, dt)[0] for _, part in self._rings.values()), default=0)
                    self.clock.start(num_envs, calls, torch.empty(0, dtype=dtype, device=device))
            if self.keeps_last and self.num_kept is None:
                for name, shape in self._kept.items():
                    room = torch.zeros(num_envs, *shape, dtype=dtype, device=device)
                    self.register_buffer(f"{KEPT}{name}", room, persistent=False)
        held = held_buffers(self)
        self._check_rings(held, dt)
        self._watch.look(held)
        return held | self.clock.tensors()

    def check(self, memory: Mapping[str, Tensor], num_envs: int, dt: float | None) -> None:
        """Refuse memory of another module."""
        if not isinstance(memory, Mapping):
            problem = f"memory: found {type(memory).__name__}"
            raise StateError(f"{problem}, expected `initial_memory`, or what the step before returned")
        clock = [f"clock/{name}" for name in COUNTS] if self.clock.is_wanted else []
        if missing := [name for name in (*self.planned, *clock) if name not in memory]:
            raise StateError(f'memory: found no "{missing[0]}"; expected `initial_memory`, or what the step before returned')
        for name, planned in self.planned.items():
            shape, rest = tuple(memory[name].shape), (*(("call",) if planned.past else ()), *planned.shape)
            if shape[0] != num_envs or len(shape) != len(rest) + 1 or shape[len(shape) - len(planned.shape) :] != planned.shape:
                expected = ", ".join(map(str, (num_envs, *rest)))
                raise StateError(f'memory: "{name}" has shape {shape}, expected ({expected})')
        self._check_rings(memory, dt)

    def _check_rings(self, memory: Mapping[str, Tensor], dt: float | None) -> None:
        for path, (sensor, planned) in self._rings.items():
            if _calls(planned, dt)[0] > memory[path].shape[1]:
                problem = f'SceneState.dt is {dt:g} s, shorter than at first: the ring of "{sensor}" does not hold'
                hint = "begin with the shortest dt, or call `touch.free()` to forget the past and start with this dt"
                raise StateError(f"{problem} {planned.past:g} s of so many calls; {hint}")

    def cache_readings(self, readings: Mapping[str, Tensor]) -> None:
        """Remember a call's readings, (env, row, channel): references, or if copies are stored, only that they are."""
        self._is_filled = self.num_kept is not None
        unsaved = {} if self._is_filled else readings
        self._last = {name: (reading.detach(), num_writes(reading)) for name, reading in unsaved.items()}

    def with_views(self, readings: Tensors) -> Tensors:
        """Replace stacks declared as views by the memory itself."""
        return readings | {name: self.get_buffer(f"{WINDOW}{name}").transpose(2, 3) for name in self._views}

    def keep_last(self, num_envs: int) -> None:
        """Store the readings of calls from now on: masked calls return them for the environments left out."""
        if not (self._is_filled or self._last):
            raise StateError("nothing was handed out yet for the environments left out: read all of them first")
        if not self._is_filled:
            if changed := [name for name, (reading, version) in self._last.items() if num_writes(reading) != version]:
                problem = f"the readings {listed(changed)} that were handed out last have been written into since"
                raise StateError(f"{problem}, and the environments left out are to have them: write into clones")
            with torch.inference_mode(False), torch.no_grad():
                for name, (reading, _) in self._last.items():
                    if name in self._kept:
                        copy = reading.transpose(-2, -1).clone(memory_format=torch.contiguous_format)
                        self.register_buffer(f"{KEPT}{name}", copy, persistent=False)
            self._is_filled = True
        if self.num_kept not in (None, num_envs):
            raise StateError(f"readings of {self.num_kept} environments were handed out before, the scene has {num_envs}")

    def keep_no_other(self, num_envs: int) -> None:
        """Drop stored readings if the number of environments differs; a module without state may change it."""
        if self.num_kept not in (None, num_envs):
            self._is_filled = False
            _drop(self, KEPT)

    def free(self) -> None:
        """Free all buffers, as before the first call."""
        _drop(self, "")
        self._last, self._is_filled = {}, False
        self.clock.free()

    def reset(self, chosen: Tensor) -> None:
        """Begin a new episode in the environments of a mask; noise and history restart at the next call."""
        for path, rest in self._restarted.items():
            buffer = self.get_buffer(path)
            buffer.masked_fill_(broadcast_over(chosen, buffer), rest)
        self.clock.reset(chosen)

    def restarted(self, memory: Mapping[str, Tensor], chosen: Tensor) -> Tensors:
        """Return memory after a reset, without changing it: `reset` for memory that the caller holds."""
        result = dict(memory)
        for path, rest in self._restarted.items():
            result[path] = memory[path].masked_fill(broadcast_over(chosen, memory[path]), rest)
        if "clock/step" in memory:
            result["clock/episode"] = memory["clock/episode"] + chosen
            result["clock/reset_step"] = torch.where(chosen, memory["clock/step"], memory["clock/reset_step"])
        return result

    def on_move(self, fn: Callable[[Tensor], Tensor], move: Callable[[], object]) -> None:
        """Move or cast all buffers; the last readings lie elsewhere."""
        self._last = {}
        move()

    def on_load(self, state_dict: dict[str, Any], prefix: str, errors: list[str], load: Callable[[], object]) -> None:
        """Allocate buffers for the loaded state, in the module's own dtype; refuse an incomplete state.

        Buffers of the right shape are reused: captured graphs refer to them.
        """
        loaded = {path: state_dict[prefix + path] for path in self.planned if isinstance(state_dict.get(prefix + path), Tensor)}
        counts = {name: state_dict[key] for name in COUNTS if (key := f"{prefix}clock.{name}") in state_dict}
        if loaded or counts:
            errors.extend(self._misfits(loaded, counts, prefix))
        if errors:
            return  # nothing is loaded, in the clock neither
        with torch.inference_mode(False):
            for path, value in loaded.items():
                if path not in (held := held_buffers(self)) or held[path].shape != value.shape:
                    self.register_buffer(path, torch.zeros(value.shape, dtype=self.home.dtype, device=self.home.device))
        self._last, self._is_filled = {}, False  # the replaced state returned them
        load()

    def _misfits(self, found: Mapping[str, Tensor], counts: Mapping[str, Tensor], prefix: str) -> list[str]:
        """Return the errors of a state to load: missing parts, and parts of another shape than planned."""
        missing = [path for path in self.planned if path not in found]
        missing += [f"clock.{name}" for name in COUNTS if name not in counts] if self.clock.is_wanted else []
        wrong = [f'"{prefix}{path}" is missing, other state is there' for path in missing]
        sizes = {len(value) for value in [*found.values(), *counts.values()] if value.ndim}
        if len(sizes) > 1:
            wrong.append(f'the parts of "{prefix}" are of {sorted(sizes)} environments')
        for path, value in found.items():
            shape, expected = tuple(value.shape), tuple(self.planned[path].shape)
            if shape[value.ndim - len(expected) :] != expected:
                wrong.append(f'"{prefix}{path}" has shape {shape}, expected (env, …, {", ".join(map(str, expected))})')
        return wrong


def _calls(planned: PlannedMemory, dt: float | None) -> tuple[int, ...]:
    """Return how many earlier calls a ring holds; empty if there is no ring."""
    if planned.past == 0 or dt is None:
        return ()
    return (max(math.ceil(planned.past / dt - 1e-6), 1),)


def pushed(window: Window, reading: Float[Tensor, "env row channel"], age: Int[Tensor, " env"]) -> Window:
    """Return a window after a call; `age`: calls since each environment's reset, before this one.

    After a reset the first call fills the window. Gradients flow through the reading.
    """
    newest = reading.transpose(1, 2)[:, None]
    moved = torch.cat([window[:, 1:], newest], dim=1)
    return torch.where((age == 0)[:, None, None, None], newest, moved)


def reduced(window: Window, reduce: str) -> Float[Tensor, "env *step row channel"]:
    """Return a window's reading: all of it (`stack`), or the `mean` or `median` over its calls."""
    if reduce == "stack":
        return window.transpose(2, 3)
    if reduce == "mean":
        return window.mean(dim=1).transpose(1, 2)
    ordered, count = window.sort(dim=1).values, window.shape[1]  # of an even number the mean of both middle ones
    return (0.5 * (ordered[:, (count - 1) // 2] + ordered[:, count // 2])).transpose(1, 2)


def last_step(reading: Float[Tensor, "env *step row channel"]) -> Float[Tensor, "env row channel"]:
    """Return the last of stacked calls; a reading of one call is returned as it is."""
    return reading[:, -1] if reading.ndim == 4 else reading


def store(memory: Mapping[str, Tensor], updated: Mapping[str, Tensor]) -> None:
    """Overwrite the old state; in a ring, this call's entry."""
    with torch.no_grad():
        for name, value in updated.items():
            if value.ndim < memory[name].ndim:
                memory[name].index_put_(_entry_of(memory, name), value.detach())
        for name, value in updated.items():
            if value.ndim == memory[name].ndim:
                memory[name].copy_(value.detach())


def stored(memory: Mapping[str, Tensor], updated: Mapping[str, Tensor]) -> Tensors:
    """Return memory with the new state, as `store` writes it, without detaching derivatives."""
    result = {**memory, **updated}
    for name, value in updated.items():
        if value.ndim < memory[name].ndim:
            result[name] = memory[name].index_put(_entry_of(memory, name), value)
    return result


def last_readings(readings: Mapping[str, Tensor], memory: Mapping[str, Tensor]) -> Tensors:
    """Return a call's readings as the memory stores them, if it stores any."""
    return {f"{KEPT}{name}": reading.transpose(-2, -1) for name, reading in readings.items() if f"{KEPT}{name}" in memory}


def _entry_of(memory: Mapping[str, Tensor], name: str) -> tuple[Tensor, Tensor]:
    """Return the places of this call's entries in a ring: environment, and which of its calls."""
    place = materialised(memory["clock/step"] % memory[name].shape[1])
    return torch.arange(place.shape[0], device=place.device), place


def chosen_rows(
    mask: Bool[Tensor, " env"], readings: Tensors, updated: Tensors, memory: Mapping[str, Tensor]
) -> tuple[Tensors, Tensors]:
    """Return readings and new state in the environments of a mask; elsewhere, the last readings and the old state."""
    selected, result = {}, dict(readings)
    for name, value in updated.items():
        old = memory[name] if value.ndim == memory[name].ndim else memory[name][_entry_of(memory, name)]
        selected[name] = torch.where(broadcast_over(mask, value), value, old)
    for name, reading in readings.items():
        if f"{KEPT}{name}" in memory:
            last = memory[f"{KEPT}{name}"]
            result[name] = torch.where(broadcast_over(mask, reading), reading.transpose(-2, -1), last).transpose(-2, -1)
        elif f"{WINDOW}{name}" in memory:
            result[name] = reduced(selected[f"{WINDOW}{name}"], "stack")
    return result, selected

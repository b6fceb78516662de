"""What a module carries from one call to the next: buffers of each sensor, windows over last readings, and its clock.

Shapes: `env` environments, `call` calls that a ring remembers, `step` calls of a window, `row` taxels or bodies, `channel`
numbers per row.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from tgdsl.errors import StateError, listed
from tgdsl.module.memory.clock import ENV, SHARED, Clock
from tgdsl.module.memory.history import reduced
from tgdsl.plan.sensors import PlannedMemory, PlannedReading, PlannedSensor
from tgdsl.sensors.base import Kind
from tgdsl.tensors.env_ids import broadcast_over, few_ids
from tgdsl.tensors.fusion import materialised
from tgdsl.tensors.on_host import HostCopy
from tgdsl.tensors.torch_internals import HookedModule, held_buffers, num_writes

EVERY = 16  # on a GPU one call in so many is looked at: a small kernel takes as long to launch as a module's own


class StateWatch:
    """Looks at state that kinds warn of, see `Kind.warns`: what the calls before have left. Each message comes once."""

    def __init__(self, sensors: Sequence[PlannedSensor], kinds: Mapping[str, Kind]):
        """Note what is to be looked at."""
        rows = {sensor.name: [f"{sensor.sensor}[{i}]" for i in range(sensor.readings[0].num_rows)] for sensor in sensors}
        self._watched = [
            (f"{sensor.name}:{state}", sensor, tuple(row for name in sensor.upstream for row in rows[name]), warn)
            for sensor in sensors
            for state, warn in (kinds[sensor.name].warns if sensor.name in kinds else ())
        ]
        self._said: set[str] = set()
        self._num_calls = 0
        self._copies = {path: HostCopy() for path, *_ in self._watched}

    def look(self, memory: Mapping[str, Tensor]) -> None:
        """Look at what is remembered, and warn of what is new. What a GPU holds may be seen some calls later."""
        if not self._watched or torch.compiler.is_compiling():
            return
        self._num_calls += 1
        for path, sensor, rows, warn in self._watched:
            if memory[path].is_cuda and self._num_calls % EVERY != 1:
                continue
            largest = self._copies[path].poll(memory[path].detach().amax(dim=0))
            for message in () if largest is None else warn(sensor.sensor, sensor.constants, rows, largest.numpy()):
                if message not in self._said:
                    self._said.add(message)
                    warnings.warn(message, stacklevel=6)


WINDOW, KEPT = "history/", "kept/"
"""Buffers `history/<reading>` (env, step, channel, row), its last calls; `kept/<reading>`, the last one."""


class Memory(HookedModule):
    """Buffers `sensor:name`, (env, …) or (env, call, …), and `history/<reading>`; none before the first call.

    Attributes:
        home: Has device and dtype of state that is loaded before the first call.
        keeps_last: Whether it stores the last readings from the first call on, and not only once some environments are read
            alone, which needs them: code that is compiled for the first call then serves all later ones.
    """

    def __init__(
        self,
        sensors: Sequence[PlannedSensor],
        readings: Mapping[str, PlannedReading],
        kinds: Mapping[str, Kind] | None = None,
    ):
        """Note what sensors carry, and what all readings are; `kinds` by sensor, where what they warn of is to be watched."""
        super().__init__()
        self._watch = StateWatch(sensors, kinds or {})
        self._planned = {f"{s.name}:{name}": part for s in sensors for name, part in s.state.items()}
        for s in sensors:
            for reading in s.windows:
                assert s.history is not None
                shape = (s.history.length, len(reading.channels), reading.num_rows)
                self._planned[f"{WINDOW}{reading.name}"] = PlannedMemory(0.0, shape)
        self._restarted = {f"{s.name}:{n}": part.rest for s in sensors for n, part in s.state.items() if "/" not in n}
        self._rings = {f"{s.name}:{n}": (s.sensor, part) for s in sensors for n, part in s.state.items() if part.past > 0}
        stacks = {reading.name for s in sensors for reading in s.windows if reading.steps}  # their windows hold them already
        self._kept = {
            name: (*((reading.steps,) if reading.steps else ()), len(reading.channels), reading.num_rows)
            for name, reading in readings.items()
            if name not in stacks
        }
        self._views = [reading.name for s in sensors if s.history and s.history.view for reading in s.windows]
        self._last: dict[str, tuple[Tensor, int]] = {}
        self._is_filled = False  # whether the stored readings were handed out
        self.keeps_last = False
        self.clock = Clock(sensors)
        self.home = torch.empty(0)

    @property
    def is_wanted(self) -> bool:
        """Whether any sensor carries something."""
        return bool(self._planned) or self.clock.is_wanted

    @property
    def num_envs(self) -> int | None:
        """Number of environments whose state is held; None before the first call."""
        for name, buffer in held_buffers(self).items():
            if not name.startswith(KEPT):
                return buffer.shape[0]
        return self.clock.num_envs

    def tensors(self, num_envs: int, dt: float | None, dtype: torch.dtype, device: torch.device) -> dict[str, Tensor]:
        """Return all buffers by name; at the first call they are allocated, as ordinary tensors even under `inference_mode`.

        Raises:
            StateError: If dt is so short that a ring is too short.
        """
        if self.is_wanted and self.num_envs is None:
            with torch.inference_mode(False):
                for path, planned in self._planned.items():
                    shape = (num_envs, *_calls(planned, dt), *planned.shape)
                    self.register_buffer(path, torch.full(shape, planned.rest, dtype=dtype, device=device))
                if self.clock.is_wanted:
                    calls = max((_calls(part, dt)[0] for _, part in self._rings.values()), default=0)
                    self.clock.start(num_envs, calls, torch.empty(0, dtype=dtype, device=device))
        if self.keeps_last and self.num_kept is None:
            with torch.inference_mode(False):
                for name, shape in self._kept.items():
                    room = torch.zeros(num_envs, *shape, dtype=dtype, device=device)
                    self.register_buffer(f"{KEPT}{name}", room, persistent=False)
        held = held_buffers(self)
        self._check_rings(held, dt)
        self._watch.look(held)
        return held | self.clock.tensors()

    def check(self, memory: Mapping[str, Tensor], num_envs: int, dt: float | None) -> None:
        """Look at memory that is not held here.

        Raises:
            StateError: If some of it is missing, of another shape or number of environments, or its rings are too short for dt.
        """
        clock = ("clock/age", "clock/step") if self.clock.is_wanted else ()
        if missing := [name for name in (*self._planned, *clock) if name not in memory]:
            raise StateError(f'memory: found no "{missing[0]}"; expected `initial_memory`, or what the step before returned')
        for name, planned in self._planned.items():
            shape, rest = tuple(memory[name].shape), (*(("call",) if planned.past else ()), *planned.shape)
            if shape[0] != num_envs or len(shape) != len(rest) + 1 or shape[len(shape) - len(planned.shape) :] != planned.shape:
                expected = ", ".join(map(str, (num_envs, *rest)))
                raise StateError(f'memory: "{name}" has shape {shape}, expected ({expected})')
        self._check_rings(memory, dt)

    def _check_rings(self, memory: Mapping[str, Tensor], dt: float | None) -> None:
        for path, (sensor, planned) in self._rings.items():
            if _calls(planned, dt)[0] > memory[path].shape[1]:
                problem = f'SceneState.dt is {dt:g} s, shorter than at first: the ring of "{sensor}" does not hold'
                raise StateError(f"{problem} {planned.past:g} s of so many calls; begin with the shortest dt")

    @property
    def num_kept(self) -> int | None:
        """Number of environments whose last readings it stores; None if it stores none."""
        return next((buffer.shape[0] for name, buffer in held_buffers(self).items() if name.startswith(KEPT)), None)

    def cache_readings(self, readings: Mapping[str, Tensor]) -> None:
        """Note what is handed out, (env, row, channel): where it lies, or once it is kept, that it is."""
        self._is_filled = self.num_kept is not None
        self._last = {}
        if not self._is_filled:
            self._last = {name: (reading.detach(), num_writes(reading)) for name, reading in readings.items()}

    def with_views(self, readings: dict[str, Tensor]) -> dict[str, Tensor]:
        """Put the memory itself in the place of stacks that are declared as views."""
        return readings | {name: self.get_buffer(f"{WINDOW}{name}").transpose(2, 3) for name in self._views}

    def keep_last(self, num_envs: int) -> None:
        """From now on keep what is handed out, for the environments that a masked call leaves out.

        Raises:
            StateError: If nothing was handed out yet, or of another number of environments.
        """
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
        """Keep readings no longer if they are of another number of environments, which a module without state may change."""
        if self.num_kept not in (None, num_envs):
            self._forget_kept()

    def _forget_kept(self) -> None:
        self._is_filled = False
        for name in [name for name, _ in self.named_buffers(recurse=False) if name.startswith(KEPT)]:
            delattr(self, name)

    def free(self) -> None:
        """Hold nothing again, as before the first call."""
        for name in [name for name, _ in self.named_buffers(recurse=False)]:
            delattr(self, name)
        self._last, self._is_filled = {}, False
        self.clock.free()

    def reset(self, chosen: Tensor) -> None:
        """Begin a new episode in the environments of a mask; what noise and history remember restarts by its age."""
        for path, rest in self._restarted.items():
            buffer = self.get_buffer(path)
            buffer.masked_fill_(broadcast_over(chosen, buffer), rest)
        self.clock.reset(chosen)

    def restarted(self, memory: Mapping[str, Tensor], chosen: Tensor) -> dict[str, Tensor]:
        """Return what `reset` makes of memory that is not this module's own."""
        at_rest = {
            path: memory[path].masked_fill(broadcast_over(chosen, memory[path]), rest) for path, rest in self._restarted.items()
        }
        return {**memory, **at_rest, **self.clock.restarted(memory, chosen)}

    def on_move(self, fn: Callable[[Tensor], Tensor], move: Callable[[], object]) -> None:
        """Move or cast all buffers; what was handed out last lies elsewhere."""
        self._last = {}
        move()

    def on_load(self, state_dict: dict[str, Any], prefix: str, errors: list[str], load: Callable[[], object]) -> None:
        """Make room for the state that is loaded, in the module's own dtype; part of a state is no state.

        Buffers that have the shape already stay where they are: captured graphs go on with them.
        """
        loaded = {
            path: state_dict[prefix + path] for path in self._planned if isinstance(state_dict.get(prefix + path), Tensor)
        }
        has_clock = f"{prefix}clock.age" in state_dict
        if loaded or has_clock:
            errors.extend(self._misfits(loaded, state_dict.get(f"{prefix}clock.age"), prefix))
        if errors:
            return  # nothing is loaded, nor by the clock
        with torch.inference_mode(False):
            for path, value in loaded.items():
                if path not in (held := held_buffers(self)) or held[path].shape != value.shape:
                    self.register_buffer(path, torch.zeros(value.shape, dtype=self.home.dtype, device=self.home.device))
        self._last, self._is_filled = {}, False  # what is replaced has handed them out
        load()

    def _misfits(self, found: Mapping[str, Tensor], age: Tensor | None, prefix: str) -> list[str]:
        """Return what is wrong with state that is to be loaded: parts that lack, or are not of the planned shape."""
        wrong = [f'"{prefix}{path}" is missing beside other state' for path in self._planned if path not in found]
        if self.clock.is_wanted and age is None:
            wrong.append(f'"{prefix}clock.age" is missing beside other state')
        counts = {len(value) for value in [*found.values(), *([] if age is None else [age])] if value.ndim}
        if len(counts) > 1:
            wrong.append(f'the parts of "{prefix}" are of {sorted(counts)} environments')
        for path, value in found.items():
            expected = self._planned[path].shape
            if tuple(value.shape[value.ndim - len(expected) :]) != tuple(expected):
                wrong.append(
                    f'"{prefix}{path}" has shape {tuple(value.shape)}, expected (env, …, {", ".join(map(str, expected))})'
                )
        return wrong


def store(memory: Mapping[str, Tensor], updated: Mapping[str, Tensor]) -> None:
    """Put new state in the place of the old one; of a ring, this call's entry."""
    with torch.no_grad():
        for name, value in updated.items():
            if value.ndim < memory[name].ndim:
                memory[name].index_put_(_entry_of(memory, name), value.detach())
        for name, value in updated.items():
            if value.ndim == memory[name].ndim:
                memory[name].copy_(value.detach())


def stored(memory: Mapping[str, Tensor], updated: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return memory with new state in the place of the old one, as `store` writes it; derivatives go through it."""
    result = {**memory, **updated}
    for name, value in updated.items():
        if value.ndim < memory[name].ndim:
            result[name] = memory[name].index_put(_entry_of(memory, name), value)
    return result


def kept(readings: Mapping[str, Tensor], memory: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return what is kept of readings that are handed out, if anything is."""
    return {f"{KEPT}{name}": reading.transpose(-2, -1) for name, reading in readings.items() if f"{KEPT}{name}" in memory}


def chosen_only(memory: Mapping[str, Tensor], updated: Mapping[str, Tensor], mask: Tensor) -> dict[str, Tensor]:
    """Return new state of the environments of a mask, and the old one of all others."""
    selected = {}
    for name, value in updated.items():
        old = memory[name] if value.ndim == memory[name].ndim else memory[name][_entry_of(memory, name)]
        selected[name] = torch.where(broadcast_over(mask, value), value, old)
    return selected


def _entry_of(memory: Mapping[str, Tensor], name: str) -> tuple[Tensor, Tensor]:
    place = materialised(memory["clock/step"] % memory[name].shape[1])
    return torch.arange(place.shape[0], device=place.device), place


def _calls(planned: PlannedMemory, dt: float | None) -> tuple[int, ...]:
    if planned.past == 0 or dt is None:
        return ()
    return (max(math.ceil(planned.past / dt - 1e-6), 1),)


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

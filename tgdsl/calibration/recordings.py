"""Recordings that sensors are fitted to: one `.npz` file of a scene's states, and what a real sensor read meanwhile.

| key | shape | content |
|---|---|---|
| `time` | (step,) | clock of the states [s], ascending |
| a field of `SceneState` | (step, …) | as the simulator would give it; `body_pos` and `body_quat` are needed |
| `bodies`, `pairs`, `joints`, … | names | what stands along the axis of such a field; default: the order of `touch.inputs` |
| `width:<field>` | as one step, or as all | standard deviation of the field's offset, at all steps or at each; 0: none |
| `target:<reading>` | (sample, row, channel) | what the sensor read |
| `rows:<reading>` | text | "sum": the target is the sum of all rows, (sample, 1, channel), as of a load cell; default: "each" |
| `unit:<reading>` | text | unit of the target |
| `clock:<reading>` | (sample,) | clock of the target [s], ascending |
| `clock_width:<reading>` | () | standard deviation of its unknown offset from the states' clock [s]; default: 0, none |
| `channels:<reading>` | names | channels of the target; default: all of the reading's |
| `weight:<reading>` | as the target, or less | weight of each number; 0 leaves it out, and it may then be NaN |
| `floor:<reading>` | () | RMS noise of the target, in its unit |
| `zero:<reading>` | () | time on the target's clock at which the sensor was set to zero |

Velocities that a module reads and a recording lacks are derivatives of the poses. States are interpolated at the target's
times.

A reading that holds several instants per call, as sound or a stacked history does, has them as rows, instant by instant; in the
file they are an axis (sample, instant, row, channel).

Shapes: `step` states, `sample` times of a target, `row` taxels (or markers, bodies, …), `channel` numbers of a row.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float

from tgdsl.calibration.tables import read_tables
from tgdsl.errors import Problem, SpecError, did_you_mean, listed
from tgdsl.fields.units import UNITS
from tgdsl.module.outputs import Output
from tgdsl.module.state import CHOICES, SHAPES
from tgdsl.plan.inputs import Inputs

NAMES_OF = {axis: f"{axis}s" for axis in ("pair", "object", "joint", "actuator")} | {"body": "bodies", "heated": "heated"}
"""Key of the names along each axis of the state."""
OF_TARGET = ("target", "rows", "unit", "clock", "clock_width", "channels", "weight", "floor", "zero")
ROUNDING = 0.01  # largest error of a quaternion's length: recordings are rounded
DERIVED = {"body_linvel": "body_pos", "body_angvel": "body_quat"}  # velocities that follow from other fields
Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Target:
    """Readings of a sensor."""

    reading: str  # name of the reading
    value: Float[np.ndarray, "sample row channel"]  # in the unit of the reading; 0 where the weight is
    weight: Float[np.ndarray, "sample row channel"]  # weight of each number
    channels: tuple[int, ...]  # places of its channels among the reading's
    time: Float[np.ndarray, " sample"]  # its clock [s]
    clock_width: float  # standard deviation of the clock's offset [s]
    floor: float  # RMS noise, in the unit of the reading; 0: unknown
    unit: str  # unit of the reading
    zero: float | None  # time at which the reading was set to zero [s]; None: never
    is_sum: bool = False  # whether its one row is the sum of the reading's


@dataclass(frozen=True, eq=False)
class Recording:
    """States of a scene and readings of sensors."""

    name: str  # name of its file
    time: Float[np.ndarray, " step"]  # clock of the states [s]
    fields: Arrays  # fields of `SceneState` (step, …), in the order of the module's inputs
    widths: Arrays  # standard deviations of the fields' offsets, (1, …) or (step, …)
    targets: tuple[Target, ...]  # readings of sensors

    def state_at(self, time: Float[np.ndarray, " sample"], fields: Arrays) -> dict[str, np.ndarray]:
        """Return fields at other times, linear in between; choices and contacts as at the step before."""
        if len(self.time) == 1:
            return {name: np.repeat(value, len(time), axis=0) for name, value in fields.items()}
        after = np.clip(np.searchsorted(self.time, time, side="right"), 1, len(self.time) - 1)
        part = np.clip((time - self.time[after - 1]) / (self.time[after] - self.time[after - 1]), 0.0, 1.0)
        result = {}
        for name, value in fields.items():
            first, second, share = value[after - 1], value[after], part.reshape(-1, *[1] * (value.ndim - 1))
            if name in (*CHOICES, "contact_found"):
                result[name] = np.where(share < 1, first, second)
                continue
            if name == "body_quat":
                second = np.where((first * second).sum(axis=-1, keepdims=True) < 0, -second, second)
            mixed = first + share * (second - first)
            result[name] = mixed / np.linalg.norm(mixed, axis=-1, keepdims=True) if name == "body_quat" else mixed
        return result


def velocities(time: np.ndarray, fields: Arrays) -> dict[str, np.ndarray]:
    """Return linear and angular velocities of bodies from their poses; 0 if there is one step only."""
    pos, quat = fields["body_pos"], fields["body_quat"]
    if len(time) == 1:
        return {"body_linvel": np.zeros_like(pos), "body_angvel": np.zeros_like(pos)}
    is_turned = np.cumprod(np.where((quat[1:] * quat[:-1]).sum(axis=-1, keepdims=True) < 0, -1.0, 1.0), axis=0)
    quat = quat * np.concatenate([np.ones((1, *quat.shape[1:-1], 1)), is_turned])
    rate = np.gradient(quat, time, axis=0)
    w, v, dw, dv = quat[..., :1], quat[..., 1:], rate[..., :1], rate[..., 1:]
    return {"body_linvel": np.gradient(pos, time, axis=0), "body_angvel": 2.0 * (w * dv - dw * v - np.cross(dv, v))}


def load_recording(
    source: str | Path | Arrays, inputs: Inputs, outputs: Mapping[str, Output], name: str = "<arrays>"
) -> Recording:
    """Read a recording for a module that reads `inputs` and returns `outputs`, by name.

    The source is a `.npz` file, a YAML document of CSV files, or arrays, whose `name` stands in messages.

    Raises:
        SpecError: All that is wrong with it, by its keys.
    """
    name = name if isinstance(source, Mapping) else str(source)
    reader = _Reader(name, _arrays(source, name), inputs, outputs)
    recording = reader.recording()
    if reader.problems:
        raise SpecError(reader.problems)
    return recording


def _arrays(source: str | Path | Arrays, name: str) -> dict[str, np.ndarray]:
    if not isinstance(source, Mapping) and Path(source).suffix in (".yaml", ".yml"):
        source = read_tables(source)
    if isinstance(source, Mapping):
        return {key: np.asarray(value) for key, value in source.items()}
    try:
        with np.load(source) as file:
            return dict(file)
    except (OSError, EOFError, ValueError, BadZipFile, TypeError, AttributeError) as error:
        why = "there is no such file" if isinstance(error, FileNotFoundError) else "this is no .npz file of plain arrays"
        hint = "a CSV file needs a YAML document that says what its columns are" if Path(name).suffix == ".csv" else ""
        raise SpecError([Problem(name, 0, 0, "", why, hint)]) from error


@dataclass
class _Reader:
    """Reads one recording and collects its mistakes; a wrong entry is read as an empty array, or None."""

    name: str
    arrays: dict[str, np.ndarray]
    inputs: Inputs
    outputs: Mapping[str, Output]
    problems: list[Problem] = field(default_factory=list)

    def note(self, key: str, what: str, hint: str = "") -> None:
        problem = Problem(self.name, 0, 0, key, what, hint)
        if problem not in self.problems:
            self.problems.append(problem)

    def note_first(self, key: str, value: np.ndarray, is_bad: np.ndarray, end: str, hint: str) -> bool:
        """Note the first bad entry of an array; return whether there is any."""
        bad = np.argwhere(is_bad)
        if len(bad):
            self.note(key, f"[{', '.join(map(str, bad[0]))}] is {value[tuple(bad[0])]}{end.format(num=len(bad))}", hint)
        return len(bad) > 0

    def recording(self) -> Recording:
        valid_keys = {"time", *SHAPES, *NAMES_OF.values(), *(f"width:{name}" for name in SHAPES)}
        valid_keys |= {f"{prefix}:{name}" for prefix in OF_TARGET for name in self.outputs}
        for key in self.arrays:
            prefix, _, name = key.partition(":")
            if key not in valid_keys and (prefix not in OF_TARGET[1:] or f"target:{name}" not in self.arrays):
                self.note(key, "unknown key", did_you_mean(key, valid_keys, "keys"))
        time = self._clock("time", "clock of the states")
        needed = [name for name in self.inputs.fields if name != "dt"]
        fields = {name: self._field(name, len(time)) for name in needed if name in self.arrays}
        for name in needed:
            if name not in fields and DERIVED.get(name) not in {*self.arrays, *needed}:
                hint = "gate: geometric needs no contacts; " if name.startswith("contact_") else ""
                self.note(name, "this field is missing", f"{hint}the module reads {', '.join(self.inputs.fields)}")
        widths = {name: self._width(name, value) for name, value in fields.items() if f"width:{name}" in self.arrays}
        readings = [key.removeprefix("target:") for key in self.arrays if key.startswith("target:")]
        if not readings:
            self.note("", "there is no target", f"expected target:<reading>, of {', '.join(self.outputs)}")
        targets = [target for name in readings if (target := self._target(name, time)) is not None]
        return Recording(Path(self.name).name, time, fields, widths, tuple(targets))

    def _numbers(self, key: str) -> np.ndarray | None:
        value = self.arrays[key]
        if value.dtype.kind not in "biuf":
            self.note(key, f"found an array of {value.dtype}, expected numbers")
            return None
        return value.astype(np.float64)

    def _clock(self, key: str, what: str) -> np.ndarray:
        if key not in self.arrays:
            self.note(key, f"this {what} is missing", "expected times [s], one for each")
            return np.zeros(0)
        time = self._numbers(key)
        if time is None or time.ndim != 1 or not len(time):
            self.note(key, f"found shape {self.arrays[key].shape}, expected times [s]")
            return np.zeros(0)
        if not self.note_first(key, time, ~np.isfinite(time), "", "expected a time") and (np.diff(time) <= 0).any():
            i = int(np.argmax(np.diff(time) <= 0))
            self.note(key, f"[{i + 1}] is {time[i + 1]:g} s after {time[i]:g} s", "expected ascending times: sort the samples")
        return time

    def _field(self, name: str, num_steps: int) -> np.ndarray:
        value, shape = self._numbers(name), SHAPES[name]
        if value is None:
            return np.zeros(0)
        hint = "expected a finite number: leave the step out"
        if not self.note_first(name, value, ~np.isfinite(value), "", hint) and name == "body_quat":
            is_bad = abs(np.linalg.norm(value, axis=-1) - 1) > ROUNDING
            self.note_first(name, value, is_bad, "", "expected a quaternion of length 1, w first")
        value = self._ordered(name, value) if value.ndim > 1 else value
        expected = (num_steps, *(self.inputs.sizes[part] if isinstance(part, str) else part for part in shape))
        if num_steps and value.shape != expected:
            names = f"; {shape[0]}: {listed(self.inputs.names[str(shape[0])])}"
            self.note(name, f"found shape {value.shape}, expected ({', '.join(map(str, expected))}){names}")
        return value

    def _ordered(self, name: str, value: np.ndarray) -> np.ndarray:
        """Return a field, or its widths, with the entries of its first axis in the module's order."""
        axis = str(SHAPES[name][0])
        key = NAMES_OF[axis]
        if key not in self.arrays:
            return value
        names = [str(name) for name in self.arrays[key]]
        for twice in sorted(name for name in set(names) if names.count(name) > 1):
            self.note(key, f'"{twice}" stands there {names.count(twice)} times', "expected each name once")
        for needed in self.inputs.names[axis]:
            if needed not in names:
                self.note(key, f'"{needed}" is missing', did_you_mean(needed, names, "names"))
                return value
        return value[:, [names.index(needed) for needed in self.inputs.names[axis]]] if value.shape[1] == len(names) else value

    def _width(self, name: str, value: np.ndarray) -> np.ndarray:
        key = f"width:{name}"
        width = self._numbers(key)
        if width is None:
            return np.zeros(0)
        width = width[None] if width.ndim == value.ndim - 1 else width
        width = self._ordered(name, width) if width.ndim == value.ndim > 1 else width
        if width.shape not in (value.shape, (1, *value.shape[1:])):
            self.note(key, f"found shape {width.shape}, expected {value.shape[1:]}, or {value.shape} for each step its own")
        elif not (np.isfinite(width) & (width >= 0)).all():
            self.note(key, "expected standard deviations of at least 0")
        return width

    def _target(self, name: str, steps: np.ndarray) -> Target | None:
        key, weight_key = f"target:{name}", f"weight:{name}"
        output, value = self.outputs.get(name), self._numbers(key)
        time = self._clock(f"clock:{name}", "clock of the target")
        if output is None or value is None:
            return None  # which is noted
        channels, (factor, unit) = self._channels(name, output), self._unit(name, output)
        if not len(time):
            return None
        is_sum = self._is_sum(name, output)
        shape = (len(time), *((1,) if is_sum else output.shape[:-1]), len(channels))
        if value.shape != shape:
            axes = (*(["instants"] if len(shape) > 3 else []), "the sum" if is_sum else f"{output.rows}s")
            hint = (
                f'if they are sums of all rows, set rows:{name} to "sum"' if value.shape == (*shape[:1], 1, *shape[2:]) else ""
            )
            if not hint and value.shape[:-1] == shape[:-1] and f"channels:{name}" not in self.arrays:
                hint = f"name those that it has in channels:{name}"
            self.note(key, f"found shape {value.shape}, expected {shape}: samples, {', '.join(axes)}, channels", hint)
            return None
        try:
            weight = np.broadcast_to(self.arrays.get(weight_key, np.ones(())), shape).astype(np.float64)
        except ValueError:
            self.note(weight_key, f"found shape {self.arrays[weight_key].shape}, expected one that fits {shape}")
            return None
        if not (np.isfinite(weight) & (weight >= 0)).all():
            self.note(weight_key, "expected weights of at least 0")
        hint = f"leave the sample out, or set {weight_key} to 0 there"
        self.note_first(key, value, ~np.isfinite(value) & (weight > 0), ", {num} such numbers in all", hint)
        if (weight > 0).any() and not (value[weight > 0] != 0.0).any():
            self.note(key, "all its numbers are 0", "expected a recording of what the sensor reads under load")
        width = self._scalar(f"clock_width:{name}") or 0.0
        if len(steps) > 1 and (time[-1] < steps[0] - 5 * width or time[0] > steps[-1] + 5 * width):
            span = f"{time[0]:g} to {time[-1]:g} s, the states are from {steps[0]:g} to {steps[-1]:g} s"
            self.note(f"clock:{name}", f"found times from {span}", f"expected a common time, or a larger clock_width:{name}")
        floor, zero = self._scalar(f"floor:{name}") or 0.0, self._scalar(f"zero:{name}")
        value = np.where((weight > 0) & np.isfinite(value), value, 0.0) * factor
        value, weight = (each.reshape(len(time), -1, len(channels)) for each in (value, weight))
        return Target(name, value, weight, channels, time, width, floor * factor, unit, zero, is_sum)

    def _is_sum(self, name: str, output: Output) -> bool:
        """Return whether the target is the sum of all rows."""
        key = f"rows:{name}"
        written = str(self.arrays.get(key, "each"))
        if written not in ("each", "sum"):
            self.note(key, f'found "{written}"', 'expected "each" or "sum"')
        elif written == "sum" and len(output.shape) > 2:
            self.note(key, "a reading of several instants per call has no sum", 'expected "each"')
        return written == "sum" and len(output.shape) == 2

    def _channels(self, name: str, output: Output) -> tuple[int, ...]:
        key = f"channels:{name}"
        names = [str(part) for part in self.arrays.get(key, np.array(output.channels)).reshape(-1)]
        for channel in names:
            if channel not in output.channels:
                self.note(key, f'"{channel}" is no channel', did_you_mean(channel, output.channels, "channels"))
        return tuple(output.channels.index(channel) for channel in names if channel in output.channels)

    def _unit(self, name: str, output: Output) -> tuple[float, str]:
        """Return the factor from the target's unit to the reading's, and the latter."""
        key, unit = f"unit:{name}", output.units[0]
        written, symbol = str(self.arrays.get(key, "")), unit.replace("·", "*")
        factors = next((units for units in UNITS.values() if symbol in units), {})
        if written == unit:
            return 1.0, unit
        if written in factors:
            return factors[written] / factors[symbol], unit
        if not written:
            hint = f'the reading is in {unit}: expected "{unit}" or one like it'
            self.note(key, "the unit of the target is missing", hint)
        else:
            hint = f"expected one of {', '.join(factors) or unit}, and numbers in it"
            self.note(key, f'"{written}" is no unit of this reading, which is in {unit}', hint)
        return 1.0, unit

    def _scalar(self, key: str) -> float | None:
        if key not in self.arrays:
            return None
        value = self._numbers(key)
        if value is None or value.ndim or not np.isfinite(value):
            self.note(key, f"found shape {self.arrays[key].shape}, expected one number")
            return None
        return float(value)

"""A document as a function of some of its parameters: its sensors' readings during a recording.

A parameter that only changes constants of its sensor is lowered again for that sensor alone. If it changes the sensor's
requests of the scene, or the shape of its constants, the document is compiled again.
"""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
import torch
from pydantic import BaseModel, ValidationError

from tgdsl.calibration.recordings import DERIVED, Recording, Target, velocities
from tgdsl.compiler.lowered import LoweredSensor, ways
from tgdsl.compiler.pipeline import Document, compile_document
from tgdsl.console.progress import silent
from tgdsl.errors import SpecError, TgdslError, did_you_mean
from tgdsl.fields import units
from tgdsl.fields.models import Quantity, Usual
from tgdsl.module.module import TactileModule
from tgdsl.module.state import CHOICES, SceneState
from tgdsl.quantities.base import Request
from tgdsl.sensors import Kind
from tgdsl.sensors.known import known_kinds

DECADES = 1.0  # search range of a positive parameter without bounds around its start, either way
LOGARITHMIC = 20.0  # ratio of bounds from which a positive parameter is searched by its logarithm


class InfeasibleError(TgdslError):
    """Values within their bounds that no sensor can have together."""


@dataclass(frozen=True)
class Parameter:
    """A number of a sensor that is fitted."""

    path: str  # sensor and field: `skin.thickness`
    start: float  # its value in the document
    low: float  # least value, in the unit of the field
    high: float  # largest value
    unit: str  # unit of the field; empty if it has none
    is_log: bool  # whether its logarithm is searched

    def value(self, u: float) -> float:
        """Return the value at a place of the search, 0 at `low` and 1 at `high`."""
        u = min(max(u, 0.0), 1.0)
        if self.is_log:
            return float(self.low * (self.high / self.low) ** u)
        return float(self.low + (self.high - self.low) * u)

    def place(self, value: float) -> float:
        """Return the place of a value in the search."""
        if self.is_log:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)


class Model:
    """A document whose parameters can be changed."""

    def __init__(
        self, document: Document, fit: Sequence[str], overrides: Mapping[str, Any] | None = None, kinds: Sequence[Kind] = ()
    ):
        """Compile a document; `fit`: parameters as `sensor.field`, or with a range to search: `skin.thickness=1 mm:9 mm`.

        Raises:
            SpecError: All mistakes in the document.
            TgdslError: If a parameter does not exist, has no value to start from, or is no number.
        """
        self.document, self._overrides = document, dict(overrides or {})
        self._own_kinds, self._kinds = tuple(kinds), known_kinds(kinds)
        self._compile({})
        self.parameters = tuple(self._parameter(text) for text in fit)
        if twice := [p.path for p in self.parameters if sum(p.path == other.path for other in self.parameters) > 1]:
            raise TgdslError(f"{twice[0]} is to be fitted twice")
        self._values = tuple(parameter.start for parameter in self.parameters)

    def set(self, values: Sequence[float]) -> None:
        """Set the parameters' values; constants of a search's last steps are cached.

        Raises `InfeasibleError` if the sensor cannot have them.
        """
        values = tuple(map(float, values))
        if values == self._values:
            return
        constants = self._constants.get(values) or self._lowered(values)
        if constants is None:
            try:
                self._compile({f"sensors.{p.path}": value for p, value in zip(self.parameters, values, strict=True)})
            except SpecError as error:
                raise InfeasibleError(str(error)) from error
        else:
            while len(self._constants) > 2 * len(values) + 4:
                self._constants.pop(next(iter(self._constants)))
            self._constants[values] = constants
            for name, value in constants.items():
                self.module.constants.overwrite(name, value)
        self._values = values

    def predicted(self, recording: Recording, target: Target, fields: Mapping[str, np.ndarray], clock: float) -> np.ndarray:
        """Return the sensor's readings (sample, row, channel) for a target.

        `fields` are the recording's states, shifted by its nuisances; `clock` [s] is added to the target's times.
        """
        time = target.time if target.zero is None else np.union1d(target.time, [target.zero])
        missing = [name for name in DERIVED if name in self.module.inputs.fields and name not in fields]
        if missing:
            derived = velocities(recording.time, fields)
            fields = {**fields, **{name: derived[name] for name in missing}}
        states = recording.state_at(time + clock, fields)
        values = self._read(target.reading, states, time)[:, :, list(target.channels)]
        if target.zero is not None:
            values = (values - values[np.searchsorted(time, target.zero)])[np.searchsorted(time, target.time)]
        return values.sum(axis=1, keepdims=True) if target.is_sum else values

    def _read(self, reading: str, states: Mapping[str, np.ndarray], time: np.ndarray) -> np.ndarray:
        needed = self.module.inputs.fields
        used = {name: value for name, value in states.items() if name in needed}
        tensors: dict[str, Any] = {n: torch.from_numpy(v.astype(np.int64) if n in CHOICES else v) for n, v in used.items()}
        self.module.free()
        if not self.module.has_state and "dt" not in needed:
            return _rows(self.module(SceneState(**tensors))[reading])
        steps = np.diff(time, prepend=2 * time[0] - time[1] if len(time) > 1 else time[0] - 1.0)
        each = []
        for i, dt in enumerate(steps):
            now: dict[str, Any] = {name: value[i : i + 1] for name, value in tensors.items()}
            each.append(self.module(SceneState(**now, dt=float(dt)))[reading])
        return _rows(torch.cat(each))

    def _compile(self, changes: Mapping[str, Any]) -> None:
        self._constants: dict[tuple[float, ...], dict[str, np.ndarray]] = {}
        with warnings.catch_warnings():
            if changes:
                warnings.simplefilter("ignore")  # of intermediate values
            result = compile_document(self.document, {**self._overrides, **changes}, self._own_kinds)
        self._loaded, self._resolved, self.plan = result
        self.module = TactileModule(self.plan, self._kinds, torch.float64)
        kinds = {kind.name: kind for kind in self._kinds}
        self._kind_of = {name: kinds[spec.kind] for name, spec in self._loaded.spec.sensors.items()}  # type: ignore[attr-defined]
        self._compiled = {name: ways(self._loaded, self._resolved, name, kind, silent) for name, kind in self._kind_of.items()}

    def _lowered(self, values: Sequence[float]) -> dict[str, np.ndarray] | None:
        """Return the constants for other values, by the names of the plan; None: the document must be compiled again."""
        result = {}
        for name in dict.fromkeys(parameter.path.split(".")[0] for parameter in self.parameters):
            changes = {p.path: v for p, v in zip(self.parameters, values, strict=True) if p.path.split(".")[0] == name}
            spec = self._spec(name, changes)
            loaded = dataclasses.replace(
                self._loaded, spec=self._loaded.spec.model_copy(update={"sensors": {**self._loaded.spec.sensors, name: spec}})
            )
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                lowered = ways(loaded, self._resolved, name, self._kind_of[name], silent)
            if not _are_alike(lowered, self._compiled[name], self._kind_of[name]):
                return None
            for sensor in lowered:
                result |= _constants(sensor)
        return result

    def _spec(self, name: str, values: Mapping[str, float]) -> Any:
        """Return a sensor's spec with other values."""
        raw = self._loaded.source.get(("sensors", name))
        for path, value in values.items():
            raw = _with(raw, path.split(".")[1:], value)
        try:
            return type(self._loaded.spec.sensors[name]).model_validate(raw)
        except ValidationError as error:
            raise InfeasibleError(str(error.errors()[0]["msg"])) from error

    def _parameter(self, text: str) -> Parameter:
        path, span = (part.strip() for part in text.partition("=")[::2])
        sensor, *fields = path.split(".")
        specs = self._loaded.spec.sensors
        if sensor not in specs or not fields:
            hint = did_you_mean(sensor, specs, "sensors") if sensor not in specs else "such as skin.thickness"
            raise TgdslError(f"{path}: expected a sensor and a field; {hint}")
        value: Any = specs[sensor]
        annotation, metadata = None, ()
        for i, name in enumerate(fields):
            if value is None:
                raise TgdslError(f"{'.'.join([sensor, *fields[:i]])}: the document gives no value, expected one to start from")
            if not isinstance(value, BaseModel) or name not in type(value).model_fields:
                names_of_fields = list(type(value).model_fields) if isinstance(value, BaseModel) else []
                raise TgdslError(f'{path}: there is no field "{name}"; {did_you_mean(name, names_of_fields, "fields")}')
            info = type(value).model_fields[name]
            annotation, metadata, value = info.annotation, info.metadata, getattr(value, name)
        quantity = _mark(annotation, metadata)
        if quantity is None or isinstance(value, (tuple, list)):
            raise TgdslError(f"{path}: this is no number that can be fitted")
        if value is None:
            raise TgdslError(f"{path}: the document gives no value, expected one to start from")
        unit = next(iter(units.units_of(quantity.dimension)), "")
        usual = next((part for part in metadata if isinstance(part, Usual)), None)
        return _bounded(path, float(value), quantity, usual, span, unit)


def _rows(reading: torch.Tensor) -> np.ndarray:
    """Return a reading (sample, row, channel), its instants as rows."""
    return reading.reshape(len(reading), -1, reading.shape[-1]).numpy()


def _bounded(path: str, start: float, quantity: Quantity, usual: Usual | None, span: str, unit: str) -> Parameter:
    """Return a parameter with the user's bounds, or with bounds from its field."""
    least = next((bound for bound in (quantity.ge, quantity.gt) if bound is not None), -math.inf)
    most = math.inf if quantity.le is None else quantity.le
    of_unit = f" {unit}" if unit else ""
    if span:
        parts = span.split(":")
        if len(parts) != 2:
            raise TgdslError(f"{path}={span}: expected a range such as {path}={start:g}{of_unit}:{2 * start or 1:g}{of_unit}")
        try:
            low, high = (units.parse(part, quantity.dimension) for part in parts)
        except ValueError as error:
            raise TgdslError(f"{path}={span}: {error}") from error
        if not (least <= low < high <= most) or (low == 0 and quantity.gt == 0):
            raise TgdslError(f"{path}={span}: expected a range within {least:g} to {most:g}{of_unit}")
    else:
        usual_high = usual.high if usual is not None else math.inf
        reach = 10**DECADES * (abs(start) or 1.0)
        high = min(most, max(min(usual_high, reach), start))
        low = max(least, -reach)
        if quantity.gt == 0:
            low = min(max(usual.low if usual is not None else 0.0, start / 10**DECADES), start)
    if not low <= start <= high:
        raise TgdslError(f"{path}: the document's value {start:g}{of_unit} is out of the range {low:g} to {high:g}{of_unit}")
    return Parameter(path, start, low, high, unit, is_log=low > 0 and high / low > LOGARITHMIC)


def _mark(annotation: Any, metadata: Sequence[object]) -> Quantity | None:
    """Return the mark of a field that is a quantity, alone or as one of several types."""
    for part in (*metadata, *get_args(annotation)):
        if isinstance(part, Quantity):
            return part
        if (inner := _mark(part, ())) is not None:
            return inner
    return None


def _with(raw: Any, path: Sequence[str], value: float) -> Any:
    if not path:
        return value
    return {**(raw or {}), path[0]: _with((raw or {}).get(path[0]), path[1:], value)}


def _are_alike(one: Sequence[LoweredSensor], two: Sequence[LoweredSensor], kind: Kind) -> bool:
    if kind.fit is not None or len(one) != len(two):
        return False
    return all(_shape(first) == _shape(second) for first, second in zip(one, two, strict=True))


def _shape(sensor: LoweredSensor) -> object:
    lowered = sensor.lowered
    requests = [Request.key(request) for request in lowered.requests]  # all fields, also non-shared ones
    noise = None if sensor.noise is None else (sensor.noise.terms, sensor.noise.streams, sensor.noise.memory)
    constants = {name: value.shape for name, value in _constants(sensor).items()}
    return requests, lowered.state, lowered.timestep, noise, constants


def _constants(sensor: LoweredSensor) -> dict[str, np.ndarray]:
    """Return the constants of a sensor and of its noise, by the names that a plan gives them."""
    result = {f"sensors/{sensor.name}/{name}": value for name, value in sensor.lowered.constants.items()}
    if sensor.noise is not None:
        result |= {f"sensors/{sensor.name}/noise/{name}": value for name, value in sensor.noise.constants.items()}
    return result

"""The kinds that a document may use: of tgdsl, of installed packages, and of the caller.

A package brings a kind by an entry point, in its pyproject.toml:

    [project.entry-points."tgdsl.kinds"]
    my_kind = "my_package.my_kind:MY_KIND"
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tgdsl.errors import LowerError, TgdslError, did_you_mean
from tgdsl.files.plugins import Registry
from tgdsl.quantities import known_quantities
from tgdsl.quantities.base import Quantity, Request
from tgdsl.sensors import KINDS
from tgdsl.sensors.base import AnySensorSpec, Axis, Kind, Lowered, Memory
from tgdsl.sensors.upstream import SOUND

ARGUMENTS = {
    "lower": ("spec", "layout", "surface_of"),
    "forward": ("gathered", "context", "constants", "state"),
    "reference": ("spec", "layout", "gathered", "context", "state"),
    "decide": ("planes", "constants", "state"),
}
"""Arguments of a kind's functions, in order."""
FORMER = {"probes"}  # names of arguments from before kinds made requests


def kinds_by_sensor(kinds: Sequence[Kind], wanted: Mapping[str, str]) -> dict[str, Kind]:
    """Return the kind of each sensor.

    Args:
        kinds: All kinds.
        wanted: Name of each sensor's kind, by the sensor's name.

    Raises:
        TgdslError: If there is no such kind.
    """
    by_name = {kind.name: kind for kind in kinds}
    for sensor, name in wanted.items():
        if name not in by_name:
            hint = did_you_mean(name, by_name, "kinds")
            raise TgdslError(f'sensor "{sensor}" is of kind "{name}", which is neither installed nor given as `kinds`; {hint}')
    return {sensor: by_name[name] for sensor, name in wanted.items()}


def quantities_of(kinds: Sequence[Kind]) -> tuple[Quantity, ...]:
    """Return all quantities that kinds may request: the known ones, and those in `Kind.quantities`.

    Raises:
        TgdslError: If two quantities have one name.
    """
    quantities = {id(quantity): quantity for kind in kinds for quantity in kind.quantities}
    return known_quantities(tuple(quantities.values()))


def check_lowered(kind: Kind, lowered: Lowered, spec: AnySensorSpec) -> None:
    """Refuse a lowered sensor with reserved names, repeated requests, or options that a block does not have.

    Raises:
        TgdslError: If it is a mistake of the kind.
        LowerError: If it is a mistake of the document.
    """
    _check_parts(kind, lowered)
    channels = [*lowered.channels, *(lowered.signal or ()), *(c for report in lowered.reports.values() for c in report)]
    if any(channel.name == "signal" for channel in channels):
        problem = 'what `forward` returns as "signal" is all channels in one tensor'
        raise TgdslError(f'kind "{kind.name}" has a channel called "signal"; rename it: {problem}')
    for name, problem in (("signal", "the reading before its noise"), ("clean", "the reading without noise")):
        if name in lowered.reports:
            raise TgdslError(f'kind "{kind.name}" has a report called "{name}"; rename it: "<sensor>/{name}" is {problem}')
    types = [type(request) for request in lowered.requests]
    if twice := [kind.__name__ for kind in types if types.count(kind) > 1]:
        raise TgdslError(f'kind "{kind.name}" makes the request {twice[0]} twice; expected at most one of each type')
    if (lowered.substeps or lowered.samples) and not (lowered.substeps and not kind.knobs and kind.decide is None):
        problem = "a block of samples wants `substeps` above 0, `knobs=frozenset()` and no `decide`"
        raise TgdslError(f'kind "{kind.name}": {problem}: noise, rates and thresholds are of single readings')
    if lowered.substeps and (spec.rate is not None or spec.history is not None):
        field = "rate" if spec.rate is not None else "history"
        raise LowerError("this sensor reads a block of samples at each call", field, f"leave `{field}` out")
    if lowered.substeps and spec.readout == "both":
        raise LowerError("this sensor reads a block of samples, which has no noise", "readout", "leave `readout` out")
    if lowered.provides - kind.provides or bool(lowered.sound) != (lowered.provides >= SOUND):
        problem = f"it provides {', '.join(sorted(lowered.provides)) or 'nothing'}, {lowered.sound} samples of sound"
        raise TgdslError(
            f'kind "{kind.name}": {problem}; expected planes of `Kind.provides`, and samples if these are of sound'
        )
    if lowered.substeps and lowered.reports:
        raise TgdslError(f'kind "{kind.name}" has reports and reads blocks; a block has none')


def _check_parts(kind: Kind, lowered: Any) -> None:
    """Refuse parts of a lowered sensor that have another type."""

    def refuse(what: str, found: object, expected: str) -> None:
        text = found.__name__ if isinstance(found, type) else repr(found) if isinstance(found, str) else type(found).__name__
        raise TgdslError(f'kind "{kind.name}": {what}: found {text}, expected {expected}')

    if not isinstance(lowered, Lowered):
        refuse("`lower` returns", lowered, "a tgdsl.sensors.base.Lowered")
    if not isinstance(lowered.requests, (tuple, list)):
        refuse("requests", lowered.requests, "a tuple of them, `requests=(…,)`")
    for request in lowered.requests:
        if not isinstance(request, Request):
            refuse("requests", request, "requests, such as `ContactDepth(spec.objects)`")
    for name, value in lowered.constants.items():
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "biuf":
            refuse(f'constant "{name}"', value, "a NumPy array of numbers; `scalar` makes one of a number")
        if "." in name:
            raise TgdslError(f'kind "{kind.name}": the name of the constant "{name}" has a dot; expected none')
    for name, memory in lowered.state.items():
        if not isinstance(memory, Memory) or not (memory.shape is None or isinstance(memory.shape, (tuple, type))):
            shape = memory.shape if isinstance(memory, Memory) else memory
            refuse(f'state "{name}"', shape, "`Memory` with a tuple for its shape, None, or the type of a request of the kind")
        if isinstance(memory.shape, type):
            brought = {quantity.request: quantity for quantity in quantities_of((kind,))}
            quantity = brought.get(memory.shape)
            if not any(type(request) is memory.shape for request in lowered.requests):
                refuse(f'shape of the state "{name}"', memory.shape, "the type of a request that the kind makes")
            if quantity is not None and not quantity.has_rows:
                refuse(f'shape of the state "{name}"', memory.shape, "a request whose quantity has `num_rows`")
    if lowered.rows is None:
        return
    if not isinstance(lowered.rows, Axis):
        refuse("rows", lowered.rows, "an Axis, such as `body_axis(layout)`")
    for name, column in lowered.rows.table.items():
        if len(column) != lowered.rows.size:
            problem = f'the column "{name}" of its rows has {len(column)} entries, expected one for each of {lowered.rows.size}'
            raise TgdslError(f'kind "{kind.name}": {problem}')


def _wrong(kind: object) -> str:
    """Return why something is no kind that a document can name, or nothing."""
    if not isinstance(kind, Kind):
        return f"found {type(kind).__name__}, expected a tgdsl.sensors.Kind"
    field = kind.spec.model_fields.get("kind")
    names = getattr(field and field.annotation, "__args__", ())
    if len(names) != 1 or not isinstance(names[0], str):
        return f'the spec {kind.spec.__name__} has no field `kind: Literal["its_name"]`'
    if not isinstance(kind.quantities, (tuple, list)):
        return f'kind "{names[0]}": `quantities` is a {type(kind.quantities).__name__}, expected a tuple of them'
    calls = ((name, getattr(kind, name)) for name in ARGUMENTS)
    return next((wrong for name, call in calls if call is not None and (wrong := _wrong_call(names[0], name, call))), "")


def _wrong_call(kind: str, name: str, call: Any) -> str:
    """Return why a kind's function cannot be called as kinds are, or nothing."""
    arguments = ARGUMENTS[name]
    try:
        signature = inspect.signature(call)
    except (TypeError, ValueError):  # functions written in C may have none
        return "" if callable(call) else f'kind "{kind}": `{name}` is a {type(call).__name__}, expected a function'
    try:
        signature.bind(*arguments)
        fits = True
    except TypeError:
        fits = False
    if fits and not FORMER & set(list(signature.parameters)[: len(arguments)]):
        return ""
    result = ", ".join(signature.parameters)
    hint = "the CHANGELOG has the names from when kinds began to make requests"
    return f'kind "{kind}": found `{name}({result})`, expected `{name}({", ".join(arguments)})`; {hint}'


known_kinds = Registry("tgdsl.kinds", "sensor kind", "kinds", KINDS, _wrong).known
"""Returns all kinds: see `tgdsl.files.plugins.Registry.known`."""

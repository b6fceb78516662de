"""An account of a compiled module: computations, parts left out with reasons, and costs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Shaped

from tgdsl.errors import listed
from tgdsl.geometry.bvh import query_operations
from tgdsl.layout.layout import unfelt_ids
from tgdsl.module.memory import Memory
from tgdsl.module.outputs import outputs_of
from tgdsl.module.state import example_state
from tgdsl.observations.observations import PROPRIOCEPTION
from tgdsl.plan.plan import Plan
from tgdsl.plan.sensors import PlannedSensor
from tgdsl.quantities.base import Quantity
from tgdsl.sensors.noise.pipeline import stages_of
from tgdsl.sensors.noise.spec import quantity
from tgdsl.sensors.noise.stage import Number
from tgdsl.tensors.buffers import Constants
from tgdsl.tensors.torch_internals import TorchDispatchMode

# operations that compute nothing
_FREE = frozenset([
    "view", "select", "slice", "t", "transpose", "permute", "unsafe_view", "as_strided", "split", "split_with_sizes",
    "unsqueeze", "squeeze", "detach", "alias", "expand", "clone", "unbind", "to_copy",
])  # fmt: skip
_FFT = 2.5  # operations of a real fast Fourier transform of n numbers: this by n log2 n
MOST_LINKS = 4  # links that a line of noise names
_CLOCK_BYTES = 24  # three int64 of the clock for each environment, in addition to the ages of calls


class OperationCounter(TorchDispatchMode):
    """Counts the operations of an eager run.

    A matrix product counts its additions and multiplications, a Fourier transform of n numbers 2.5 n log2 n, a search for the
    nearest triangle `geometry.bvh.query_operations`; any other operation counts one for each element that it writes.

    Attributes:
        elements: Operations counted so far.
    """

    def __init__(self) -> None:
        from torch.utils.flop_counter import flop_registry  # which imports Triton

        super().__init__()
        self.elements = 0
        self._products: Mapping[Any, Callable[..., Any]] = flop_registry

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        self.elements += self._operations(func, args, kwargs or {}, result)
        return result

    def _operations(self, func: Any, args: Any, kwargs: Any, result: Any) -> int:
        name = func.__name__.split(".")[0].lstrip("_")
        written = [x for x in (result if isinstance(result, (tuple, list)) else [result]) if isinstance(x, torch.Tensor)]
        if name in _FREE or not written:
            return 0
        if func._overloadpacket in self._products:
            return int(self._products[func._overloadpacket](*args, **kwargs, out_val=result))
        if name == "mesh_distance":
            return query_operations(args[0], args[1], args[2])
        if name.startswith("fft_"):
            size = math.prod(max(args[0].shape[dim], written[0].shape[dim]) for dim in args[1])
            return int(_FFT * max(args[0].numel(), written[0].numel()) * math.log2(max(size, 2)))
        return written[0].numel()


class Explained(NamedTuple):
    """The parts of a module that its account describes."""

    plan: Plan
    quantities: tuple[Quantity, ...]
    constants: Constants
    memory: Memory
    core: Callable[[dict[str, torch.Tensor], dict[str, torch.Tensor]], Any]  # `TactileModule.core`


def operations_per_env(touch: Explained) -> int:
    """Return the number of elementary operations per environment, counted in an eager run: see `OperationCounter`."""
    counts = []
    for num_envs in (2, 4):
        state = example_state(touch.plan.inputs, num_envs, 0, torch.float64, 0.03).to(touch.constants.device)
        memory = Memory(touch.plan.sensors, touch.plan.readings())
        held = memory.tensors(num_envs, state.dt, touch.constants.dtype, touch.constants.device)
        tensors = {name: torch.as_tensor(getattr(state, name)) for name in touch.plan.inputs.fields}
        for i, part in enumerate(state.substeps):
            tensors |= {f"substep/{i}/{name}": getattr(part, name) for name in touch.plan.inputs.fields if name != "dt"}
        with torch.no_grad(), OperationCounter() as counter:
            touch.core(tensors, held)
        counts.append(counter.elements)
    return (counts[1] - counts[0]) // 2


def explain(touch: Explained) -> str:
    """Return the account as text."""
    plan = touch.plan
    lines = [f"{plan.origin.robot}{plan.origin.at_resolution}, {plan.layout.num_taxels} taxels"]
    lines += [f"taxels_id {plan.taxels_id}", ""] if plan.layout.num_taxels else [""]
    lines += [*_links(plan), "", "sensors", *(f"  {line}" for sensor in plan.sensors for line in _sensor(touch, sensor))]
    for requested in touch.quantities:
        for headline, account in requested.account(plan.quantities[requested.name], plan.objects).items():
            lines += ["", headline, *(f"  {line}" for line in account)]
    lines += ["", *_observations(plan), *_inputs(plan)]
    if plan.dropped:
        lines += ["left out", *(f"  {name}: {why}" for name, why in plan.dropped), ""]
    if plan.unfelt:
        lines += [f"{len(unfelt_ids(plan.unfelt))} taxels cannot feel", *(f"  {taxels}" for taxels in plan.unfelt), ""]
    return "\n".join(lines + _costs(touch))


def _asks(touch: Explained, sensor: PlannedSensor) -> list[str]:
    """Return a sensor's requests as text, equal ones once."""
    lines = []
    for requested in (each for each in touch.quantities if each.name in sensor.uses):
        use = sensor.uses[requested.name]
        sharing = [o.name for o in touch.plan.sensors if o is not sensor and o.uses.get(requested.name) == use]
        shared = f" (found once for {', '.join(sharing)} too)" if sharing else ""
        said = requested.explain(touch.plan.quantities[requested.name], use, touch.plan.objects)
        lines += [f"asks for {line}{shared}" for line in said]
    return lines


def _links(plan: Plan) -> list[str]:
    layout = plan.layout
    if not layout.links:
        return [f"bodies  {', '.join(dict.fromkeys(link.body for sensor in plan.sensors for link in sensor.links))}"]
    counts = {link.name: int((layout.link_id == i).sum()) for i, link in enumerate(layout.links)}
    groups = {group: sum(counts[name] for name in names) for group, names in layout.groups.items()}
    tables = {"taxels per link": counts, "taxels per group": groups}
    return [line for title, rows in tables.items() for line in (title, *(f"  {name:<34}{n:>6}" for name, n in rows.items()))]


def _sensor(touch: Explained, sensor: PlannedSensor) -> list[str]:
    count, rows = len(sensor.taxels) or len(sensor.links), sensor.readings[0].rows
    where = f"{count} {'taxels' if len(sensor.taxels) else 'joints' if rows == 'joint' else 'links'}" if count else "on no link"
    lines = [f"{sensor.name}: {sensor.kind}, {where}, {_remembers(touch, sensor)}"]
    for reading in sensor.readings:
        channels = ", ".join(f"{name} [{unit}]" for name, unit in zip(reading.channels, reading.units, strict=True))
        lines.append(f"  {reading.name}: {channels} of each {reading.rows}")
    lines += [f"  {line}" for line in (*_asks(touch, sensor), *sensor.notes)]
    if joined_names := [name for name in sensor.joined if name != sensor.name]:
        lines.append(f"  computed as one with {', '.join(joined_names)}")
    lines += [f"  noise: {line}" for line in _noise(touch, sensor)]
    if sensor.period > 0:
        lines.append(f"  rate: {1 / sensor.period:g} Hz")
    if sensor.history is not None:
        lines.append(f"  history: {sensor.history.reduce} of {sensor.history.length} calls")
    return lines


def _remembers(touch: Explained, sensor: PlannedSensor) -> str:
    """Return the state of a sensor between calls, and its size, without the shared clock."""
    fixed, ring = _sizes(touch, sensor)
    names = [name if "/" not in name else " ".join(name.split("/")[:2]) for name in sensor.state]
    if sensor.windows:
        names.append("history")
    if not names:
        return "remembers the clock alone" if sensor.wants_clock else "no state"
    reading = sensor.readings[0]
    size = f"({fixed} bytes per environment), {fixed / reading.num_rows:.3g} per {reading.rows}"
    if ring:
        past = max(memory.past for memory in sensor.state.values())
        size += f", and for each call of the last {past:g} s {ring} bytes, {ring / reading.num_rows:.3g} per {reading.rows}"
    return f"remembers {', '.join(dict.fromkeys(names))} {size}"


def _sizes(touch: Explained, sensor: PlannedSensor) -> tuple[int, int]:
    """Return the size of a sensor's state per environment, and additionally per call of its delay [bytes]."""
    size = torch.finfo(touch.constants.dtype).bits // 8
    fixed = size * sum(math.prod(memory.shape) for memory in sensor.state.values() if not memory.past)
    ring = size * sum(math.prod(memory.shape) for memory in sensor.state.values() if memory.past)
    steps = 0 if sensor.history is None else sensor.history.length
    windows = sum(steps * reading.num_rows * len(reading.channels) for reading in sensor.windows)
    return fixed + size * windows, ring


def _noise(touch: Explained, sensor: PlannedSensor) -> list[str]:
    """Return the stages of a sensor's noise, in their order, with the values of their knobs, and the rows that have them."""
    if sensor.noise is None:
        return []
    lines, constants = [], sensor.noise.constants
    for stage in stages_of(sensor.noise.terms):
        shown = {name: number for name, number in stage.numbers.items() if name in constants and number.label is not None}
        parts = [(name, [name]) for name in shown] if stage.is_split else [(stage.name, list(shown))]
        for term, names in parts:
            rows = _affected(constants, {name: shown[name] for name in names})
            texts = []
            for name in names:
                value, number = constants[name], shown[name]
                value = value if rows is None or value.shape[-1] == 1 else value[..., rows]
                label = "stuck at " if name == "dead_low" and "dead_high" not in constants else number.label
                texts.append(f"{label}{_amplitudes(sensor, value) if number.unit is None else _with_unit(value, number.unit)}")
            where = "" if rows is None else f"; {_rows(touch.plan, sensor, rows)}"
            lines.append(f"{term} {', '.join(texts)}{where}")
    return lines


def _affected(constants: Mapping[str, np.ndarray], numbers: Mapping[str, Number]) -> Bool[np.ndarray, " row"] | None:
    """Return in which rows numbers of a stage have an effect; None if they are all, or if none decides it."""
    has_effect = np.zeros(1, dtype=bool)
    for name, number in numbers.items():
        if number.neutral is not None:
            value = constants[name]
            has_effect = has_effect | (value != number.neutral).reshape(-1, value.shape[-1]).any(axis=0)
    return has_effect if has_effect.any() and not has_effect.all() else None


def _rows(plan: Plan, sensor: PlannedSensor, is_row: Bool[np.ndarray, " row"]) -> str:
    """Return how many rows of a reading these are, and their links where rows are taxels or bodies."""
    reading, layout, rows = sensor.readings[0], plan.layout_of(sensor), np.flatnonzero(is_row)
    name = reading.rows if len(is_row) == reading.num_rows else "taxel"  # probes of a kind that has rows of its own
    text = f"{len(rows)} of {len(is_row)} {'bodies' if name == 'body' else name + 's'}"
    if name == "taxel":
        links = [layout.links[i].name for i in np.unique(layout.link_id[rows])]
    elif name == "body" and len(layout.bodies) == len(is_row):
        links = [layout.bodies[i] for i in rows]
    else:
        return text
    return f"{text}: {listed(links, MOST_LINKS)}"


def _with_unit(value: Shaped[np.ndarray, "*end 1 row"], unit: str) -> str:
    return _value((100.0 * value if unit == " %" else value)[..., 0, :]) + unit


def _amplitudes(sensor: PlannedSensor, value: Shaped[np.ndarray, "*end channel row"]) -> str:
    """Return a knob's value for each quantity of a sensor's signal."""
    units = {name: f" {unit}" for r in sensor.readings for name, unit in zip(r.channels, r.units, strict=True)}
    amplitudes: dict[str, str] = {}
    for c, channel in enumerate(sensor.signal):
        channel_value = value[..., c if value.shape[-2] > 1 else 0, :]
        name = quantity(channel)
        amplitudes.setdefault(name, f"{name} {_value(channel_value)}{units.get(channel, '')}")
    return ", ".join(amplitudes.values())


def _value(value: Shaped[np.ndarray, "*end row"]) -> str:
    """Return a number; `[low, high]` if each environment draws its own; `least–most` where rows differ."""
    ends = [
        f"{end.min():g}" if end.min() == end.max() else f"{end.min():g}–{end.max():g}"
        for end in np.reshape(value, (-1, value.shape[-1]))
    ]
    return ends[0] if len(ends) == 1 else f"[{', '.join(ends)}]"


def _observations(plan: Plan) -> list[str]:
    groups: dict[str, list[str]] = {}
    for term in plan.observations:
        of = f" of {term.reading}" if term.reading not in (None, *PROPRIOCEPTION) else ""
        groups.setdefault(term.group, []).append(f"{term.type}{of} ({term.num_features})" if term.reading else term.type)
    return ["observations", *(f"  {group}: {', '.join(terms)}" for group, terms in groups.items()), ""] if groups else []


def _inputs(plan: Plan) -> list[str]:
    inputs = plan.inputs
    contacts = {**inputs.contacts_of, **inputs.link_parts}
    geoms_of = [(name, ", ".join(f"{part.kind} {part.name}" for part in parts)) for name, parts in contacts.items()]
    names = {"heated": inputs.heated, "joints": inputs.joints, "actuators": inputs.actuators}
    return [
        *("inputs wanted", f"  fields  {', '.join(inputs.fields)}", f"  bodies  {', '.join(inputs.bodies)}"),
        *([f"  pairs   {', '.join(f'{pair.link} – {pair.object}' for pair in inputs.pairs)}"] if inputs.pairs else []),
        *(f"  contacts with {name} are those on {geoms}" for name, geoms in geoms_of),
        *([f"  slots   {inputs.slots} contacts of each pair"] if inputs.slots else []),
        *(f"  {axis}  {', '.join(axis_names)}" for axis, axis_names in names.items() if axis_names),
        "",
    ]


def _costs(touch: Explained) -> list[str]:
    size = torch.finfo(touch.constants.dtype).bits // 8
    outputs = sum(math.prod(output.shape) for output in outputs_of(touch.plan))
    state = example_state(touch.plan.inputs, 1, 0, torch.float64, 0.03)
    sizes = [_sizes(touch, sensor) for sensor in touch.plan.sensors]
    fixed = sum(state_bytes for state_bytes, _ in sizes) + (_CLOCK_BYTES if touch.memory.clock.is_wanted else 0)
    ring = sum(ring_bytes for _, ring_bytes in sizes)
    ring_text = f", and {ring} for each call of the delays" if ring else ""
    read = sum(getattr(state, n).numel() * 8 for n in touch.plan.inputs.fields if n != "dt")
    constants = sum(buffer.numel() * buffer.element_size() for buffer in touch.constants.buffers())
    return [
        "cost per environment",
        f"  reads        {read:>10} bytes (float64 state)",
        f"  writes       {size * outputs:>10} bytes of readings",
        f"  remembers    {fixed:>10} bytes{ring_text}",
        f"  computes     {operations_per_env(touch):>10} elementary operations",
        f"constants      {constants:>12} bytes, once",
    ]

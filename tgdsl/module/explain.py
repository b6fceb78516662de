"""An account of a compiled module: what it computes, what it left out and why, and what that costs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Shaped

from tgdsl.module.memory import Memory
from tgdsl.module.module import TactileModule
from tgdsl.observations.proprioception import QUANTITIES
from tgdsl.plan.plan import PlannedObject, PlannedPoints, PlannedSensor
from tgdsl.sensors.noise.lower import quantity
from tgdsl.tensors.torch_internals import TorchDispatchMode


class _OperationCounter(TorchDispatchMode):
    """Counts the elements that pointwise and matrix operations write: what an eager run computes."""

    FREE = frozenset(
        [
            "view",
            "select",
            "slice",
            "t",
            "transpose",
            "unsqueeze",
            "squeeze",
            "detach",
            "alias",
            "expand",
            "clone",
            "unbind",
            "to_copy",
        ]
    )

    def __init__(self) -> None:
        super().__init__()
        self.elements = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        name = func.__name__.split(".")[0].lstrip("_")
        if isinstance(result, torch.Tensor) and name not in self.FREE:
            self.elements += result.numel()
        return result


def operations_per_env(touch: TactileModule) -> int:
    """Return how many elementary operations one environment takes, counted in an eager run."""
    counts = []
    for num_envs in (2, 4):
        state = touch.example_state(num_envs)
        memory = Memory(touch.plan.sensors).tensors(num_envs, state.dt, touch.dtype, touch.device)
        tensors = {name: torch.as_tensor(getattr(state, name)) for name in touch.inputs.fields}
        with torch.no_grad(), _OperationCounter() as counter:
            touch.core(tensors, memory)
        counts.append(counter.elements)
    return (counts[1] - counts[0]) // 2


def explain(touch: TactileModule) -> str:
    """Return the account as text."""
    plan = touch.plan
    lines = [f"{plan.origin.robot} at resolution {plan.origin.resolution}, {plan.layout().num_taxels} taxels", ""]
    lines += _links(touch) + [""]
    lines += ["sensors"]
    lines += [f"  {line}" for sensor in plan.sensors for line in _sensor(touch, sensor)]
    lines += _grids(touch) + _fields(touch)
    lines += ["", "queries (each measures its probes once, whatever number of sensors they serve)"]
    for i, query in enumerate(plan.queries):
        against = ", ".join(_felt(plan.objects[o]) for o in query.objects) or "nothing"
        lines.append(f"  {i}: {query.num_taxels} probes against {against}")
        for a, answer in enumerate(query.answers):
            users = ", ".join(sensor.name for sensor in plan.sensors if (sensor.query, sensor.answer) == (i, a))
            gate = "where MuJoCo has the pair in contact" if answer.is_gated else "wherever a probe reaches"
            extra = " with " + " and ".join(answer.needs) if answer.needs else ""
            what = f"depth{extra}, {gate}" if answer.objects else " and ".join(answer.needs)
            lines.append(f"    {users}: {what}")
            if answer.points is not None:
                lines += [f"      {line}" for line in _points(touch, answer.points)]
    lines += [""] + _observations(touch) + _inputs(touch)
    lines += ["left out"] + [f"  {what}: {why}" for what, why in plan.dropped] if plan.dropped else []
    lines += [""] if plan.dropped else []
    return "\n".join(lines + _costs(touch))


def _felt(target: PlannedObject) -> str:
    variants = [f"{target.num_variants} variants"] if target.num_variants > 1 else []
    size = ["its size given per environment"] if target.is_sized else []
    return f"{target.name} ({', '.join([*target.shapes, *variants, *size])})"


def _points(touch: TactileModule, points: PlannedPoints) -> list[str]:
    """Return which links the points of each object are measured against."""
    plan, lines = touch.plan, []
    assert plan.skin is not None
    for o, links in zip(points.objects, points.links, strict=True):
        lines.append(
            f"{points.num_points} points of {plan.objects[o].name} against {', '.join(plan.skin.links[i] for i in links)}"
        )
    return lines


def _links(touch: TactileModule) -> list[str]:
    plan = touch.plan
    layout = plan.layout()
    counts = {link.name: int((layout.link_id == i).sum()) for i, link in enumerate(layout.links)}
    lines = ["taxels per link"] + [f"  {name:<34}{count:>6}" for name, count in counts.items()]
    lines += ["taxels per group"]
    return lines + [f"  {group:<34}{sum(counts[name] for name in names):>6}" for group, names in plan.groups.items()]


def _sensor(touch: TactileModule, sensor: PlannedSensor) -> list[str]:
    taxels = sensor.rows[1] - sensor.rows[0]
    lines = [f"{sensor.name}: {sensor.kind}, {taxels} taxels, query {sensor.query}, {_remembers(touch, sensor)}"]
    for reading in sensor.readings:
        channels = ", ".join(f"{name} [{unit}]" for name, unit in zip(reading.channels, reading.units, strict=True))
        lines.append(f"  {reading.name}: {channels} of each {reading.rows}")
    lines += [f"  {note}" for note in sensor.notes]
    if others := [name for name in sensor.joined if name != sensor.name]:
        lines.append(f"  computed as one with {', '.join(others)}")
    lines += [f"  noise: {line}" for line in _noise(touch, sensor)]
    if sensor.period > 0:
        lines.append(f"  rate: {1 / sensor.period:g} Hz")
    if sensor.history is not None:
        lines.append(f"  history: {sensor.history.reduce} of {sensor.history.length} calls")
    return lines


def _remembers(touch: TactileModule, sensor: PlannedSensor) -> str:
    """Return what a sensor carries from one call to the next, and its size; the clock, which all share, is not in it."""
    fixed, ring = _sizes(touch, sensor)
    own = [name if "/" not in name else " ".join(name.split("/")[:2]) for name in sensor.state]
    if sensor.windows:
        own.append("history")
    if not own:
        return "remembers the clock alone" if sensor.is_timed else "no state"
    reading = sensor.readings[0]
    size = f"({fixed} bytes per environment), {fixed / reading.num_rows:.3g} per {reading.rows}"
    if ring:
        past = max(memory.past for memory in sensor.state.values())
        size += f", and for each call of the last {past:g} s {ring} bytes, {ring / reading.num_rows:.3g} per {reading.rows}"
    return f"remembers {', '.join(dict.fromkeys(own))} {size}"


def _sizes(touch: TactileModule, sensor: PlannedSensor) -> tuple[int, int]:
    """Return what a sensor remembers of each environment, and of each call of its delay beside [bytes]."""
    size = torch.finfo(touch.dtype).bits // 8
    fixed = size * sum(math.prod(memory.shape) for memory in sensor.state.values() if not memory.past)
    ring = size * sum(math.prod(memory.shape) for memory in sensor.state.values() if memory.past)
    steps = 0 if sensor.history is None else sensor.history.length
    windows = sum(steps * reading.num_rows * len(reading.channels) for reading in sensor.windows)
    return fixed + size * windows, ring


_OF_READING = "unit of the reading"
_KNOBS: dict[str, tuple[tuple[str, str, str], ...]] = {
    "radius_noise": (("radius_noise", "", " m"),),
    "gain": (("gain_low", "from ", ""), ("gain_high", "to ", "")),
    "hysteresis": (("hysteresis_strength", "strength ", ""), ("hysteresis_time", "time constant ", " s")),
    "crosstalk": (("crosstalk_strength", "strength ", ""),),
    "delay": (("delay", "", " s"), ("jitter", "jitter ", " s")),
    "bias": (("bias", "", _OF_READING),),
    "white_noise": (("white_noise", "", _OF_READING),),
    "drift": (("drift", "", _OF_READING),),
    "quantization": (("quantization", "", _OF_READING),),
    "dead": (
        ("dead_probability", "probability ", ""),
        ("dead_low", "stuck from ", _OF_READING),
        ("dead_high", "to ", _OF_READING),
    ),
    "release_threshold": (("release_threshold", "", " m"),),
}
"""Of each stage its constants, what they are called, and their unit."""


def _noise(touch: TactileModule, sensor: PlannedSensor) -> list[str]:
    """Return the stages of a sensor's noise, in their order, with the values of their knobs."""
    if sensor.noise is None:
        return []
    lines = []
    for term in sensor.noise.terms:
        parts = []
        for name, label, unit in (part for part in _KNOBS[term] if part[0] in sensor.noise.constants):
            value = touch.plan.arrays[f"sensors/{sensor.name}/noise/{name}"]
            if name == "dead_low" and "dead_high" not in sensor.noise.constants:
                label = "stuck at "
            shown = _amplitudes(sensor, value) if unit == _OF_READING else _value(value[..., 0, :]) + unit
            parts.append(label + shown)
        lines.append(f"{term} {', '.join(parts)}")
    return lines


def _amplitudes(sensor: PlannedSensor, value: Shaped[np.ndarray, "*end channel row"]) -> str:
    """Return a knob's value for each quantity of a sensor's signal."""
    units = {name: f" {unit}" for r in sensor.readings for name, unit in zip(r.channels, r.units, strict=True)}
    shown: dict[str, str] = {}
    for c, channel in enumerate(sensor.signal):
        own = value[..., c if value.shape[-2] > 1 else 0, :]
        name = quantity(channel)
        shown.setdefault(name, f"{name} {_value(own)}{units.get(channel, '')}")
    return ", ".join(shown.values())


def _value(value: Shaped[np.ndarray, "*end row"]) -> str:
    """Return a number; `[low, high]` if each environment draws its own; `least–most` where rows differ."""
    ends = [
        f"{end.min():g}" if end.min() == end.max() else f"{end.min():g}–{end.max():g}"
        for end in np.reshape(value, (-1, value.shape[-1]))
    ]
    return ends[0] if len(ends) == 1 else f"[{', '.join(ends)}]"


def _grids(touch: TactileModule) -> list[str]:
    """Return what was measured of each baked grid."""
    lines, plan = [], touch.plan
    for target in plan.objects:
        for variant, row in enumerate(target.accuracy):
            name = f"{target.name}, variant {variant}" if target.num_variants > 1 else target.name
            for i, accuracy in enumerate(row):
                lines += _grid(touch, name, f"objects/{target.name}", target.shapes, variant, i, accuracy)
    for variant, (link, row) in enumerate(zip(plan.skin.links, plan.skin.accuracy, strict=True) if plan.skin else ()):
        for i, accuracy in enumerate(row):
            lines += _grid(touch, f"link {link}", "links", plan.skin.shapes if plan.skin else (), variant, i, accuracy)
    return ["", "meshes", *lines] if lines else []


def _grid(
    touch: TactileModule, name: str, path: str, shapes: Sequence[str], variant: int, i: int, accuracy: Mapping[str, float]
) -> list[str]:
    if not accuracy:
        return []
    num = touch.plan.arrays[f"{path}/{i}/num"][variant]
    return [
        f"  {name}, geom {i}: {shapes[i]} grid of {' × '.join(map(str, num))} nodes every "
        f"{1e3 * accuracy['cell']:.3g} mm, {4 * int(num.prod())} bytes",
        f"    distance: 99 % within {1e3 * accuracy['p99']:.3g} mm (asked: {1e3 * accuracy['tolerance']:.3g} "
        f"mm), largest error {1e3 * accuracy['max']:.3g} mm; near sharp edges "
        f"{1e3 * accuracy['edge_max']:.3g} mm",
    ]


def _fields(touch: TactileModule) -> list[str]:
    """Return what was measured of each field of moments."""
    lines: dict[str, None] = {}
    for moments in (answer.moments for query in touch.plan.queries for answer in query.answers if answer.moments):
        for o, radii, row in zip(moments.objects, moments.radii, moments.accuracy, strict=True):
            target = touch.plan.objects[o]
            for i, accuracy in enumerate(row):
                path = f"objects/{target.name}/moments/{moments.request}"
                num = touch.plan.arrays[f"{path}/num"][i]
                size = touch.plan.arrays[f"{path}/values"][0].nbytes * int(num.prod())
                which = f"variant {i // len(radii)}, " if target.num_variants > 1 else ""
                nodes = f"{' × '.join(map(str, num))} nodes every {1e3 * accuracy['cell']:.3g} mm, {size} bytes"
                s0, s0_max, s1, s1_max = (
                    f"{100 * accuracy[key]:.2g} %" for key in ("mass_rms", "mass_max", "first_rms", "first_max")
                )
                what = (
                    f"  {target.name}, {which}radius {1e3 * accuracy['radius']:.3g} mm: {nodes}\n"
                    f"    RMS error of S0 {s0} of full scale (largest {s0_max}), of S1 {s1} (largest {s1_max})"
                    + _gradients(accuracy)
                )
                lines[what] = None
    return ["", "fields of moments", *lines] if lines else []


def _gradients(accuracy: Mapping[str, float]) -> str:
    """Return what was measured of a field's gradients by place, if it was."""
    if "gradient_p999" not in accuracy:
        return ""
    p999, largest, first = (f"{100 * accuracy[key]:.2g} %" for key in ("gradient_p999", "gradient_max", "first_gradient_p999"))
    return f"\n    gradients: 99.9 % of S0's within {p999} of the largest (largest error {largest}), of S1's within {first}"


def _observations(touch: TactileModule) -> list[str]:
    groups: dict[str, list[str]] = {}
    for term in touch.plan.observations:
        of = f" of {term.reading}" if term.reading not in (None, *QUANTITIES) else ""
        what = f"{term.type}{of} ({term.num_features})" if term.reading else term.type
        groups.setdefault(term.group, []).append(what)
    if not groups:
        return []
    return ["observations"] + [f"  {group}: {', '.join(terms)}" for group, terms in groups.items()] + [""]


def _inputs(touch: TactileModule) -> list[str]:
    inputs = touch.inputs
    lines = ["inputs wanted", f"  fields  {', '.join(inputs.fields)}", f"  bodies  {', '.join(inputs.bodies)}"]
    if inputs.pairs:
        lines.append(f"  pairs   {', '.join(f'{pair.link} – {pair.object}' for pair in inputs.pairs)}")
    for name, parts in inputs.contacts_of.items():
        lines.append(f"  contacts with {name} are those on {', '.join(f'{part.kind} {part.name}' for part in parts)}")
    if inputs.slots:
        lines.append(f"  slots   {inputs.slots} contacts of each pair")
    if inputs.joints:
        lines.append(f"  joints  {', '.join(inputs.joints)}")
    if inputs.actuators:
        lines.append(f"  actuators  {', '.join(inputs.actuators)}")
    return [*lines, ""]


_CLOCK_BYTES = 24
"""What the clock holds of each environment beside the ages of calls: three int64, see `clock.Clock`."""


def _costs(touch: TactileModule) -> list[str]:
    size = torch.finfo(touch.dtype).bits // 8
    outputs = sum(math.prod(output.shape) for output in touch.outputs)
    state = touch.example_state(1)
    sizes = [_sizes(touch, sensor) for sensor in touch.plan.sensors]
    fixed = sum(own for own, _ in sizes) + (_CLOCK_BYTES if touch.memory.clock.is_wanted else 0)
    ring = sum(own for _, own in sizes)
    beside = f", and {ring} for each call of the delays" if ring else ""
    read = sum(getattr(state, n).numel() * 8 for n in touch.inputs.fields if n != "dt")
    constants = sum(buffer.numel() * buffer.element_size() for buffer in touch.constants.buffers())
    return [
        "cost per environment",
        f"  reads        {read:>10} bytes (float64 state)",
        f"  writes       {size * outputs:>10} bytes of readings",
        f"  remembers    {fixed:>10} bytes{beside}",
        f"  computes     {operations_per_env(touch):>10} elementary operations",
        f"constants      {constants:>12} bytes, once",
    ]

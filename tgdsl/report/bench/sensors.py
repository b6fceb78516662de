"""A sensor in all its variants: error, time and bytes on recorded states.

Shapes: `step` calls, `env` environments, `row` rows of a reading, `channel` numbers per row.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tgdsl.compiler.pipeline import Document, compile_plan
from tgdsl.console.progress import Progress, silent
from tgdsl.errors import TgdslError
from tgdsl.module.accuracy.errors import Magnitude, errors_of, magnitude_of
from tgdsl.module.accuracy.reference import ReferenceModule
from tgdsl.module.accuracy.states import readings_of, rows_at, taken
from tgdsl.module.accuracy.variants import Variant, Variants, bare, queried_objects, variants_of
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SHAPES, SceneState
from tgdsl.plan.plan import Plan
from tgdsl.report.bench.front import front_of
from tgdsl.report.bench.recording import Recording
from tgdsl.report.bench.results import Cost, Measured, Subject
from tgdsl.report.bench.timing import times_of
from tgdsl.schema.load import load
from tgdsl.schema.objects import query_alternatives
from tgdsl.sensors.base import AnySensorSpec, Kind
from tgdsl.sensors.known import known_kinds
from tgdsl.sensors.noise.lower import quantity

CHECKED_STEPS, CHECKED_ENVS = 6, 2
"""States on which the finest variant is compared with the kind's float64 definition: the last of the recording."""


@dataclass(frozen=True)
class Options:
    """How sensors are measured.

    Attributes:
        device: Where.
        num_envs: Environments of timed calls.
        repeats: Timed calls of each variant.
        compiled: Whether modules are compiled by torch before they are timed.
        seed: Of bootstraps, and of which states are timed.
    """

    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    num_envs: tuple[int, ...] = (256,)
    repeats: int = 11
    compiled: bool = False
    seed: int = 0


class Way(NamedTuple):
    """A variant in one precision."""

    variant: Variant
    plan: Plan
    precision: str

    @property
    def name(self) -> str:
        """What to call it."""
        return f"{self.variant.label}, {self.precision}"


@dataclass(frozen=True)
class Sensor:
    """A sensor of a document, without imperfections, and how its variants are compiled."""

    document: Document
    overrides: Mapping[str, Any]
    name: str
    kind: Kind
    spec: AnySensorSpec
    own: Plan
    variants: Variants
    others: Mapping[str, tuple[Kind, AnySensorSpec]]
    """Kind and spec of all sensors that its plan has: those that it reads, and itself."""

    @staticmethod
    def of(document: Document, overrides: Mapping[str, Any], name: str) -> Sensor:
        """Return a sensor of a document.

        Raises:
            SpecError: What is wrong with the document.
        """
        changed = {**overrides, **bare(name)}
        loaded = load(document, changed, known_kinds())
        own, kinds = _plan(document, changed, name), {kind.name: kind for kind in known_kinds()}
        others = {s.sensor: (kinds[s.kind], loaded.spec.sensors[s.sensor]) for s in own.sensors}
        kind, spec = others[name]
        queried = {target: loaded.spec.objects[target] for target in queried_objects(own)}
        variants = variants_of(kind, name, spec, queried, query_alternatives())
        return Sensor(document, changed, name, kind, spec, own, variants, others)

    def plan(self, variant: Variant) -> Plan:
        """Return the Plan of a variant.

        Raises:
            TgdslError: If it cannot be had.
        """
        return _plan(self.document, {**self.overrides, **variant.changes}, self.name) if variant.changes else self.own


def _plan(document: Document, overrides: Mapping[str, Any], name: str) -> Plan:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what the document's own compilation has warned of already
        return compile_plan(document, overrides, sensors=[name])


def measure(sensor: Sensor, recording: Recording, options: Options, progress: Progress = silent) -> Subject:
    """Return a sensor in all its variants.

    Errors are those of all readings of the recorded states against the finest variant in float64. The front is drawn from the
    environments of even number; those of odd number verify it.

    Args:
        sensor: The sensor.
        recording: States of the document's scene.
        options: How to measure.
        progress: Is told what is done.

    Raises:
        StateError: If the states are of another document.
    """
    plans, left_out = _plans(sensor, progress)
    finest = _finest(sensor, plans)
    states = recording.for_module(sensor.own.inputs)
    own = TactileModule(sensor.own, known_kinds(), torch.float64)
    progress(f"{sensor.name}: {finest.label}, float64")
    fine = TactileModule(sensor.plan(finest), known_kinds(), torch.float64)
    exact = taken(readings_of(fine, recording.for_module(fine.inputs), sensor.name), rows_at(own, fine, sensor.name))
    channels = own.plan.readings()[sensor.name].channels
    magnitude = magnitude_of(exact, [quantity(channel) for channel in channels])
    ways = [Way(variant, plan, "float32") for variant, plan in plans.items()]
    more = ["float64", "bfloat16 readings", *(["tf32"] if options.device.type == "cuda" else [])]
    ways += [Way(sensor.variants.own, sensor.own, precision) for precision in more]
    measured = [_errors(sensor, way, own, recording, exact, magnitude, options, progress) for way in ways]
    times = {num: _times(ways, recording, num, sensor.name, options, progress) for num in options.num_envs}
    points = [
        dataclasses.replace(point, times={num: times[num][way.name] for num in times})
        for way, point in zip(ways, measured, strict=True)
    ]
    is_on_front = front_of([(point.time, point.chosen.rms) for point in points])
    return Subject(
        name=sensor.name,
        kind=sensor.kind.name,
        reference=f"{finest.label}, float64",
        check=_check(sensor, states),
        magnitudes=_magnitudes(own, sensor.name, magnitude),
        points=tuple(dataclasses.replace(p, is_on_front=f) for p, f in zip(points, is_on_front, strict=True)),
        left_out=tuple(left_out),
    )


def _plans(sensor: Sensor, progress: Progress) -> tuple[dict[Variant, Plan], list[tuple[str, str]]]:
    """Return the Plans of the variants that can be had, and why the others cannot."""
    plans, left_out = {sensor.variants.own: sensor.own}, []
    for variant in (*sensor.variants.fields, *sensor.variants.queries):
        if variant.is_own:
            continue
        progress(f"{sensor.name}: {variant.label}")
        try:
            plans[variant] = sensor.plan(variant)
        except TgdslError as error:
            left_out.append((variant.label, str(error)))
    return plans, left_out


def _finest(sensor: Sensor, plans: Mapping[Variant, Plan]) -> Variant:
    """Return the finest variant: of its fields and of its queries the last that can be had."""
    last = [
        next((variant for variant in reversed(axis) if variant.is_own or variant in plans), None)
        for axis in (sensor.variants.fields, sensor.variants.queries)
    ]
    found = [variant for variant in last if variant is not None]
    if not found:
        return sensor.variants.own
    return found[0] if len(found) == 1 else found[0].joined(found[1])


def _built(way: Way, device: torch.device) -> TactileModule:
    return TactileModule(way.plan, known_kinds(), torch.float64 if way.precision == "float64" else torch.float32).to(device)


@contextmanager
def _precision(way: Way) -> Iterator[None]:
    """Allow matrix products in TF32 where that is asked for."""
    before = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = way.precision == "tf32"
    try:
        yield
    finally:
        torch.backends.cuda.matmul.allow_tf32 = before


def _errors(
    sensor: Sensor,
    way: Way,
    own: TactileModule,
    recording: Recording,
    exact: np.ndarray,
    magnitude: Magnitude,
    options: Options,
    progress: Progress,
) -> Measured:
    """Return a variant with its errors and its counted cost, but no times."""
    progress(f"{sensor.name}: {way.name}, errors")
    touch = _built(way, options.device)
    with _precision(way):
        found = readings_of(touch, recording.for_module(touch.inputs), sensor.name)
    if way.precision == "bfloat16 readings":
        found = torch.from_numpy(found).to(torch.bfloat16).double().numpy()
    found = taken(found, rows_at(own, touch, sensor.name))
    chosen, verified = (
        errors_of(found[:, i::2], exact[:, i::2], magnitude._replace(active=magnitude.active[:, i::2]), seed=options.seed)
        for i in (0, 1)
    )
    size = 2 if way.precision == "bfloat16 readings" else torch.finfo(touch.dtype).bits // 8
    is_own = way.variant.is_own and way.precision == "float32"
    return Measured(way.variant.label, way.precision, is_own, chosen, verified, {}, _cost(touch, size))


def _cost(touch: TactileModule, size: int) -> Cost:
    """Return what a module takes, counted; its state is that of a single call."""
    state = touch.example_state(2)
    with torch.no_grad():
        touch(state)
    kept = sum(buffer.numel() * buffer.element_size() for buffer in touch.memory.buffers()) // 2
    touch.free()
    return Cost(
        operations=touch.operations_per_env(),
        constants=sum(buffer.numel() * buffer.element_size() for buffer in touch.constants.buffers()),
        state=kept,
        output=size * sum(int(np.prod(output.shape)) for output in touch.outputs),
    )


def _times(
    ways: Sequence[Way], recording: Recording, num_envs: int, name: str, options: Options, progress: Progress
) -> dict[str, Any]:
    """Return the median time of a call of each variant [s], by its name."""
    progress(f"{name}: timing {len(ways)} variants, {num_envs} environments")
    calls = {way.name: _call(way, recording, num_envs, name, options) for way in ways}
    return times_of(calls, options.repeats, options.device)


def _call(way: Way, recording: Recording, num_envs: int, name: str, options: Options) -> Callable[[], Tensor]:
    touch = _built(way, options.device)
    state = some_of(recording.for_module(touch.inputs), num_envs, options.seed).to(options.device)
    if options.compiled:
        touch.compile()

    def call() -> Tensor:
        with _precision(way):
            reading = touch(state)[name]
        return reading.to(torch.bfloat16) if way.precision == "bfloat16 readings" else reading

    return call


def some_of(states: Sequence[SceneState], num_envs: int, seed: int) -> SceneState:
    """Return a state of any number of environments: drawn from those of some states, at any step."""
    num = len(states) * (0 if states[0].body_pos is None else states[0].body_pos.shape[0])
    chosen = torch.from_numpy(np.random.default_rng(seed).integers(num, size=num_envs))
    values: dict[str, Any] = {}
    for name in SHAPES:
        if getattr(states[0], name) is not None:
            values[name] = torch.cat([getattr(state, name) for state in states])[chosen]
    parts = [some_of(part, num_envs, seed) for part in zip(*(state.substeps for state in states), strict=True)]
    return SceneState(**values, dt=states[0].dt, substeps=tuple(parts))


def _check(sensor: Sensor, states: Sequence[SceneState]) -> str:
    """Return how far the document's own variant in float64 is from the kind's float64 definition."""
    if queried_objects(sensor.own):
        return "the kind's definition knows primitives alone, and meshes are felt"
    few = [first_envs(state, CHECKED_ENVS) for state in states[-CHECKED_STEPS:]]
    touch = TactileModule(sensor.own, known_kinds(), torch.float64)
    reference, expected = ReferenceModule(sensor.own, sensor.kind, sensor.spec, sensor.others, sensor.name), []
    for state in few:
        reading, memory = reference(state, np.zeros(3))
        reference.remember(memory)
        expected.append(reading.reshape(reading.shape[0], -1, reading.shape[-1]))
    exact = np.stack(expected)
    magnitude = magnitude_of(exact, [quantity(channel) for channel in touch.plan.readings()[sensor.name].channels])
    largest = errors_of(readings_of(touch, few, sensor.name), exact, magnitude).largest.value
    return f"as written, float64 differs from the kind's NumPy definition by {largest:.1e} at most ({len(few)} steps)"


def first_envs(state: SceneState, count: int) -> SceneState:
    """Return the first environments of a state."""
    values: dict[str, Any] = {name: value[:count] for name in SHAPES if (value := getattr(state, name)) is not None}
    return SceneState(**values, dt=state.dt, substeps=tuple(first_envs(part, count) for part in state.substeps))


def _magnitudes(touch: TactileModule, name: str, magnitude: Magnitude) -> dict[str, str]:
    """Return the magnitude of each quantity of a sensor, with its unit."""
    output = touch.plan.readings()[name]
    named = zip(output.channels, output.units, magnitude.scale, strict=True)
    return {quantity(channel): f"{scale:.4g} {unit}" for channel, unit, scale in named}

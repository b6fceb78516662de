"""A sensor in all its variants: error, time and bytes on recorded states.

Shapes: `step` calls, `env` environments, `row` rows of a reading, `channel` numbers per row.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tgdsl.console.progress import Progress, silent
from tgdsl.errors import TgdslError
from tgdsl.module.accuracy.errors import errors_of, halves, magnitude_of
from tgdsl.module.accuracy.reference import ReferenceModule
from tgdsl.module.accuracy.states import common_of, only, readings_of
from tgdsl.module.accuracy.variants import Variant, queried_objects
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SHAPES, SceneState
from tgdsl.plan.plan import Plan
from tgdsl.report.bench.results import Measured, Subject, with_front
from tgdsl.report.bench.timing import times_of
from tgdsl.sensors.known import known_kinds
from tgdsl.sensors.noise.spec import quantity
from tgdsl.tuning.recording import Recording
from tgdsl.tuning.trials import Exact, Sensor, cost_of, exact_of, finest_of

CHECKED_STEPS, CHECKED_ENVS = 6, 2
"""States on which the finest variant is compared with the kind's float64 definition: the last of the recording."""


@dataclass(frozen=True)
class Options:
    """How sensors are measured."""

    device: torch.device = field(default_factory=lambda: torch.device("cpu"))  # where
    num_envs: tuple[int, ...] = (256,)  # environments of timed calls
    repeats: int = 11  # timed calls of each variant
    compiled: bool = False  # whether modules are compiled by torch before they are timed
    seed: int = 0  # of bootstraps, and of which states are timed


class Way(NamedTuple):
    """A variant in one precision."""

    variant: Variant
    plan: Plan
    precision: str

    @property
    def name(self) -> str:
        """What to call it."""
        return f"{self.variant.label}, {self.precision}"


def measure(sensor: Sensor, recording: Recording, options: Options, progress: Progress = silent) -> Subject:
    """Return a sensor in all its variants.

    Errors are those of all readings of the recorded states against the finest variant in float64. The front is drawn from the
    first half of the environments; the others verify it.

    Args:
        sensor: The sensor.
        recording: States of the document's scene.
        options: How to measure.
        progress: Called with a line of text for each long job.

    Raises:
        StateError: If the states are of another document.
    """
    plans, left_out = _plans(sensor, progress)
    states = recording.for_module(sensor.own.inputs)
    exact = exact_of(sensor, finest_of(sensor, left_out), recording, progress)
    ways = [Way(variant, plan, "float32") for variant, plan in plans.items()]
    more = ["float64", "bfloat16 readings", *(["tf32"] if options.device.type == "cuda" else [])]
    ways += [Way(sensor.variants.own, sensor.own, precision) for precision in more]
    measured = [_errors(sensor, way, recording, exact, options, progress) for way in ways]
    times = {}
    for num in options.num_envs:
        progress(f"{sensor.name}: timing {len(ways)} variants, {num} environments")
        calls = {way.name: _call(way, recording, num, sensor.name, options) for way in ways}
        times[num] = times_of(calls, options.repeats, options.device)
    points = [
        dataclasses.replace(point, times={num: times[num][way.name] for num in times})
        for way, point in zip(ways, measured, strict=True)
    ]
    named = zip(exact.quantities, exact.units, exact.magnitude.scale, strict=True)
    return Subject(
        name=sensor.name,
        kind=sensor.kind.name,
        reference=f"{exact.variant.label}, float64",
        check=_check(sensor, states),
        magnitudes={name: f"{scale:.4g} {unit}" for name, unit, scale in named},
        points=with_front(points),
        left_out=tuple(left_out.items()),
    )


def _plans(sensor: Sensor, progress: Progress) -> tuple[dict[Variant, Plan], dict[str, str]]:
    """Return the Plans of the variants that can be had, and why the others cannot."""
    plans, left_out = {sensor.variants.own: sensor.own}, {}
    for variant in (*sensor.variants.fields, *sensor.variants.queries):
        if variant.is_own:
            continue
        progress(f"{sensor.name}: {variant.label}")
        try:
            plans[variant] = sensor.plan(variant)
        except TgdslError as error:
            left_out[variant.label] = str(error)
    return plans, left_out


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


def _errors(sensor: Sensor, way: Way, recording: Recording, exact: Exact, options: Options, progress: Progress) -> Measured:
    """Return a variant with its errors and its counted cost, but no times."""
    progress(f"{sensor.name}: {way.name}, errors")
    touch = _built(way, options.device)
    with _precision(way):
        readings = readings_of(touch, recording.for_module(touch.inputs), sensor.name)
    if way.precision == "bfloat16 readings":
        readings = torch.from_numpy(readings).to(torch.bfloat16).double().numpy()
    common = common_of(exact.module, touch, sensor.name)
    readings, expected = common.of_other(readings), common.of_one(exact.readings)
    magnitude, channels = exact.magnitude._replace(active=common.of_one(exact.magnitude.active)), range(readings.shape[-1])
    chosen, verified = (
        errors_of(readings[:, half], expected[:, half], magnitude.of(half, channels), seed=options.seed)
        for half in halves(recording.num_envs)
    )
    size = 2 if way.precision == "bfloat16 readings" else torch.finfo(touch.dtype).bits // 8
    is_own = way.variant.is_own and way.precision == "float32"
    return Measured(way.variant.label, way.precision, is_own, chosen, verified, {}, cost_of(touch, size))


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
    few = [only(state, slice(CHECKED_ENVS)) for state in states[-CHECKED_STEPS:]]
    touch = TactileModule(sensor.own, known_kinds(), torch.float64)
    reference, expected = ReferenceModule(sensor.own, sensor.kind, sensor.spec, sensor.others, sensor.name), []
    for state in few:
        reading, memory = reference(state, np.zeros(3))
        reference.remember(memory)
        expected.append(reading.reshape(reading.shape[0], -1, reading.shape[-1]))
    exact = np.stack(expected)
    magnitude = magnitude_of(exact, [quantity(channel) for channel in sensor.reading.channels])
    largest = errors_of(readings_of(touch, few, sensor.name), exact, magnitude).largest.value
    return f"as written, float64 differs from the kind's NumPy definition by {largest:.1e} at most ({len(few)} steps)"

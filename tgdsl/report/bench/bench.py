"""A document's sensors and physics in all variants: error, time and bytes on states of its scene.

Shapes: `step` calls, `env` environments, `row` rows of a reading, `channel` numbers per row.
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from tgdsl.compiler.pipeline import Document, compile_document
from tgdsl.console.progress import Progress, silent
from tgdsl.errors import TgdslError, did_you_mean
from tgdsl.module.accuracy.errors import errors_of, halves, magnitude_of
from tgdsl.module.accuracy.reference import ReferenceModule
from tgdsl.module.accuracy.states import common_of, only, readings_of
from tgdsl.module.accuracy.variants import Variant, bare, queried_objects
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SHAPES, SceneState
from tgdsl.plan.plan import Plan
from tgdsl.report.bench.physics import measure_physics
from tgdsl.report.bench.results import Measured, Report, Subject, times_of, with_front
from tgdsl.runtime.rollout import script_of
from tgdsl.sensors.known import known_kinds
from tgdsl.sensors.noise.spec import quantity
from tgdsl.tuning.choose import choose
from tgdsl.tuning.recording import Recording, load_recording, record, save_recording
from tgdsl.tuning.trials import Exact, Sensor, cost_of, exact_of, finest_of

PHYSICS = "physics"  # what the physics is called among the sensors
# states on which the finest variant is compared with the kind's float64 definition: the last of the recording
CHECKED_STEPS, CHECKED_ENVS = 6, 2


@dataclass(frozen=True)
class Options:
    """How sensors are measured."""

    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    num_envs: tuple[int, ...] = (256,)  # environments of timed calls
    repeats: int = 11  # timed calls of each variant
    compiled: bool = False  # whether modules are compiled by torch before they are timed
    seed: int = 0  # seed of bootstraps and of the choice of timed states


@dataclass(frozen=True)
class Bench:
    """A document and what to measure of it."""

    document: Document
    overrides: Mapping[str, Any] = field(default_factory=dict)
    sensors: tuple[str, ...] = ()  # sensors to measure, and `physics`; empty: all
    states: Path | None = None  # file of states; None: a scripted run
    save_states: Path | None = None  # file to which the run's states are written; None: no file
    state_envs: int = 16  # environments of the scripted run; half of them verify
    steps: int = 90  # its control steps, approximately
    substeps: int = 5  # physics steps of each
    options: Options = field(default_factory=Options)


class Way(NamedTuple):
    """A variant in one precision."""

    variant: Variant
    plan: Plan
    precision: str

    @property
    def name(self) -> str:
        """Label and precision."""
        return f"{self.variant.label}, {self.precision}"

    def module(self, device: torch.device) -> TactileModule:
        """Return its module."""
        dtype = torch.float64 if self.precision == "float64" else torch.float32
        return TactileModule(self.plan, known_kinds(), dtype).to(device)

    @contextmanager
    def matmul(self) -> Iterator[None]:
        """Allow TF32 matrix products if that is the precision."""
        previous = torch.backends.cuda.matmul.allow_tf32
        torch.backends.cuda.matmul.allow_tf32 = self.precision == "tf32"
        try:
            yield
        finally:
            torch.backends.cuda.matmul.allow_tf32 = previous


def bench(what: Bench, progress: Progress = silent, begun: Callable[[int, int], None] | None = None) -> Report:
    """Measure; `begun` is called at the start of each subject with the number of finished subjects and of all.

    Raises:
        SpecError: The document's mistakes.
        StateError: If the states are of another document.
        SimulationError: If the scene cannot be simulated.
        TgdslError: If there is no such sensor, or a number is out of range.
    """
    options = what.options
    if not options.num_envs or min(options.num_envs) < 1:
        counts = ", ".join(map(str, options.num_envs)) or "none"
        raise TgdslError(f"environments that are timed: found {counts}, expected numbers of at least 1")
    if options.repeats < 1:
        raise TgdslError(f"timed calls: found {options.repeats}, expected at least 1")
    progress("compiling")
    choice = choose(what.document, what.overrides, progress=progress)
    touch = TactileModule(compile_document(what.document, what.overrides, progress=progress, choice=choice).plan, known_kinds())
    resolved = replace(what, overrides={**what.overrides, **choice.changes})
    sensors = tuple(dict.fromkeys(sensor.sensor for sensor in touch.plan.sensors))
    names = _subject_names(resolved.sensors, sensors)
    recording = _recording(resolved, sensors, progress)
    subjects: list[Subject] = []
    for name in names:
        if begun is not None:
            begun(len(subjects), len(names))
        if name == PHYSICS:
            script = script_of(touch, progress=progress)
            run = (resolved.state_envs, resolved.steps, resolved.substeps, options.seed)
            subject = measure_physics(touch.plan, script, *run, progress)
        else:
            subject = measure(Sensor.of(resolved.document, resolved.overrides, name), recording, options, progress)
        subjects.append(replace(subject, chosen=choice.notes.get(name, ())))
    if begun is not None:
        begun(len(names), len(names))
    title = str(what.document) if not isinstance(what.document, Mapping) else "<mapping>"
    return Report(title, _machine(options.device), recording.source, tuple(subjects))


def _subject_names(requested: Collection[str], sensors: Sequence[str]) -> list[str]:
    """Return the names of the subjects to measure, in the document's order."""
    names = [*sensors, *([] if PHYSICS in sensors else [PHYSICS])]
    for name in requested:
        if name not in names:
            raise TgdslError(f'there is no sensor "{name}"; {did_you_mean(name, names, "sensors")}')
    return [name for name in names if not requested or name in requested]


def _recording(what: Bench, names: Sequence[str], progress: Progress) -> Recording:
    """Return states with the fields of all sensors without imperfections."""
    if what.states is not None:
        return load_recording(what.states)
    changes = {key: value for name in names for key, value in bare(name).items()}
    touch = TactileModule(compile_document(what.document, {**what.overrides, **changes}).plan, known_kinds())
    run: dict[str, Any] = {"steps": what.steps, "substeps": what.substeps, "seed": what.options.seed}
    recording = record(touch, what.state_envs, **run, progress=progress)
    if what.save_states is not None:
        save_recording(recording, what.save_states)
    return recording


def _machine(device: torch.device) -> str:
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or platform.machine()
    threads = "" if device.type == "cuda" else f", {torch.get_num_threads()} threads"
    return f"{where}{threads}, torch {torch.__version__}"


def measure(sensor: Sensor, recording: Recording, options: Options, progress: Progress = silent) -> Subject:
    """Return a sensor in all its variants.

    Errors are over all readings of the recorded states, against the finest variant in float64. The front is drawn from the
    first half of the environments; the other half verifies it.
    """
    plans, left_out = {sensor.variants.own: sensor.own}, {}
    for variant in (*sensor.variants.fields, *sensor.variants.queries):
        if not variant.is_own:
            progress(f"{sensor.name}: {variant.label}")
            if sensor.has(variant, left_out):
                plans[variant] = sensor.plan(variant)
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
        replace(point, times={num: times[num][way.name] for num in times}) for way, point in zip(ways, measured, strict=True)
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


def _errors(sensor: Sensor, way: Way, recording: Recording, exact: Exact, options: Options, progress: Progress) -> Measured:
    """Return a variant with its errors and its counted cost, without times."""
    progress(f"{sensor.name}: {way.name}, errors")
    touch = way.module(options.device)
    with way.matmul():
        readings = readings_of(touch, recording.for_module(touch.inputs), sensor.name)
    if way.precision == "bfloat16 readings":
        readings = torch.from_numpy(readings).to(torch.bfloat16).double().numpy()
    common = common_of(exact.module, touch, sensor.name)
    readings, expected = common.of_other(readings), common.of_one(exact.readings)
    magnitude, channels = exact.magnitude._replace(active=common.of_one(exact.magnitude.active)), range(readings.shape[-1])
    drawn, verified = (
        errors_of(readings[:, half], expected[:, half], magnitude.of(half, channels), seed=options.seed)
        for half in halves(recording.num_envs)
    )
    size = 2 if way.precision == "bfloat16 readings" else torch.finfo(touch.dtype).bits // 8
    is_own = way.variant.is_own and way.precision == "float32"
    return Measured(way.variant.label, way.precision, is_own, drawn, verified, {}, cost_of(touch, size))


def _call(way: Way, recording: Recording, num_envs: int, name: str, options: Options) -> Callable[[], Tensor]:
    touch = way.module(options.device)
    state = some_of(recording.for_module(touch.inputs), num_envs, options.seed).to(options.device)
    if options.compiled:
        touch.compile()

    def call() -> Tensor:
        with way.matmul():
            reading = touch(state)[name]
        return reading.to(torch.bfloat16) if way.precision == "bfloat16 readings" else reading

    return call


def some_of(states: Sequence[SceneState], num_envs: int, seed: int) -> SceneState:
    """Return a state of any number of environments, drawn from all environments and steps of some states."""
    num = len(states) * (0 if states[0].body_pos is None else states[0].body_pos.shape[0])
    ids = torch.from_numpy(np.random.default_rng(seed).integers(num, size=num_envs))
    values: dict[str, Any] = {}
    for name in SHAPES:
        if getattr(states[0], name) is not None:
            values[name] = torch.cat([getattr(state, name) for state in states])[ids]
    parts = [some_of(part, num_envs, seed) for part in zip(*(state.substeps for state in states), strict=True)]
    return SceneState(**values, dt=states[0].dt, substeps=tuple(parts))


def _check(sensor: Sensor, states: Sequence[SceneState]) -> str:
    """Return the difference of the document's variant in float64 from the kind's float64 definition, as text."""
    if queried_objects(sensor.own):
        return "not compared with the kind's definition, which supports primitives only: the sensor reads meshes"
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

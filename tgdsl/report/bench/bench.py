"""A document's sensors and physics in all variants, on states of its scene."""

from __future__ import annotations

import platform
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from tgdsl.compiler.pipeline import Document, compile_document
from tgdsl.console.progress import Progress, silent
from tgdsl.errors import TgdslError, did_you_mean
from tgdsl.module.accuracy.variants import bare
from tgdsl.module.module import TactileModule
from tgdsl.report.bench.physics import measure_physics
from tgdsl.report.bench.results import Report, Subject
from tgdsl.report.bench.sensors import Options, measure
from tgdsl.runtime.rollout import script_of
from tgdsl.sensors.known import known_kinds
from tgdsl.tuning.choose import choose
from tgdsl.tuning.recording import Recording, load_recording, record, save_recording
from tgdsl.tuning.trials import Sensor

PHYSICS = "physics"  # what the physics is called among the sensors


@dataclass(frozen=True)
class Bench:
    """What is measured."""

    document: Document  # a YAML file, or the same as a mapping
    overrides: Mapping[str, Any] = field(default_factory=dict)  # by dotted path YAML text, or a plain value
    sensors: tuple[str, ...] = ()  # sensors, and `physics`, that are measured; empty: all
    states: Path | None = None  # file of states; None: a scripted run
    save_states: Path | None = None  # file that the states of the run are written to; None: none
    state_envs: int = 16  # environments of the scripted run; half of them verify
    steps: int = 90  # its control steps, about
    substeps: int = 5  # physics steps of each
    options: Options = field(default_factory=Options)  # how sensors are measured


def bench(what: Bench, progress: Progress = silent, begun: Callable[[int, int], None] | None = None) -> Report:
    """Measure.

    Args:
        what: What is measured.
        progress: Called with a line of text for each long job.
        begun: Is told how much is done of how much, each time that something is.

    Raises:
        SpecError: What is wrong with the document.
        StateError: If the states are of another document.
        SimulationError: If the scene cannot be simulated.
        TgdslError: If there is no such sensor, or a number is none that can be measured with.
    """
    _check(what.options)
    progress("compiling")
    choice = choose(what.document, what.overrides, progress=progress)
    touch = TactileModule(compile_document(what.document, what.overrides, progress=progress, choice=choice).plan, known_kinds())
    what = replace(what, overrides={**what.overrides, **choice.changes})
    names = tuple(dict.fromkeys(sensor.sensor for sensor in touch.plan.sensors))
    wanted = _wanted(what.sensors, names)
    recording = _recording(what, names, progress)
    subjects: list[Subject] = []
    for name in wanted:
        if begun is not None:
            begun(len(subjects), len(wanted))
        subject = _subject(what, name, touch, recording, progress)
        subjects.append(replace(subject, chosen=choice.notes.get(name, ())))
    if begun is not None:
        begun(len(wanted), len(wanted))
    title = str(what.document) if not isinstance(what.document, Mapping) else "<mapping>"
    return Report(title, _machine(what.options.device), recording.source, tuple(subjects))


def _subject(what: Bench, name: str, touch: TactileModule, recording: Recording, progress: Progress) -> Subject:
    if name == PHYSICS:
        script = script_of(touch, progress=progress)
        return measure_physics(touch.plan, script, what.state_envs, what.steps, what.substeps, what.options.seed, progress)
    return measure(Sensor.of(what.document, what.overrides, name), recording, what.options, progress)


def _recording(what: Bench, names: Sequence[str], progress: Progress) -> Recording:
    """Return states of all fields that any sensor wants without its imperfections."""
    if what.states is not None:
        return load_recording(what.states)
    changes = {key: value for name in names for key, value in bare(name).items()}
    touch = TactileModule(compile_document(what.document, {**what.overrides, **changes}).plan, known_kinds())
    recording = record(
        touch, what.state_envs, steps=what.steps, substeps=what.substeps, seed=what.options.seed, progress=progress
    )
    if what.save_states is not None:
        save_recording(recording, what.save_states)
    return recording


def _check(options: Options) -> None:
    if not options.num_envs or min(options.num_envs) < 1:
        counts = ", ".join(map(str, options.num_envs)) or "none"
        raise TgdslError(f"environments that are timed: found {counts}, expected numbers of at least 1")
    if options.repeats < 1:
        raise TgdslError(f"timed calls: found {options.repeats}, expected at least 1")


def _wanted(sensors: Collection[str], names: Sequence[str]) -> list[str]:
    """Return what is measured, in the document's order."""
    known = [*names, *([] if PHYSICS in names else [PHYSICS])]
    for name in sensors:
        if name not in known:
            raise TgdslError(f'there is no sensor "{name}"; {did_you_mean(name, known, "sensors")}')
    return [name for name in known if not sensors or name in sensors]


def _machine(device: torch.device) -> str:
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or platform.machine()
    threads = "" if device.type == "cuda" else f", {torch.get_num_threads()} threads"
    return f"{where}{threads}, torch {torch.__version__}"

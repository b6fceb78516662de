"""Chooses what sensors with an `accuracy` leave open: the cheapest that holds it on states of the document's scene."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from tgdsl.compiler.pipeline import Choice, Document, compile_document
from tgdsl.console.progress import Progress, silent
from tgdsl.errors import LowerError, SpecError, TgdslError, listed
from tgdsl.fields.accuracy import Accuracy
from tgdsl.files.cache import cached
from tgdsl.files.find import is_file
from tgdsl.module.accuracy.variants import bare, is_taken
from tgdsl.module.module import TactileModule
from tgdsl.schema.load import Loaded, load
from tgdsl.schema.objects import query_alternatives
from tgdsl.sensors import Kind
from tgdsl.sensors.known import known_kinds
from tgdsl.tuning.recording import Recording, record
from tgdsl.tuning.trials import (
    Level,
    Outcome,
    Places,
    Sensor,
    Trial,
    brief,
    cheapest,
    level_of,
    shown,
    shown_errors,
    written_fields,
)


class Shared(NamedTuple):
    """How sensors share objects."""

    places: Places  # index of the way in which distances to each object are computed
    alone: Mapping[str, Places]  # the places that each sensor alone would choose
    floors: Places  # places of objects that sensors without an accuracy sense too


FORMAT = 2  # version of the choosing
ENVS, STEPS = 16, 90
"""Environments of the run (more if objects have more variants; one half chooses, the other verifies), and control steps."""


class Task(NamedTuple):
    """A document to compile, and its sensors with an `accuracy`."""

    document: Document
    overrides: Mapping[str, Any]
    kinds: Sequence[Kind]
    sensors: Collection[str] | None
    loaded: Loaded
    wanted: Mapping[str, Accuracy]
    progress: Progress


def choose(
    document: Document,
    overrides: Mapping[str, Any] | None = None,
    kinds: Sequence[Kind] = (),
    progress: Progress | None = None,
    sensors: Collection[str] | None = None,
) -> Choice:
    """Return the choice for the sensors of a document that have an `accuracy`.

    A variant meets it if the RMS error of each quantity, against the finest variant in float64, is within the bound: with 95 %
    confidence in one half of the environments of a scripted run, and as measured in the other half, which only verifies. The
    variant with the fewest counted operations wins, then the one with the fewest bytes. The choice is cached.

    Args:
        document: The document.
        overrides: By dotted path YAML text, or a plain value. Values set there count as written.
        kinds: Kinds in addition to tgdsl's and installed packages'.
        progress: Called with a line of text for each long job.
        sensors: Names of the sensors to compile; default: all.

    Raises:
        SpecError: If the document has mistakes, or nothing meets an `accuracy`.
    """
    if not _is_asked(document, overrides):
        return Choice()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its warnings appear when it is compiled
        task = task_of(document, overrides, kinds, progress, sensors)
        return cached(key_of(task), lambda: _measured_choice(task), packed, unpacked) if task.wanted else Choice()


def _is_asked(document: Document, overrides: Mapping[str, Any] | None) -> bool:
    """Return whether a document may have an `accuracy`, without parsing it; an unreadable document has none."""
    if any("accuracy" in path or _names_accuracy(value) for path, value in (overrides or {}).items()):
        return True
    if isinstance(document, (str, PathLike)):
        return is_file(Path(document)) and b"accuracy" in Path(document).read_bytes()
    return _names_accuracy(document)


def _names_accuracy(value: object, depth: int = 3) -> bool:
    """Return whether text holds the word, or a mapping the key: no deeper than `sensors`, their names and their keys."""
    if isinstance(value, str):
        return "accuracy" in value
    if not isinstance(value, Mapping) or depth == 0:
        return False
    return "accuracy" in value or any(_names_accuracy(part, depth - 1) for part in value.values())


def task_of(
    document: Document,
    overrides: Mapping[str, Any] | None = None,
    kinds: Sequence[Kind] = (),
    progress: Progress | None = None,
    sensors: Collection[str] | None = None,
) -> Task:
    """Return the choices to make: see `choose`."""
    loaded = load(document, overrides, known_kinds(kinds), sensors=sensors)
    accuracies = {name: spec.accuracy for name, spec in loaded.spec.sensors.items() if spec.accuracy is not None}
    return Task(document, overrides or {}, kinds, sensors, loaded, accuracies, progress or silent)


def key_of(task: Task) -> str:
    """Return a hash of everything that decides a choice: the document's plan, requested accuracies, and free choices."""
    unchosen = Choice(notes=dict.fromkeys(task.wanted, ()))
    plan = compile_document(task.document, task.overrides, task.kinds, task.progress, task.sensors, unchosen).plan
    blank = dataclasses.replace(plan.origin, document_sha256="")
    specs = {"sensors": task.loaded.spec.sensors, "objects": task.loaded.spec.objects}
    written = {f"{part}.{name}": sorted(spec.model_fields_set) for part, each in specs.items() for name, spec in each.items()}
    kinds = {kind.name: kind for kind in known_kinds(task.kinds)}
    tuned = {name: task.loaded.spec.sensors[name] for name in task.wanted}
    alternatives = {name: kinds[spec.kind].alternatives(spec) for name, spec in tuned.items()}  # type: ignore[attr-defined]
    parts = [FORMAT, ENVS, STEPS, dataclasses.replace(plan, origin=blank).to_json(), repr(task.wanted), written, alternatives]
    parts += [query_alternatives(), {name: version(name) for name in ("tgdsl", "torch", "mujoco")}]
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=repr).encode()).hexdigest()


def packed(choice: Choice) -> dict[str, np.ndarray]:
    """Return the arrays of a choice for a cache file."""
    text = json.dumps({"changes": dict(choice.changes), "notes": dict(choice.notes)})
    return {"choice": np.frombuffer(text.encode(), dtype=np.uint8)}


def unpacked(arrays: Mapping[str, np.ndarray]) -> Choice:
    """Return the choice that `packed` packed."""
    result = json.loads(arrays["choice"].tobytes())
    return Choice(result["changes"], {name: tuple(lines) for name, lines in result["notes"].items()})


class Found(NamedTuple):
    """The choice for a sensor."""

    trial: Trial
    outcome: Outcome
    level: Level


def _measured_choice(task: Task) -> Choice:
    """Measure and choose: for each sensor alone, then with objects as fine as the strictest sensor needs."""
    recording, floors = _states(task), _floors(task.loaded, task.wanted)

    def by_itself(name: str) -> Found:
        sensor = Sensor.of(task.document, task.overrides, name, task.kinds)
        trial = Trial(sensor, task.wanted[name], recording, task.progress)
        return Found(trial, *cheapest(trial, trial.fields(), trial.levels(floors)))

    result = _each(task, list(task.wanted), by_itself)
    alone = {name: best.level.places for name, best in result.items()}
    places: dict[str, int] = {}
    for sensor_places in alone.values():
        places |= {target: max(place, places.get(target, place)) for target, place in sensor_places.items()}

    def with_others(name: str) -> Found:
        trial, level = result[name].trial, level_of({target: places[target] for target in alone[name]})
        return Found(trial, *cheapest(trial, trial.fields(), [level]))

    moved = [name for name, ways in alone.items() if any(places[target] != place for target, place in ways.items())]
    result |= _each(task, moved, with_others)
    changes = {key: value for best in result.values() for key, value in best.outcome.variant.changes.items()}
    shared = Shared(places, alone, floors)
    return Choice(changes, {name: account(best.trial, best.outcome, shared) for name, best in result.items()})


def _each(task: Task, names: Sequence[str], work: Callable[[str], Found]) -> dict[str, Found]:
    """Return the result of `work` for each sensor; raise the mistakes of all sensors together."""
    result, problems = {}, []
    for name in names:
        try:
            result[name] = work(name)
        except LowerError as error:
            problems.append(task.loaded.problem(("sensors", name, "accuracy"), error.what, error.hint))
    if problems:
        raise SpecError(problems)
    return result


def _floors(loaded: Loaded, wanted: Collection[str]) -> Places:
    """Return the distance query of each object that sensors without an accuracy sense too: no coarser one is chosen."""
    felt = {target for name, spec in loaded.spec.sensors.items() if name not in wanted for target in spec.objects}
    alternatives = query_alternatives()
    result = {}
    for target in sorted(felt & loaded.spec.objects.keys()):
        ways = [i for i, other in enumerate(alternatives) if is_taken(loaded.spec.objects[target], other)]
        result |= {target: ways[0]} if ways else {}
    return result


def _states(task: Task) -> Recording:
    """Return states of a run of the scene, with all fields that the sensors without imperfections read."""
    changes = {key: value for name in task.wanted for key, value in bare(name).items()}
    plan = compile_document(task.document, {**task.overrides, **changes}, task.kinds, task.progress, list(task.wanted)).plan
    inputs = plan.inputs
    num_envs = max([ENVS, *(2 * num for num in (*inputs.num_variants, *inputs.num_materials))])
    touch = TactileModule(plan, known_kinds(task.kinds), torch.float32)
    try:
        return record(touch, num_envs, steps=STEPS, progress=task.progress)
    except TgdslError as error:
        problem, hint = f"there are no states to measure errors on: {error}", "take it out, or give a scene that can be run"
        places = [("sensors", name, "accuracy") for name in task.wanted]
        raise SpecError([task.loaded.problem(place, problem, hint) for place in places]) from error


def account(trial: Trial, own: Outcome, shared: Shared) -> tuple[str, ...]:
    """Return the account of a sensor: the choice, its measured errors, and the reason, line by line."""
    exact, written = trial.exact, written_fields(trial)
    lines = [shown_errors(trial, own)]
    for (name, errors), bound in zip(own.chosen.items(), trial.bounds.values(), strict=True):
        lines.append(f"{name}: 99 % within {shown(errors.p99, bound)}, largest {shown(errors.largest.value, bound)}")
    scales = zip(exact.quantities, exact.magnitude.scale.tolist(), exact.units, strict=True)
    changes = {name: f"{name} {scale:.3g}{'' if unit == '1' else f' {unit}'}" for name, scale, unit in scales}
    where = f"on a {trial.recording.source}; largest changes: {', '.join(changes.values())}"
    lines.append(f"against {exact.variant.label} in float64, {where}")
    lines.append(f"cheapest by count: {own.cost.operations} operations, {own.cost.constants} bytes of constants")
    failed = sorted((other for other in trial.outcomes.values() if not other.is_held), key=_cost)
    worst = [f"{other.variant.label} ({brief(max(other.excess, other.verified_excess))} times the bound)" for other in failed]
    lines += [f"not within it: {', '.join(worst)}"] if worst else []
    lines += [f"object {target}: {why}" for target, why in _reasons(trial.sensor.name, shared).items()]
    lines += [f"left as written: {', '.join(written)}"] if written else []
    return (f"accuracy {trial.accuracy}: {own.variant.label}", *(f"  {line}" for line in lines))


def _reasons(sensor: str, shared: Shared) -> dict[str, str]:
    """Return why objects have finer queries than a sensor alone needs."""
    result = {}
    for target, place in shared.alone[sensor].items():
        tied = [name for name, places in shared.alone.items() if places.get(target) == shared.places[target]]
        if place < shared.places[target]:
            result[target] = f"as fine as {listed(tied)} needs"
        elif shared.floors.get(target) == place:
            result[target] = "no coarser than written, as sensors without an accuracy feel it too"
    return result


def _cost(outcome: Outcome) -> tuple[int, int]:
    return outcome.cost.operations or 0, outcome.cost.constants

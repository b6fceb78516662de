"""Chooses what sensors with an `accuracy` leave open: the cheapest that holds it on states of the document's scene."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import warnings
from collections.abc import Collection, Mapping, Sequence
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np
import torch

from tgdsl.compiler.choice import Choice
from tgdsl.compiler.pipeline import Document, compile_plan
from tgdsl.console.progress import Progress, silent
from tgdsl.errors import LowerError, Problem, SimulationError, SpecError, listed
from tgdsl.fields.accuracy import Accuracy
from tgdsl.files.cache import cached
from tgdsl.module.accuracy.variants import Variant, bare, is_taken
from tgdsl.module.module import TactileModule
from tgdsl.schema.load import load
from tgdsl.schema.loaded import Loaded
from tgdsl.schema.objects import query_alternatives
from tgdsl.sensors import Kind
from tgdsl.sensors.known import known_kinds
from tgdsl.tuning.recording import Recording, record
from tgdsl.tuning.trial import Level, Outcome, Places, Trial, brief, cheapest, level_of, shown, shown_errors, written_fields
from tgdsl.tuning.trials import Sensor

FORMAT = 1
"""Version of how choices are made."""
ENVS, STEPS = 16, 90
"""Environments of the run, of which half choose and half verify (more where objects have more variants), and control steps."""


class Task(NamedTuple):
    """A document that is compiled, and the sensors in it that have an `accuracy`."""

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
    """Return what is chosen for the sensors of a document that have an `accuracy`.

    A variant holds it if the RMS error of each quantity, against the finest variant in float64, is within the bound: with 95 %
    confidence in one half of the environments of a scripted run, and as measured in the other half, which takes no part. Of
    those the one of fewest counted operations is taken, then of fewest bytes. What is chosen is kept in the cache.

    Args:
        document: The document.
        overrides: By dotted path YAML text, or a plain value. What is set there counts as written.
        kinds: Kinds beside tgdsl's and those of installed packages.
        progress: Is told what is done.
        sensors: Names of the sensors that are wanted; default: all.

    Raises:
        SpecError: What is wrong with the document, or an `accuracy` that nothing holds.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what it warns of is told where it is compiled
        task = task_of(document, overrides, kinds, progress, sensors)
        return cached(key_of(task), lambda: _chosen(task), packed, unpacked) if task.wanted else Choice()


def task_of(
    document: Document,
    overrides: Mapping[str, Any] | None = None,
    kinds: Sequence[Kind] = (),
    progress: Progress | None = None,
    sensors: Collection[str] | None = None,
) -> Task:
    """Return what is to be chosen: see `choose`."""
    loaded = load(document, overrides, known_kinds(kinds), sensors=sensors)
    wanted = {name: spec.accuracy for name, spec in loaded.spec.sensors.items() if spec.accuracy is not None}
    return Task(document, overrides or {}, kinds, sensors, loaded, wanted, progress or silent)


def key_of(task: Task) -> str:
    """Return a hash of all that a choice follows from: what the document computes now, what is asked for, and what is free.

    Raises:
        SpecError: What is wrong with the document.
    """
    unchosen = Choice(notes=dict.fromkeys(task.wanted, ()))
    own = compile_plan(task.document, task.overrides, task.kinds, task.progress, task.sensors, unchosen)
    blank = dataclasses.replace(own.origin, document_sha256="")
    specs = {"sensors": task.loaded.spec.sensors, "objects": task.loaded.spec.objects}
    written = {f"{part}.{name}": sorted(spec.model_fields_set) for part, each in specs.items() for name, spec in each.items()}
    known = {kind.name: kind.alternatives(spec) for kind, spec in _kinds(task)}
    parts = [
        FORMAT,
        ENVS,
        STEPS,
        dataclasses.replace(own, origin=blank).to_json(),
        {n: repr(a) for n, a in task.wanted.items()},
    ]
    parts += [written, known, query_alternatives(), {name: version(name) for name in ("tgdsl", "torch", "mujoco")}]
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=repr).encode()).hexdigest()


def _kinds(task: Task) -> list[tuple[Kind, Any]]:
    known = {kind.name: kind for kind in known_kinds(task.kinds)}
    specs = task.loaded.spec.sensors
    return [(known[specs[name].kind], specs[name]) for name in task.wanted]  # type: ignore[attr-defined]


def packed(choice: Choice) -> dict[str, np.ndarray]:
    """Return what a cache file holds of a choice."""
    text = json.dumps({"changes": dict(choice.changes), "notes": dict(choice.notes)})
    return {"choice": np.frombuffer(text.encode(), dtype=np.uint8)}


def unpacked(arrays: Mapping[str, np.ndarray]) -> Choice:
    """Return the choice that `packed` packed."""
    found = json.loads(arrays["choice"].tobytes())
    return Choice(found["changes"], {name: tuple(lines) for name, lines in found["notes"].items()})


def _chosen(task: Task) -> Choice:
    """Measure and choose.

    Raises:
        SpecError: If there is a sensor whose accuracy nothing holds, or that cannot be measured.
    """
    recording = _states(task)
    problems: list[Problem] = []
    trials: dict[str, Trial] = {}
    found: dict[str, tuple[Outcome, Variant, Level]] = {}
    floors = _floors(task.loaded, task.wanted)

    def attempt(name: str, work: Any) -> None:
        try:
            work()
        except LowerError as error:
            problems.append(task.loaded.problem(("sensors", name, "accuracy"), error.what, error.hint))

    def first(name: str, accuracy: Accuracy) -> None:
        sensor = Sensor.of(task.document, task.overrides, name, task.kinds)
        trial = trials[name] = Trial(sensor, accuracy, recording, task.progress)
        found[name] = cheapest(trial, trial.fields(), trial.levels(floors))

    for name, accuracy in task.wanted.items():
        attempt(name, lambda name=name, accuracy=accuracy: first(name, accuracy))
    if problems:
        raise SpecError(problems)
    places: dict[str, int] = {}
    for _, _, level in found.values():
        places |= {target: max(place, places.get(target, place)) for target, place in level.places.items()}

    def again(name: str) -> None:
        level = level_of({target: places[target] for target in found[name][2].places})
        found[name] = cheapest(trials[name], trials[name].fields(), [level])

    alone = {name: level.places for name, (_, _, level) in found.items()}
    for name, own in alone.items():
        if any(places[target] != place for target, place in own.items()):
            attempt(name, lambda name=name: again(name))
    if problems:
        raise SpecError(problems)
    changes = {key: value for outcome, _, _ in found.values() for key, value in outcome.variant.changes.items()}
    return Choice(changes, {name: _notes(trials[name], own, places, alone, floors) for name, (own, _, _) in found.items()})


def _floors(loaded: Loaded, wanted: Collection[str]) -> Places:
    """Return of objects that sensors without an accuracy feel which way they have: no coarser one is taken."""
    felt = {target for name, spec in loaded.spec.sensors.items() if name not in wanted for target in spec.objects}
    alternatives = query_alternatives()
    found = {}
    for target in sorted(felt & loaded.spec.objects.keys()):
        own = [i for i, other in enumerate(alternatives) if is_taken(loaded.spec.objects[target], other)]
        found |= {target: own[0]} if own else {}
    return found


def _states(task: Task) -> Recording:
    """Return states of a run of the scene, with all that the sensors read without imperfections.

    Raises:
        SpecError: If the scene cannot be run.
    """
    changes = {key: value for name in task.wanted for key, value in bare(name).items()}
    plan = compile_plan(task.document, {**task.overrides, **changes}, task.kinds, task.progress, list(task.wanted))
    inputs = plan.inputs
    num_envs = max([ENVS, *(2 * num for num in (*inputs.num_variants, *inputs.num_materials))])
    try:
        return record(
            TactileModule(plan, known_kinds(task.kinds), torch.float32), num_envs, steps=STEPS, progress=task.progress
        )
    except SimulationError as error:
        what = f"there are no states to measure errors on: {error}"
        at = [("sensors", name, "accuracy") for name in task.wanted]
        raise SpecError(
            [task.loaded.problem(path, what, "take it out, or give a scene that can be run") for path in at]
        ) from error


def _notes(trial: Trial, own: Outcome, places: Places, alone: Mapping[str, Places], floors: Places) -> tuple[str, ...]:
    """Return what an account of a sensor says of what was chosen, what was measured, and why."""
    cost, written = own.cost, written_fields(trial)
    lines = [f"accuracy {trial.accuracy}: {own.variant.label}", shown_errors(trial, own)]
    spread = [
        f"{name}: 99 % within {shown(errors.p99, bound)}, largest {shown(errors.largest.value, bound)}"
        for (name, errors), bound in zip(own.chosen.items(), trial.bounds.values(), strict=True)
    ]
    lines += spread
    scales = {name: (scale, unit) for name, scale, unit in zip(*_changes(trial), strict=True)}
    changes = ", ".join(f"{name} {scale:.3g}{'' if unit == '1' else f' {unit}'}" for name, (scale, unit) in scales.items())
    lines.append(f"against {trial.exact.variant.label} in float64, on a {trial.recording.source}; largest changes: {changes}")
    lines.append(f"cheapest by count: {cost.operations} operations, {cost.constants} bytes of constants")
    failed = sorted((other for other in trial.outcomes.values() if not other.is_held), key=_cost)
    worst = [f"{other.variant.label} ({brief(max(other.excess, other.verified_excess))} times the bound)" for other in failed]
    lines += [f"not within it: {', '.join(worst)}"] if worst else []
    for target, place in alone[trial.sensor.name].items():
        others = [name for name, own_places in alone.items() if own_places.get(target) == places[target]]
        if place < places[target]:
            lines.append(f"object {target}: as fine as {listed(others)} needs")
        elif floors.get(target) == place:
            lines.append(f"object {target}: no coarser than written, as sensors without an accuracy feel it too")
    lines += [f"left as written: {', '.join(written)}"] if written else []
    return (lines[0], *(f"  {line}" for line in lines[1:]))


def _changes(trial: Trial) -> tuple[Sequence[str], Sequence[float], Sequence[str]]:
    return trial.exact.quantities, trial.exact.magnitude.scale.tolist(), trial.exact.units


def _cost(outcome: Outcome) -> tuple[int, int]:
    return outcome.cost.operations or 0, outcome.cost.constants

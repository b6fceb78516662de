"""A sensor's variants, compiled from its document with one change each: their costs and errors.

Shapes: `step` calls, `env` environments, `row` rows of a reading, `channel` numbers per row.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from tgdsl.compiler.pipeline import Document, compile_document
from tgdsl.console.progress import Progress, silent
from tgdsl.errors import LowerError, TgdslError, listed
from tgdsl.fields.accuracy import Accuracy, Bound
from tgdsl.module.accuracy.errors import Errors, Magnitude, errors_of, halves, magnitude_of
from tgdsl.module.accuracy.states import common_of, readings_of
from tgdsl.module.accuracy.variants import (
    Variant,
    Variants,
    bare,
    is_free,
    is_taken,
    queried_objects,
    variants_of,
    written_of,
)
from tgdsl.module.module import TactileModule
from tgdsl.plan.plan import Plan
from tgdsl.plan.sensors import PlannedReading
from tgdsl.schema.load import load
from tgdsl.schema.objects import ObjectSpec, query_alternatives
from tgdsl.sensors.base import AnySensorSpec, Kind
from tgdsl.sensors.known import known_kinds
from tgdsl.sensors.noise.spec import quantity
from tgdsl.tuning.recording import Recording

Places = Mapping[str, int]  # of objects, which of `query_alternatives` they have


class Cost(NamedTuple):
    """What a module takes, counted."""

    operations: int | None  # elementary operations of one environment's call; None: not counted
    constants: int  # of all environments together [bytes]
    state: int  # what each environment carries from call to call [bytes]
    output: int  # what each environment's call returns [bytes]


@dataclass(frozen=True, eq=False)
class Sensor:
    """A sensor of a document, without imperfections, that compiles its variants."""

    document: Document  # the document
    overrides: Mapping[str, Any]  # changes to it, including the removal of imperfections
    name: str  # the sensor's name
    kind: Kind  # its kind
    spec: AnySensorSpec  # its fields
    # kind and fields of all sensors of its Plan: itself and the sensors it reads
    others: Mapping[str, tuple[Kind, AnySensorSpec]]
    queried: Mapping[str, ObjectSpec]  # fields of the objects with meshes that it senses
    own: Plan  # the Plan of the document's variant
    variants: Variants  # the variants
    kinds: Sequence[Kind] = ()  # kinds in addition to tgdsl's and installed packages'
    plans: dict[str, Plan] = field(default_factory=dict)  # plans so far, by their changes

    @staticmethod
    def of(document: Document, overrides: Mapping[str, Any], name: str, kinds: Sequence[Kind] = ()) -> Sensor:
        """Return a sensor of a document."""
        changed, all_kinds = {**overrides, **bare(name)}, known_kinds(kinds)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            loaded = load(document, changed, all_kinds)
        plan, by_name = quiet_plan(document, changed, name, kinds), {kind.name: kind for kind in all_kinds}
        specs = {s.sensor: (by_name[s.kind], loaded.spec.sensors[s.sensor]) for s in plan.sensors}
        kind, spec = specs[name]
        queried = {target: loaded.spec.objects[target] for target in queried_objects(plan)}
        variants = variants_of(kind, name, spec, queried, query_alternatives())
        return Sensor(document, changed, name, kind, spec, specs, queried, plan, variants, kinds)

    @property
    def reading(self) -> PlannedReading:
        """Its reading."""
        return self.own.readings()[self.name]

    def plan(self, variant: Variant) -> Plan:
        """Return the Plan of a variant; raise `TgdslError` if it is unavailable."""
        if not variant.changes:
            return self.own
        key = repr(sorted(variant.changes.items()))
        if key not in self.plans:
            plan = quiet_plan(self.document, {**self.overrides, **variant.changes}, self.name, self.kinds)
            self.module(plan, torch.float32)  # which may need a library that is missing
            self.plans[key] = plan
        return self.plans[key]

    def has(self, variant: Variant, left_out: dict[str, str]) -> bool:
        """Return whether a variant is available; if not, the reason is in `left_out`, by its label."""
        if variant.label not in left_out:
            try:
                self.plan(variant)
            except TgdslError as error:
                left_out[variant.label] = str(error)
        return variant.label not in left_out

    def module(self, plan: Plan, dtype: torch.dtype) -> TactileModule:
        """Return the module of one of its Plans."""
        return TactileModule(plan, known_kinds(self.kinds), dtype)


def quiet_plan(document: Document, overrides: Mapping[str, Any], name: str, kinds: Sequence[Kind] = ()) -> Plan:
    """Return the Plan of one sensor, without the document's warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return compile_document(document, overrides, kinds, sensors=[name]).plan


class Exact(NamedTuple):
    """The reference of a sensor's errors."""

    variant: Variant  # the finest available variant
    module: TactileModule  # the document's own variant in float64, whose rows readings are compared at
    readings: Float[np.ndarray, "step env row channel"]  # the finest variant's readings, in float64, at these rows
    magnitude: Magnitude  # magnitude to which errors are relative
    quantities: tuple[str, ...]  # the quantity of each channel
    units: tuple[str, ...]  # the unit of each channel


def exact_of(sensor: Sensor, finest: Variant, recording: Recording, progress: Progress = silent) -> Exact:
    """Return the reference of a sensor's errors, from its finest variant (see `finest_of`) and recorded states."""
    progress(f"{sensor.name}: {finest.label}, float64")
    exact = sensor.module(sensor.own, torch.float64)
    fine = sensor.module(sensor.plan(finest), torch.float64)
    fine_readings = readings_of(fine, recording.for_module(fine.inputs), sensor.name)
    readings = common_of(exact, fine, sensor.name).of_other(fine_readings)
    quantities = tuple(quantity(channel) for channel in sensor.reading.channels)
    return Exact(finest, exact, readings, magnitude_of(readings, quantities), quantities, tuple(sensor.reading.units))


def finest_of(sensor: Sensor, left_out: dict[str, str]) -> Variant:
    """Return the finest variant: the last available one of its fields and of its queries.

    `left_out` is filled with the reasons why finer ones are unavailable, by their labels.
    """
    axes = (sensor.variants.fields, sensor.variants.queries)
    results = [last for axis in axes if (last := next(filter(lambda v: sensor.has(v, left_out), reversed(axis)), None))]
    if not results:
        return Variant(sensor.variants.own.label, is_own=True, is_exact=True)
    return results[0] if len(results) == 1 else results[0].joined(results[1])


def cost_of(touch: TactileModule, size: int) -> Cost:
    """Return the counted cost of a module whose outputs have `size` bytes per number; its state is a single call's."""
    state = touch.example_state(2)
    with torch.no_grad():
        touch(state)
    state_bytes = sum(buffer.numel() * buffer.element_size() for buffer in touch.memory.buffers()) // 2
    touch.free()
    return Cost(
        operations=touch.operations_per_env(),
        constants=sum(buffer.numel() * buffer.element_size() for buffer in touch.constants.buffers()),
        state=state_bytes,
        output=size * sum(int(np.prod(output.shape)) for output in touch.outputs),
    )


class Level(NamedTuple):
    """A distance query for each mesh that a sensor senses."""

    variant: Variant
    places: Places


@dataclass(frozen=True)
class Outcome:
    """A variant, measured."""

    variant: Variant  # the variant
    cost: Cost  # its counted cost
    chosen: Mapping[str, Errors]  # errors of each quantity in the environments that choose
    verified: Mapping[str, Errors]  # errors in the environments that verify
    excess: float  # largest upper end of an interval of `chosen` over its bound: at most 1 if the accuracy is held
    verified_excess: float  # largest error of `verified` over its bound

    @property
    def is_held(self) -> bool:
        """Whether the accuracy is met, also in the environments that verify."""
        return self.excess <= 1 and self.verified_excess <= 1


class Trial:
    """A sensor's variants on recorded states, each measured once."""

    def __init__(self, sensor: Sensor, accuracy: Accuracy, recording: Recording, progress: Progress):
        """Raise `LowerError` if the reading does not change on the states, or the document has the finest variant already."""
        self.sensor, self.accuracy, self.recording, self._progress = sensor, accuracy, recording, progress
        self.left_out: dict[str, str] = {}  # why variants are unavailable, by their labels
        self.exact: Exact = exact_of(sensor, finest_of(sensor, self.left_out), recording, progress)
        self.outcomes: dict[str, Outcome] = {}  # measurements, by the variants' labels
        self._costs: dict[str, Cost] = {}
        self.bounds: dict[str, Bound] = {}  # the accuracy of each quantity
        for name in dict.fromkeys(self.exact.quantities):
            bound = accuracy.of(name)
            assert bound is not None  # the compiler has refused it else
            self.bounds[name] = bound
        self._check_states()

    def channels(self, quantity: str) -> list[int]:
        """Return the indices of a quantity's channels."""
        return [i for i, other in enumerate(self.exact.quantities) if other == quantity]

    def fields(self) -> list[Variant]:
        """Return the choices of the sensor's fields whose errors can be measured and that change no field that is set."""
        candidates = [choice for choice in self.sensor.variants.fields if choice.label not in self.left_out]
        finest = candidates[-1] if candidates else None
        if finest is not None and not finest.is_exact:
            candidates = candidates[:-1]
        results = [choice for choice in candidates if choice.is_free]
        is_finest = finest is not None and finest.is_own and not finest.is_exact
        if not any(choice.is_own for choice in results) and not is_finest:
            results.insert(0, Variant("as written", is_own=True))
        if not results:
            self._refuse_finest(self.sensor.variants.own.label)
        return results

    def levels(self, floors: Places) -> list[Level]:
        """Return the levels of distance queries, from coarse to fine, that change no field that is set.

        No query is coarser than an object's in `floors`, which sensors without an accuracy sense too.
        """
        alternatives = query_alternatives()
        candidates = [i for i, choice in enumerate(alternatives) if choice.label not in self.left_out]
        finest, queried = alternatives[candidates[-1]], self.sensor.queried
        if not finest.is_exact:
            candidates = candidates[:-1]
            if any(is_taken(spec, finest) for spec in queried.values()):
                self._refuse_finest(finest.label)
        free = {
            name: [i for i in candidates if i >= floors.get(name, 0) and is_free(spec, alternatives[i])]
            for name, spec in queried.items()
        }
        free = {name: ways for name, ways in free.items() if ways}
        result: dict[tuple[int, ...], Level] = {}
        for i in candidates:
            places = {name: next((j for j in ways if j >= i), ways[-1]) for name, ways in free.items()}
            result.setdefault(tuple(places.values()), level_of(places))
        return list(result.values())

    def outcome(self, variant: Variant) -> Outcome | None:
        """Return a variant's errors; None if it is unavailable."""
        if variant.label not in self.outcomes:
            cost = self.cost(variant)
            if cost is None:
                return None
            self._progress(f"{self.sensor.name}: {variant.label}, errors")
            choosing, verified = self._errors(variant)
            self.outcomes[variant.label] = Outcome(
                variant,
                cost,
                choosing,
                verified,
                max(errors.rms.high / self.bounds[name].value for name, errors in choosing.items()),
                max(errors.rms.value / self.bounds[name].value for name, errors in verified.items()),
            )
        return self.outcomes[variant.label]

    def cost(self, variant: Variant) -> Cost | None:
        """Return the counted cost of a variant; None if it is unavailable."""
        if variant.label not in self._costs:
            self._progress(f"{self.sensor.name}: {variant.label}")
            if not self.sensor.has(variant, self.left_out):
                return None
            self._costs[variant.label] = cost_of(self.sensor.module(self.sensor.plan(variant), torch.float32), 4)
        return self._costs[variant.label]

    def _errors(self, variant: Variant) -> Iterator[dict[str, Errors]]:
        """Yield the errors of each quantity, first in the environments that choose, then in the ones that verify."""
        touch, exact = self.sensor.module(self.sensor.plan(variant), torch.float32), self.exact
        readings = readings_of(touch, self.recording.for_module(touch.inputs), self.sensor.name)
        readings = common_of(exact.module, touch, self.sensor.name).of_other(readings)
        for envs in halves(self.recording.num_envs):
            errors = {}
            for name, bound in self.bounds.items():
                channels = self.channels(name)
                pair = (readings[:, envs][..., channels], exact.readings[:, envs][..., channels])
                errors[name] = errors_of(*pair, exact.magnitude.of(envs, channels), is_relative=not bound.unit)
            yield errors

    def _check_states(self) -> None:
        for envs in halves(self.recording.num_envs):
            for name in self.bounds:
                if not self.exact.magnitude.of(envs, self.channels(name)).active.any():
                    problem = f"its {name} never changes on these states ({self.recording.source}), so no error can be measured"
                    hint = "give the scene keyframes `rest` and `squeeze` between which its links meet what they feel"
                    raise LowerError(problem, "accuracy", hint)

    def _refuse_finest(self, label: str) -> None:
        lacking = "".join(f"; {label}: {why}" for label, why in self.left_out.items())
        problem = f"the document's own {label} is the finest variant: there is nothing to measure its error against"
        raise LowerError(f"{problem}{lacking}", "accuracy", "write a coarser one, or none")


def level_of(places: Places) -> Level:
    """Return the level with a given distance query for each object."""
    alternatives = query_alternatives()
    changes = {f"objects.{name}.{key}": v for name, i in places.items() for key, v in alternatives[i].changes.items()}
    labels = dict.fromkeys(alternatives[i].label for i in places.values())
    each = [f"{name} {alternatives[i].label}" for name, i in places.items()]
    return Level(Variant(next(iter(labels), "") if len(labels) < 2 else "; ".join(each), changes), places)


def _joined(fields: Variant, level: Level) -> Variant:
    if not level.places:
        return fields
    return level.variant if not fields.changes else fields.joined(level.variant)


def cheapest(trial: Trial, fields: Sequence[Variant], levels: Sequence[Level]) -> tuple[Outcome, Level]:
    """Return the cheapest variant that meets an accuracy, and its distance queries: fewest operations, then fewest bytes.

    If fields and queries are both free, choices that miss it even with the finest of the other are dropped first. A
    `LowerError` names the best variant if none meets it.
    """
    fields, levels = list(fields), list(levels)
    if len(fields) > 1 and len(levels) > 1:
        fine = levels[-1]
        fields = [choice for choice in fields if _is_near(trial, _joined(choice, fine))] or fields
        finest = fields[-1]
        levels = [choice for choice in levels if _is_near(trial, _joined(finest, choice))] or levels
    options = [(_joined(choice, level), level) for choice in fields for level in levels]
    costs = {option[0].label: cost for option in options if (cost := trial.cost(option[0])) is not None}
    options = [option for option in options if option[0].label in costs]
    options.sort(key=lambda option: (costs[option[0].label].operations or 0, costs[option[0].label].constants))
    for variant, level in options:
        outcome = trial.outcome(variant)
        if outcome is not None and outcome.is_held:
            return outcome, level
    raise _missed(trial)


def _is_near(trial: Trial, variant: Variant) -> bool:
    outcome = trial.outcome(variant)
    return outcome is not None and outcome.is_held


def _missed(trial: Trial) -> LowerError:
    best = min(trial.outcomes.values(), key=lambda own: max(own.excess, own.verified_excess))
    problem = f"nothing that is free to choose holds {trial.accuracy}; best: {best.variant.label}, {shown_errors(trial, best)}"
    written = written_fields(trial)
    hints = [f"{listed(written)} stay{'s' if len(written) == 1 else ''} as written"] if written else []
    hints += [f"{label} is not available: {why}" for label, why in trial.left_out.items()]
    return LowerError(problem, "accuracy", "; ".join([*hints, f"errors are against {trial.exact.variant.label}"]))


def written_fields(trial: Trial) -> list[str]:
    """Return the fields that are set and that other choices would change, by dotted path."""
    sensor = trial.sensor
    results = [f"sensors.{sensor.name}.{key}" for key in written_of(sensor.spec, sensor.kind.alternatives(sensor.spec))]
    for name, spec in sensor.queried.items():
        results += [f"objects.{name}.{key}" for key in written_of(spec, query_alternatives())]
    return results


def shown_errors(trial: Trial, outcome: Outcome) -> str:
    """Return the errors of each quantity, in their bounds' units."""
    parts = []
    for name, bound in trial.bounds.items():
        rms = outcome.chosen[name].rms
        apart = shown(outcome.verified[name].rms.value, bound)
        parts.append(
            f"RMS error of {name} {shown(rms.value, bound)}, up to {shown(rms.high, bound)} with 95 % confidence; "
            f"{apart} in environments that took no part"
        )
    return "; ".join(parts)


def shown(error: float, bound: Bound) -> str:
    """Return an error in a bound's unit."""
    return f"{brief(error)} {bound.unit}" if bound.unit else f"{brief(100 * error)} %"


def brief(value: float) -> str:
    """Return a number with two digits, or all before the point."""
    return f"{value:.0f}" if 100 <= value < 1e6 else f"{value:.2g}"

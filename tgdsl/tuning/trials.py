"""A sensor's variants, compiled from its document with one thing changed, and their errors on recorded states.

Shapes: `step` calls, `env` environments, `row` rows of a reading, `channel` numbers per row.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from tgdsl.compiler.pipeline import Document, compile_document
from tgdsl.console.progress import Progress, silent
from tgdsl.errors import TgdslError
from tgdsl.module.accuracy.errors import Magnitude, magnitude_of
from tgdsl.module.accuracy.states import common_of, readings_of
from tgdsl.module.accuracy.variants import Variant, Variants, bare, queried_objects, variants_of
from tgdsl.module.module import TactileModule
from tgdsl.plan.plan import Plan
from tgdsl.plan.sensors import PlannedReading
from tgdsl.schema.load import load
from tgdsl.schema.objects import ObjectSpec, query_alternatives
from tgdsl.sensors.base import AnySensorSpec, Kind
from tgdsl.sensors.known import known_kinds
from tgdsl.sensors.noise.spec import quantity
from tgdsl.tuning.recording import Recording


class Cost(NamedTuple):
    """What a module takes, counted."""

    operations: int | None  # elementary operations of one environment's call; None: not counted
    constants: int  # of all environments together [bytes]
    state: int  # what each environment carries from call to call [bytes]
    output: int  # what each environment's call returns [bytes]


@dataclass(frozen=True, eq=False)
class Sensor:
    """A sensor of a document, without imperfections, and how its variants are compiled."""

    document: Document  # the document
    overrides: Mapping[str, Any]  # changes to it, imperfections left out
    name: str  # the sensor's name
    kind: Kind  # its kind
    spec: AnySensorSpec  # its fields
    # kind and fields of all sensors of its Plan: itself and the sensors it reads
    others: Mapping[str, tuple[Kind, AnySensorSpec]]
    queried: Mapping[str, ObjectSpec]  # of the objects with meshes that it feels, their fields
    own: Plan  # the Plan of the document's own variant
    variants: Variants  # the variants
    kinds: Sequence[Kind] = ()  # kinds in addition to tgdsl's and those of installed packages
    plans: dict[str, Plan] = field(default_factory=dict)  # plans so far, by their changes

    @staticmethod
    def of(document: Document, overrides: Mapping[str, Any], name: str, kinds: Sequence[Kind] = ()) -> Sensor:
        """Return a sensor of a document.

        Raises:
            SpecError: If the document has mistakes.
        """
        changed, all_kinds = {**overrides, **bare(name)}, known_kinds(kinds)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            loaded = load(document, changed, all_kinds)
        plan, by_name = quiet_plan(document, changed, name, kinds), {kind.name: kind for kind in all_kinds}
        others = {s.sensor: (by_name[s.kind], loaded.spec.sensors[s.sensor]) for s in plan.sensors}
        kind, spec = others[name]
        queried = {target: loaded.spec.objects[target] for target in queried_objects(plan)}
        variants = variants_of(kind, name, spec, queried, query_alternatives())
        return Sensor(document, changed, name, kind, spec, others, queried, plan, variants, kinds)

    @property
    def reading(self) -> PlannedReading:
        """Its reading."""
        return self.own.readings()[self.name]

    def plan(self, variant: Variant) -> Plan:
        """Return the Plan of a variant.

        Raises:
            TgdslError: If it is unavailable.
        """
        if not variant.changes:
            return self.own
        key = repr(sorted(variant.changes.items()))
        if key not in self.plans:
            plan = quiet_plan(self.document, {**self.overrides, **variant.changes}, self.name, self.kinds)
            self.module(plan, torch.float32)  # which may need a library that is missing
            self.plans[key] = plan
        return self.plans[key]

    def module(self, plan: Plan, dtype: torch.dtype) -> TactileModule:
        """Return the module of one of its Plans."""
        return TactileModule(plan, known_kinds(self.kinds), dtype)


def quiet_plan(document: Document, overrides: Mapping[str, Any], name: str, kinds: Sequence[Kind] = ()) -> Plan:
    """Return the Plan of one sensor, without what compiling the whole document warns of."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return compile_document(document, overrides, kinds, sensors=[name]).plan


class Exact(NamedTuple):
    """What errors of a sensor are measured against."""

    variant: Variant  # the finest available variant
    module: TactileModule  # the document's own variant in float64, whose rows readings are compared at
    readings: Float[np.ndarray, "step env row channel"]  # the finest variant's, in float64, at those rows
    magnitude: Magnitude  # what errors are relative to
    quantities: tuple[str, ...]  # what each channel is a component of
    units: tuple[str, ...]  # the unit of each channel


def exact_of(sensor: Sensor, finest: Variant, recording: Recording, progress: Progress = silent) -> Exact:
    """Return what errors of a sensor are measured against.

    Args:
        sensor: The sensor.
        finest: Its finest variant: see `finest_of`.
        recording: States of the document's scene.
        progress: Called with a line of text for each long job.

    Raises:
        StateError: If the states are of another document.
    """
    progress(f"{sensor.name}: {finest.label}, float64")
    exact = sensor.module(sensor.own, torch.float64)
    fine = sensor.module(sensor.plan(finest), torch.float64)
    found = readings_of(fine, recording.for_module(fine.inputs), sensor.name)
    readings = common_of(exact, fine, sensor.name).of_other(found)
    quantities = tuple(quantity(channel) for channel in sensor.reading.channels)
    return Exact(finest, exact, readings, magnitude_of(readings, quantities), quantities, tuple(sensor.reading.units))


def finest_of(sensor: Sensor, left_out: dict[str, str]) -> Variant:
    """Return the finest variant: the last available one of its fields and of its queries.

    Args:
        sensor: The sensor.
        left_out: Filled with the reasons why finer ones are unavailable, by their labels.
    """
    results = [last for axis in (sensor.variants.fields, sensor.variants.queries) if (last := _last(sensor, axis, left_out))]
    if not results:
        return Variant(sensor.variants.own.label, is_own=True, is_exact=True)
    return results[0] if len(results) == 1 else results[0].joined(results[1])


def _last(sensor: Sensor, axis: Sequence[Variant], left_out: dict[str, str]) -> Variant | None:
    for variant in reversed(axis):
        if variant.label in left_out:
            continue
        try:
            sensor.plan(variant)
        except TgdslError as error:
            left_out[variant.label] = str(error)
        else:
            return variant
    return None


def cost_of(touch: TactileModule, size: int) -> Cost:
    """Return the counted cost of a module; its state is that of a single call.

    Args:
        touch: The module.
        size: Bytes of a number that it returns.
    """
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

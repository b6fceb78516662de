"""Readings and observations of a module, and how observations are computed from readings.

Shapes: `env` environments, `step` stacked calls, `row` taxels, bodies, joints or actuators, `channel` numbers per row,
`feature` numbers of an observation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.console.tables import Observations, Outputs
from tgdsl.errors import ObservationError, did_you_mean
from tgdsl.observations.observations import HAND_ONLY, Observation, hand_only_error
from tgdsl.plan.plan import Plan
from tgdsl.tensors.buffers import Constants


@dataclass(frozen=True)
class Output:
    """One reading: name, sensor, kind of the sensor, shape after `env`, and name and unit of each channel.

    The shape is (row, channel), or (step, row, channel) if calls, or samples of a block, are stacked. Rows are the sensor's
    taxels (`rows` is "taxel"), the bodies that carry it ("body"), or other rows of its kind: see `TactileModule.rows`. `bodies`
    lists the bodies. A reading of joints or actuators has its own name as sensor and kind, and the rows of `inputs.joints`
    ("joint") or `inputs.actuators` ("actuator").
    """

    name: str
    sensor: str
    kind: str
    shape: tuple[int, ...]
    rows: str
    bodies: tuple[str, ...]
    channels: tuple[str, ...]
    units: tuple[str, ...]


def outputs_of(plan: Plan) -> tuple[Output, ...]:
    """Return name, shape, channels and units of a plan's readings; the tuple prints as a table."""
    sensors = {reading.name: sensor for sensor in plan.sensors for reading in sensor.readings}
    outputs = []
    for name, reading in plan.readings().items():
        sensor, kind = (sensors[name].sensor, sensors[name].kind) if name in sensors else (name, name)
        bodies = plan.layout_of(sensors[name]).bodies if name in sensors else ()
        outputs.append(Output(name, sensor, kind, reading.shape, reading.rows, bodies, reading.channels, reading.units))
    return Outputs(outputs)


@dataclass(frozen=True)
class ObservationTerm:
    """One term of an observation group.

    Attributes:
        name: The observed reading, or the type if there is none; `<name>[<i>]` with the term's index if several terms of the
            group share the name.
        type: Its type.
        size: Number of features.
        slice: Slice of its features in the group.
    """

    name: str
    type: str
    size: int
    slice: slice


def observation_terms(plan: Plan) -> dict[str, tuple[ObservationTerm, ...]]:
    """Return the terms of each observation group, in the order in which they are concatenated; it prints as a table."""
    groups: dict[str, list[ObservationTerm]] = {}
    plain = [(term.group, term.reading or term.type) for term in plan.observations]
    for term, (group, name) in zip(plan.observations, plain, strict=True):
        earlier = groups.setdefault(group, [])
        start = earlier[-1].slice.stop if earlier else 0
        term_name = name if plain.count((group, name)) == 1 else f"{name}[{term.index}]"
        earlier.append(ObservationTerm(term_name, term.type, term.num_features, slice(start, start + term.num_features)))
    return Observations({group: tuple(terms) for group, terms in groups.items()})


def observe(
    plan: Plan, constants: Constants, readings: Mapping[str, Tensor], types: Mapping[str, type[Observation]]
) -> dict[str, Float[Tensor, "env feature"]]:
    """Return the observation groups of a plan, each the concatenation of its terms, every term flattened channel-major.

    Raises:
        ObservationError: If a reading that is observed is missing or of another shape, if readings are of different numbers of
            environments, or an observation exists on the real hand only.
    """
    if not isinstance(readings, Mapping):
        raise ObservationError(
            f"found a {type(readings).__name__}, expected readings by name, as a call of the module returns them"
        )
    num_envs = _checked(plan, readings)
    groups: dict[str, list[Tensor]] = {}
    for term in plan.observations:
        features = [torch.empty((num_envs, 0), dtype=constants.dtype, device=constants.device)]
        if term.reading is not None:
            folded = constants.tree["observations"][term.key]
            reading = readings[term.reading]
            steps = reading.unbind(1) if reading.ndim == 4 else [reading]  # stacked calls: the oldest one's features first
            features = [types[term.type].observe(step, term.channels, folded) for step in steps]
        groups.setdefault(term.group, []).extend(features)
    return {group: torch.cat(parts, dim=1) for group, parts in groups.items()}


def _checked(plan: Plan, readings: Mapping[str, Tensor]) -> int:
    """Validate the observed readings and return their number of environments."""
    planned = plan.readings()
    for term in plan.observations:
        if term.type in HAND_ONLY:
            raise hand_only_error(term.group, term.index, term.type)
        if term.reading is None:
            continue
        where = f"observation {term.group}[{term.index}] ({term.type})"
        if term.reading not in readings:
            given_names = f"found {', '.join(readings)}" if readings else "found none"
            raise ObservationError(f'{where} wants the reading "{term.reading}"; {given_names}')
        reading, want = readings[term.reading], planned[term.reading].shape
        where = f'{where}: reading "{term.reading}"'
        if not isinstance(reading, Tensor):
            raise ObservationError(f"{where} is a {type(reading).__name__}, expected a torch tensor")
        if tuple(reading.shape[1:]) != want:
            expected = ", ".join(map(str, want))
            raise ObservationError(f"{where} has shape {tuple(reading.shape)}, expected (env, {expected})")
    if not readings:
        raise ObservationError("there are no readings, so nothing says how many environments there are")
    counts = {name: reading.shape[0] for name, reading in readings.items() if name in planned}
    if not counts:
        unknown = next(iter(readings))
        raise ObservationError(f'this module has no reading "{unknown}"; {did_you_mean(unknown, planned, "readings")}')
    first = next(iter(counts))
    for name, count in counts.items():
        if count != counts[first]:
            raise ObservationError(f'reading "{name}" is of {count} environments, "{first}" of {counts[first]}')
    return counts[first]

"""All sensors of a plan from one state: what they ask for is gathered once, then each is read.

Shapes: `env` environments, `row` rows of a reading, `channel` numbers per row, `sample` samples of a block.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from tgdsl.errors import TgdslError
from tgdsl.module.gathering import Tree, gather, gathered_of, scene_of
from tgdsl.module.memory.clock import Clock
from tgdsl.module.memory.history import pushed, reduced
from tgdsl.module.memory.memory import WINDOW
from tgdsl.module.reading import block, joined_signal, read
from tgdsl.plan.plan import Plan
from tgdsl.plan.sensors import PlannedSensor
from tgdsl.quantities.base import Gathered, Quantity
from tgdsl.sensors.base import Kind
from tgdsl.sensors.noise import stages
from tgdsl.sensors.noise.instant import Now
from tgdsl.sensors.upstream import Upstream

Tensors = dict[str, Tensor]


class Sensing(NamedTuple):
    """What a plan is computed with.

    Attributes:
        plan: The plan.
        kinds: The kind of each sensor, by the sensor's name.
        quantities: The quantities that some sensor asks for.
        clock: Says when sensors are read.
        order: The sensors, each after those that it reads.
    """

    plan: Plan
    kinds: Mapping[str, Kind]
    quantities: tuple[Quantity, ...]
    clock: Clock
    order: tuple[PlannedSensor, ...]


def in_order(sensors: Sequence[PlannedSensor]) -> tuple[PlannedSensor, ...]:
    """Return sensors so that each is after those that it reads; else as they are given."""
    ordered: dict[str, PlannedSensor] = {}
    while len(ordered) < len(sensors):
        ready = [s for s in sensors if s.name not in ordered and all(name in ordered for name in s.upstream)]
        if not ready:
            raise TgdslError("not a plan: sensors read one another in a circle, or read some that are not there")
        ordered |= {sensor.name: sensor for sensor in ready}
    return tuple(ordered.values())


def sense(
    sensing: Sensing, own: Tree, tensors: Mapping[str, Tensor], memory: Mapping[str, Tensor], dtype: torch.dtype
) -> tuple[Tensors, Tensors]:
    """Return the readings of all sensors, and their new state: a pure function, traceable in one graph.

    Args:
        sensing: What to compute with.
        own: The plan's parts, bound to constants.
        tensors: The fields of `SceneState` that `inputs` names; those of earlier substeps as `substep/<i>/<field>`.
        memory: State by `sensor:name`, each (env, …), and the clock's.
        dtype: Dtype of the readings.

    Returns:
        Readings by name, and signals before their noise as `<sensor>/signal`; and the new state, of a ring, (env, call, …),
        what is new: (env, …). A kernel may write new state over the old, which is then not returned.
    """
    plan, dt = sensing.plan, tensors.get("dt")
    nows = sensing.clock.nows(memory, dt)
    knobs = {s.name: stages.knob_values(own["noise"].get(s.name, {}), nows.get(s.name)) for s in plan.sensors}
    gathered = _gathered(sensing, own, tensors, nows, knobs, dtype)
    earlier = [_gathered(sensing, own, part, nows, knobs, dtype) for part in _substeps(plan, tensors)]
    readings: Tensors = {}
    joined: dict[tuple[str, ...], Tensor] = {}
    answers: dict[str, list[Tensors]] = {}
    updated = sensing.clock.after(memory, dt)
    for sensor in sensing.order:
        kind, constants = sensing.kinds[sensor.name], own["sensors"][sensor.name]
        state = {name: memory[f"{sensor.name}:{name}"] for name in sensor.state}
        if sensor.substeps:
            contexts = [sensing.clock.context(sensor, memory, dt, i) for i in range(sensor.substeps)]
            each = [*(part[sensor.name] for part in earlier), gathered[sensor.name]]
            each = [_with_upstream(sensor, part, answers, i) for i, part in enumerate(each)]
            found, new, answered = block(sensor, kind, each, contexts, constants, state)
        else:
            signal, asked = None, _with_upstream(sensor, gathered[sensor.name], answers, -1)
            if sensor.joined:
                if sensor.joined not in joined:
                    joined[sensor.joined] = _joined(sensing, own, sensor, gathered[sensor.name])
                signal = joined[sensor.joined][:, :, slice(*sensor.rows)]
            context = sensing.clock.context(sensor, memory, dt)
            values = constants, knobs[sensor.name], state, nows.get(sensor.name)
            found, new, answer = read(sensor, kind, asked, context, *values, signal)
            answered = [answer]
        if sensor.provides:
            answers[sensor.name] = answered
        updated |= {f"{sensor.name}:{name}": value for name, value in new.items()}
        readings |= _with_history(sensor, found, memory, updated)
    for reading in plan.proprioception:  # a copy: who fills the state in place keeps the readings of before
        readings[reading.name] = tensors[reading.name].to(dtype, copy=True).unsqueeze(2)
    return readings, updated


def _with_upstream(sensor: PlannedSensor, gathered: Gathered, answers: Mapping[str, list[Tensors]], substep: int) -> Gathered:
    """Return what a sensor asked for, with the planes of the sensors that it reads."""
    if not sensor.upstream:
        return gathered
    return gathered.replaced(Upstream, {name: answers[name][substep] for name in sensor.upstream})


def _gathered(
    sensing: Sensing,
    own: Tree,
    tensors: Mapping[str, Tensor],
    nows: Mapping[str, Now],
    knobs: Mapping[str, Tensors],
    dtype: torch.dtype,
) -> dict[str, Gathered]:
    """Return by sensor what it asked for, of one state."""
    scene = scene_of(sensing.plan, own, tensors, nows, knobs, dtype)
    values = gather(sensing.quantities, own, scene)
    return {sensor.name: gathered_of(sensor, sensing.quantities, values) for sensor in sensing.plan.sensors}


def _substeps(plan: Plan, tensors: Mapping[str, Tensor]) -> list[Tensors]:
    """Return the fields of each substep before the last one."""
    names = [name for name in plan.inputs.fields if name != "dt"]
    return [{name: tensors[f"substep/{i}/{name}"] for name in names} for i in range(plan.inputs.substeps - 1)]


def _joined(sensing: Sensing, own: Tree, sensor: PlannedSensor, gathered: Gathered) -> Tensor:
    """Return the signals of sensors that are computed as one."""
    by_name = {other.name: other for other in sensing.plan.sensors}
    sensors = [by_name[name] for name in sensor.joined]
    constants = [own["sensors"][other.name] for other in sensors]
    return joined_signal(sensing.kinds[sensor.joined[0]], sensors, gathered, constants)


def _with_history(sensor: PlannedSensor, found: Tensors, memory: Mapping[str, Tensor], updated: Tensors) -> Tensors:
    """Return readings with those of the last calls, if that is what is read; what they are made of goes to `updated`."""
    for reading in sensor.windows:
        assert sensor.history is not None
        path = f"{WINDOW}{reading.name}"
        updated[path] = pushed(memory[path], found[reading.name], memory["clock/age"])
        found[reading.name] = reduced(updated[path], sensor.history.reduce)
    return found

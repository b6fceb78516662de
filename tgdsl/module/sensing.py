"""All sensors of a plan from one state: what they ask for is gathered once, then each is read.

Shapes: `env` environments, `row` rows of a reading, `channel` numbers per row, `sample` samples of a block.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.errors import TgdslError, listed
from tgdsl.module.memory import WINDOW, Clock, age_of, pushed, reduced
from tgdsl.plan import tree
from tgdsl.plan.plan import Plan
from tgdsl.plan.sensors import PlannedSensor
from tgdsl.quantities.base import Gathered, Quantity, Scene
from tgdsl.quantities.contact_depth import ContactDepth
from tgdsl.quantities.pairs import PairTable, gates, relate
from tgdsl.sensors.base import UNTIMED, Context, Kind, state_by_name
from tgdsl.sensors.noise.pipeline import StageType, disturb, draw
from tgdsl.sensors.noise.stage import NO_CLOCK, Now, Stage
from tgdsl.sensors.noise.stages import Gain, Radius, Release
from tgdsl.sensors.upstream import Upstream
from tgdsl.tensors.fusion import materialised

Tree = Mapping[str, Any]  # what `parts` returns, with tensors for arrays
Tensors = dict[str, Tensor]


def parts(plan: Plan) -> dict[str, Any]:
    """Return what of a plan is read at run time, its arrays being a module's constants."""
    return {
        "pairs": plan.pairs,
        "quantities": plan.quantities,
        "sensors": {sensor.name: sensor.constants for sensor in plan.sensors},
        "noise": {sensor.name: sensor.noise.constants for sensor in plan.sensors if sensor.noise is not None},
        "observations": {term.key: term.constants for term in plan.observations},
    }


def constant_arrays(plan: Plan) -> dict[str, np.ndarray]:
    """Return the arrays of these parts, by the names that the plan gives them."""
    names, result = {id(array): name for name, array in plan.arrays.items()}, {}
    tree.mapped(parts(plan), lambda array: result.setdefault(names[id(array)], array), _stays_on_host)
    return result


def bind(plan: Plan, kinds: Mapping[str, Kind], tensor_of: Callable[[str], Tensor]) -> Tree:
    """Return these parts with a tensor in the place of each array, and constants as the kind of each sensor has them."""
    names = {id(array): name for name, array in plan.arrays.items()}
    bound = tree.mapped(parts(plan), lambda array: tensor_of(names[id(array)]), _is_prepared)
    return {**bound, "sensors": {name: kinds[name].typed(constants) for name, constants in bound["sensors"].items()}}


def _stays_on_host(record: Any) -> bool:
    return getattr(record, "stays_on_host", False)


def _is_prepared(record: Any) -> bool:
    return _stays_on_host(record) and record.prepared is not None  # made here: no compiler traces that


class Sensing(NamedTuple):
    """A plan with its kinds, quantities and noise stages."""

    plan: Plan
    kinds: Mapping[str, Kind]  # the kind of each sensor, by the sensor's name
    quantities: tuple[Quantity, ...]  # the quantities that some sensor asks for
    stages: Mapping[str, Sequence[StageType]]  # the stages of each sensor's noise, by the sensor's name
    clock: Clock  # says when sensors are read
    order: tuple[PlannedSensor, ...]  # the sensors, each after the sensors that it reads


def in_order(sensors: Sequence[PlannedSensor]) -> tuple[PlannedSensor, ...]:
    """Return sensors in topological order: each after the sensors that it reads, otherwise in the given order."""
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

    `own` has the plan's parts, bound to constants; `tensors` the fields of `SceneState` that `inputs` names, earlier substeps
    as `substep/<i>/<field>`; `memory` the state by `sensor:name`, each (env, …), and the clock's.

    Readings are by name, with signals before their noise as `<sensor>/signal`. For a ring, (env, call, …), the new state is its
    new entry, (env, …). State that a kernel updates in place is not returned.
    """
    plan, dt = sensing.plan, tensors.get("dt")
    nows = sensing.clock.nows(memory, dt)
    noise = {name: draw(sensing.stages[name], constants, nows.get(name, NO_CLOCK)) for name, constants in own["noise"].items()}
    fields = [name for name in plan.inputs.fields if name != "dt"]
    substeps = [{name: tensors[f"substep/{i}/{name}"] for name in fields} for i in range(plan.inputs.substeps - 1)]
    scenes = [scene_of(plan, own, part, nows, noise, dtype) for part in (*substeps, tensors)]
    *earlier, gathered = [_gathered(sensing, own, scene) for scene in scenes]
    readings: Tensors = {}
    joined: dict[tuple[str, ...], Tensor] = {}
    answers: dict[str, list[Tensors]] = {}
    updated = sensing.clock.after(memory, dt)
    for sensor in sensing.order:
        kind, constants = sensing.kinds[sensor.name], own["sensors"][sensor.name]
        if sensor.substeps:
            contexts = [sensing.clock.context(sensor, memory, dt, i) for i in range(sensor.substeps)]
            each = [*(part[sensor.name] for part in earlier), gathered[sensor.name]]
            each = [_with_upstream(sensor, part, answers, i) for i, part in enumerate(each)]
            outputs, new, answered = _block(sensor, kind, each, contexts, constants, memory)
        else:
            signal, inputs = None, _with_upstream(sensor, gathered[sensor.name], answers, -1)
            if sensor.joined:
                if sensor.joined not in joined:
                    joined[sensor.joined] = _joined_signal(sensing, own, sensor, gathered[sensor.name])
                signal = joined[sensor.joined][:, :, slice(*sensor.rows)]
            context = sensing.clock.context(sensor, memory, dt)
            now, stages = nows.get(sensor.name, NO_CLOCK), noise.get(sensor.name, ())
            outputs, new, answer = _read(sensor, kind, inputs, context, constants, stages, memory, now, signal)
            answered = [answer]
        if sensor.provides:
            answers[sensor.name] = answered
        updated |= new
        for reading in sensor.windows:
            assert sensor.history is not None
            window = pushed(memory[f"{WINDOW}{reading.name}"], outputs[reading.name], age_of(memory))
            updated[f"{WINDOW}{reading.name}"] = window
            outputs[reading.name] = reduced(window, sensor.history.reduce)
        readings |= outputs
    for reading in plan.proprioception:  # a copy: who fills the state in place keeps the readings of before
        readings[reading.name] = tensors[reading.name].to(dtype, copy=True).unsqueeze(2)
    return readings, updated


def scene_of(
    plan: Plan,
    own: Tree,
    tensors: Mapping[str, Tensor],
    nows: Mapping[str, Now],
    noise: Mapping[str, Sequence[Stage]],
    dtype: torch.dtype,
) -> Scene:
    """Return the scene from which quantities are gathered; noise stages may disturb the taxels' radii."""
    shifts, pairs = {}, None
    for sensor in plan.sensors:
        for stage in noise.get(sensor.name, ()):
            if isinstance(stage, Radius):
                probes = stage.radius_noise.new_empty(sensor.rows[1] - sensor.rows[0])
                shifts[sensor.name] = stage.shift(nows[sensor.name], probes)
    if plan.objects:
        table: PairTable[Tensor] = own["pairs"]
        gate = gates(tensors["contact_found"], table.gate, dtype) if "contact_found" in tensors else None
        motion = tensors.get("body_linvel"), tensors.get("body_angvel")
        pairs = relate(tensors["body_pos"], tensors["body_quat"], table.link, table.object, dtype, *motion, gate)
    return Scene(tensors, plan.objects, pairs, shifts, dtype)


def _gathered(sensing: Sensing, own: Tree, scene: Scene) -> dict[str, Gathered]:
    """Return the gathered values of each sensor."""
    values = [(quantity, quantity.gather(own["quantities"][quantity.name], scene)) for quantity in sensing.quantities]
    for quantity, answer in values:
        if not isinstance(answer, (tuple, list)):
            problem = f"expected a tuple with a value for each use, found {type(answer).__name__}"
            raise TgdslError(f'`gather` of the quantity "{quantity.name}": {problem}')
        for sensor in (sensor for sensor in sensing.plan.sensors if sensor.uses.get(quantity.name, -1) >= len(answer)):
            problem = f'{len(answer)} values, and sensor "{sensor.name}" has use {sensor.uses[quantity.name]} (from 0)'
            raise TgdslError(f'`gather` of the quantity "{quantity.name}" returns {problem}; expected one for each use')
    return {
        sensor.name: Gathered({q.request: of[sensor.uses[q.name]] for q, of in values if q.name in sensor.uses})
        for sensor in sensing.plan.sensors
    }


def _with_upstream(sensor: PlannedSensor, gathered: Gathered, answers: Mapping[str, list[Tensors]], substep: int) -> Gathered:
    if not sensor.upstream:
        return gathered
    return gathered.replaced(Upstream, {name: answers[name][substep] for name in sensor.upstream})


def _joined_signal(
    sensing: Sensing, own: Tree, sensor: PlannedSensor, gathered: Gathered
) -> Float[Tensor, "env channel taxel"]:
    """Return the concatenated signals of sensors that are computed as one."""
    by_name, kind = {other.name: other for other in sensing.plan.sensors}, sensing.kinds[sensor.joined[0]]
    sensors = [by_name[name] for name in sensor.joined]
    of_taxels: Tensors = {}
    if names := tuple(sensors[0].constants):
        counts = [end - first for first, end in (other.rows for other in sensors)]
        constants = [own["sensors"][other.name] for other in sensors]
        value = operator.getitem if kind.constants is None else getattr
        rows = [
            torch.cat([value(values, name).expand(n) for values, n in zip(constants, counts, strict=True)]) for name in names
        ]
        of_taxels = dict(zip(names, materialised(torch.stack(rows)).unbind(), strict=True))
    result, _ = kind.forward(gathered, UNTIMED, kind.typed(of_taxels), {})
    return _stacked(result, "signal", sensors[0].signal)


def _read(
    sensor: PlannedSensor,
    kind: Kind,
    gathered: Gathered,
    context: Context,
    constants: Any,
    stages: Sequence[Stage],
    memory: Mapping[str, Tensor],
    now: Now,
    joined: Float[Tensor, "env channel row"] | None = None,
) -> tuple[Tensors, Tensors, Tensors]:
    """Return a sensor's readings by name (env, row, channel), its new state, and what its kind's `forward` returned.

    Of a sensor with noise the clean signal is among the readings, as `<sensor>/signal` (env, channel, row): a compiler that
    fuses then has the equation write all channels side by side, and would else form them again for each number of the noise.
    """
    gain = next((stage for stage in stages if isinstance(stage, Gain)), None)
    if gain is not None and kind.gains_depth and sensor.readings[0].rows == "taxel":
        felt = gathered[ContactDepth]
        gathered = gathered.replaced(ContactDepth, felt._replace(depth=gain.of_taxels(now, felt.depth) * felt.depth))
        stages = [stage for stage in stages if stage is not gain]
    released = {stage.name: stage.release_threshold[:, 0] for stage in stages if isinstance(stage, Release)}
    state, path = _kind_state(sensor, memory), f"{sensor.name}:"
    result, new = ({}, {}) if joined is not None else _answer(sensor, kind, gathered, context, constants, state)
    new = {path + name: value for name, value in new.items()}
    signal = clean = _stacked(result, "signal", sensor.signal) if joined is None else joined
    signal, noted = disturb(signal, stages, f"{path}noise/", memory, now)
    new |= noted
    signal_readings = [reading for reading in sensor.readings if reading.name in (sensor.name, f"{sensor.name}/clean")]
    readings: Tensors = {} if sensor.noise is None else {f"{sensor.name}/signal": clean}
    for reading, which, planes_now in zip(signal_readings, ("measured", "clean"), (signal, clean), strict=False):
        if now.is_sample is not None:
            planes_now = torch.where(now.is_sample[..., None], planes_now, memory[f"{path}sample/{which}"])
            new[f"{path}sample/{which}"] = planes_now
        if kind.decide is not None:
            planes = dict(zip(sensor.signal, planes_now.unbind(1), strict=True))
            own_constants = {**constants, **released} if kind.constants is None else replace(constants, **released)
            planes, decided = kind.decide(planes, own_constants, kind.typed_state(state))
            planes_now = torch.stack([planes[name] for name in reading.channels], dim=1)
            new |= {path + name: value for name, value in state_by_name(decided).items()}
        readings[reading.name] = planes_now.transpose(1, 2)
    for reading in sensor.readings[len(signal_readings) :]:
        report = reading.name.rpartition("/")[2]
        readings[reading.name] = _stacked(result, f"{report}/signal", reading.channels).transpose(1, 2)
    if now.period is not None:
        new[f"{path}sample/phase"] = _phase(memory[f"{path}sample/phase"], now.period, now)
    return readings, new, result


def _block(
    sensor: PlannedSensor,
    kind: Kind,
    gathered: Sequence[Gathered],
    contexts: Sequence[Context],
    constants: Any,
    memory: Mapping[str, Tensor],
) -> tuple[Tensors, Tensors, list[Tensors]]:
    """Return the reading of a sensor that is advanced at each substep, its new state, and what its kind returned at each.

    The reading is (env, sample, row, channel).
    """
    samples, answers, state = [], [], _kind_state(sensor, memory)
    for part, context in zip(gathered, contexts, strict=True):
        outputs, new = _answer(sensor, kind, part, context, constants, state)
        state = {**state, **new}
        block_signal = _stacked(outputs, "signal", sensor.signal)
        samples.append(block_signal if block_signal.ndim == 4 else block_signal[:, None])
        answers.append(outputs)
    block_signal = samples[0] if len(samples) == 1 else torch.cat(samples, dim=1)
    new = {f"{sensor.name}:{name}": value for name, value in state.items()}
    return {sensor.name: block_signal.transpose(2, 3)}, new, answers


def _answer(
    sensor: PlannedSensor, kind: Kind, gathered: Gathered, context: Context, constants: Any, state: Tensors
) -> tuple[Tensors, Tensors]:
    """Return what a kind's `forward` returns, after a look at it."""
    answer = kind.forward(gathered, context, constants, kind.typed_state(state))
    if not torch.compiler.is_compiling():
        _check_answer(sensor, kind, answer, state)
    result, new = answer
    return dict(result), state_by_name(new)


def _check_answer(sensor: PlannedSensor, kind: Kind, answer: Any, state: Tensors) -> None:
    where = f'sensor "{sensor.name}": `forward` of the kind "{sensor.kind}" returns'
    is_pair = isinstance(answer, tuple) and len(answer) == 2
    if not (is_pair and isinstance(answer[0], Mapping) and isinstance(answer[1], kind.state or Mapping)):
        raise TgdslError(f"{where} {type(answer).__name__}, expected planes by channel, and the new state by name")
    outputs, new = answer[0], state_by_name(answer[1])
    if missing := [name for name in sensor.provides if name not in outputs]:
        raise TgdslError(f"{where} {listed(list(outputs)) or 'nothing'}, without {missing[0]}, which the kind provides")
    if missing := [name for name in sensor.signal if name not in outputs and "signal" not in outputs]:
        raise TgdslError(f"{where} {listed(list(outputs)) or 'nothing'}, without the channel {missing[0]}")
    num_rows = sensor.readings[0].num_rows
    for name in ("signal",) if "signal" in outputs else sensor.signal:
        if outputs[name].shape[-1] != num_rows:
            shape = tuple(outputs[name].shape)
            raise TgdslError(f"{where} {name} of shape {shape}, expected {num_rows} rows as its reading has, (env, {num_rows})")
    for name, value in new.items():
        if name not in state:
            state_names = listed(list(state)) or "none"
            raise TgdslError(f'{where} the state "{name}", which `Lowered.state` does not have: {state_names}')
        if value.shape != state[name].shape:
            shapes = f"{tuple(value.shape)}, expected {tuple(state[name].shape)}"
            raise TgdslError(f'{where} the state "{name}" of shape {shapes} as the old one')


def _stacked(found: Mapping[str, Tensor], name: str, channels: Sequence[str]) -> Float[Tensor, "env *sample channel row"]:
    return found[name] if name in found else torch.stack([found[channel] for channel in channels], dim=1)


def _kind_state(sensor: PlannedSensor, memory: Mapping[str, Tensor]) -> Tensors:
    return {name: memory[f"{sensor.name}:{name}"] for name in sensor.state if "/" not in name}


def _phase(phase: Float[Tensor, " env"], period: Tensor, now: Now) -> Float[Tensor, " env"]:
    """Return the time since a sample was due [s], at least −dt/2: each sample is read at the nearest call."""
    assert now.dt is not None
    since = phase + now.dt
    whole = torch.floor((since + 0.5 * now.dt) / period).clamp(min=0)
    return torch.where(now.age[:, 0] == 0, 0.0, since - whole * period)

"""From a Layout to a Plan: each kind lowers its sensors, the passes share what they ask for, each quantity plans its part."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from tgdsl.compiler import passes
from tgdsl.compiler.lowered import LoweredSensor, lowered_sensors
from tgdsl.compiler.passes import Joined, Numbered, Pruned, Shared
from tgdsl.compiler.patches import contact_parts, joints_matching, link_parts
from tgdsl.compiler.resolve import Resolved
from tgdsl.console.progress import Progress, silent
from tgdsl.errors import BakeError, LowerError, TgdslError, UnfeltWarning, did_you_mean
from tgdsl.formats.joints import RobotJoints
from tgdsl.formats.model import Model
from tgdsl.layout.layout import BURIED, COVERED, Layout, Unfelt, unfelt_ids
from tgdsl.module.state import SHAPES
from tgdsl.observations import observations
from tgdsl.observations.observations import (
    PROPRIOCEPTION,
    JointSpec,
    Observation,
    OfReading,
    ReadingObservation,
)
from tgdsl.placement.reach import unfelt
from tgdsl.plan import tree
from tgdsl.plan.inputs import ContactPart, Inputs
from tgdsl.plan.plan import Origin, Plan
from tgdsl.plan.scene import SceneFile
from tgdsl.plan.sensors import (
    PlannedAxis,
    PlannedHistory,
    PlannedMemory,
    PlannedNoise,
    PlannedObservation,
    PlannedReading,
    PlannedSensor,
)
from tgdsl.quantities.base import Planning, Quantity, heated_objects
from tgdsl.schema.load import Loaded
from tgdsl.schema.select import matching
from tgdsl.schema.yaml import Path
from tgdsl.sensors import Kind
from tgdsl.sensors.base import Axis, Channel, body_axis
from tgdsl.sensors.known import quantities_of

SHOWN = 8  # links and reasons that the warning names; the account of the module names all


def plan(loaded: Loaded, resolved: Resolved, kinds: tuple[Kind, ...], origin: Origin, progress: Progress = silent) -> Plan:
    """Return the Plan of a document, its scene still empty."""
    sensors, quantities = lowered_sensors(loaded, resolved, kinds, progress), quantities_of(kinds)
    joints = _joints_read(loaded, resolved)
    pruned = passes.prune(sensors, resolved.objects, resolved.link_bodies, resolved.scene)
    _report_hopeless(loaded, resolved.scene, pruned)
    object_parts, link_parts = _object_parts(loaded, resolved, sensors, pruned), _link_parts(loaded, resolved, sensors, pruned)
    joined = passes.join(sensors)
    shared = passes.share(sensors, joined, resolved.layout, quantities)
    numbered = passes.number(pruned, resolved.objects, shared.uses, quantities)
    used = tuple(quantity for quantity in quantities if quantity.name in shared.uses)
    parts = _quantity_parts(loaded, resolved, pruned, numbered, shared, used, joints.joints, progress)
    loaded.raise_problems()
    planned = tuple(_sensor(sensor, joined, shared, parts, used) for sensor in sensors)
    terms = _observations(loaded, planned, {sensor.name: sensor.layout for sensor in sensors}, joints)
    loaded.raise_problems()
    unfelt = unfelt_taxels(resolved, sensors, pruned)
    _warn_of_unfelt(loaded.source.file, unfelt, resolved.layout.num_taxels)
    proprioception = _proprioception({term.type for term in terms}, joints, resolved.joints)

    read = {reading.name for reading in proprioception} | {"body_pos", "body_quat"}.union(
        *(quantity.fields(parts[quantity.name]) for quantity in used)
    )
    varied = sorted((target for target in numbered.objects if target.varied >= 0), key=lambda target: target.varied)
    read |= {"variant"} if any(target.num_variants > 1 for target in varied) else set()
    read |= {"object_size"} if any(target.is_sized for target in varied) else set()
    heated = heated_objects(numbered.objects, resolved.objects) if {"object_temperature", "object_material"} & read else ()
    heats = [heat for name in heated if (heat := resolved.objects[name].heat) is not None]
    body_of = {target.name: target.body for target in numbered.objects}
    inputs = Inputs(
        fields=(*(name for name in SHAPES if name in read), *(["dt"] if any(map(_is_timed, sensors)) else [])),
        bodies=numbered.bodies,
        pairs=pruned.contact_pairs,
        bodies_of={pair.object: body_of[pair.object] for pair in pruned.contact_pairs},
        slots=max((use.request.num_slots for uses in shared.uses.values() for use in uses), default=0),
        objects=tuple(target.name for target in varied),
        num_variants=tuple(target.num_variants for target in varied),
        heated=heated,
        num_materials=tuple(len(heat.materials) for heat in heats),
        start_temperatures=tuple(heat.temperature if heat.is_per_env else None for heat in heats),
        joints=joints.joints,
        actuators=joints.actuators,
        contacts_of=object_parts,
        link_parts=link_parts,
        substeps=max((sensor.lowered.substeps for sensor in sensors), default=0) or 1,
        dt=max((sensor.lowered.timestep * max(sensor.lowered.substeps, 1) for sensor in sensors), default=0.0),
    )
    never = [(f"pair {pair.link} – {pair.object}", "they can never be in contact") for pair in pruned.dropped]
    result = Plan(
        origin=origin,
        inputs=inputs,
        layout=resolved.layout,
        objects=numbered.objects,
        pairs=numbered.table,
        quantities=parts,
        sensors=planned,
        proprioception=proprioception,
        observations=terms,
        dropped=(*resolved.unused, *never),
        unfelt=unfelt,
        scene=SceneFile("", {}, ()),
    )
    return tree.mapped(result, tree.frozen)


class JointsRead(NamedTuple):
    """The joints and actuators that a document reads."""

    terms: Mapping[tuple[str, int], tuple[str, ...]]  # of each observation term of joints, by group and number, in its order
    joints: tuple[str, ...]  # all that observations and sensors read, in the robot's order
    actuators: tuple[str, ...]


def _terms(loaded: Loaded) -> list[tuple[str, int, Observation]]:
    return [(group, i, spec) for group, terms in loaded.spec.observations.items() for i, spec in enumerate(terms)]


def _joints_read(loaded: Loaded, resolved: Resolved) -> JointsRead:
    robot, selected = resolved.joints, {}
    read: dict[str, set[str]] = {"joint": set().union(*resolved.on_joints.values()), "actuator": set()}
    for group, i, spec in _terms(loaded):
        if isinstance(spec, JointSpec):
            selected[group, i] = _rows(loaded, ("observations", group, i), spec, robot)
            read[PROPRIOCEPTION[spec.type].rows].update(selected[group, i])
    actuators = tuple(actuator.name for actuator in robot.actuators if actuator.name in read["actuator"])
    return JointsRead(selected, tuple(name for name in robot.joints if name in read["joint"]), actuators)


def _rows(loaded: Loaded, path: Path, spec: JointSpec, robot: RobotJoints) -> tuple[str, ...]:
    """Return the joints, or for a `last_action` the actuators, that an observation is of, in its order."""
    is_of_joints = PROPRIOCEPTION[spec.type].rows == "joint"
    selected: dict[str, None] = {}
    if spec.joints is None:
        names = robot.joints[: robot.num_actuated] if is_of_joints else tuple(actuator.name for actuator in robot.actuators)
        selected = dict.fromkeys(names)
        if not names:
            hint = 'name them: joints: ["*"]' if is_of_joints and robot.joints else ""
            loaded.note(path, f"the robot has no actuated joints, so there is no {spec.type} of them", hint)
    for k, pattern in enumerate(spec.joints or ()):
        hits = joints_matching(loaded, (*path, "joints", k), pattern, robot)
        if not is_of_joints and hits:
            joints, hits = hits, [actuator.name for actuator in robot.actuators if set(actuator.joints) & set(hits)]
            if not hits:
                problem = f"no actuator acts on {', '.join(joints)}"
                loaded.note((*path, "joints", k), problem, "so there is no last action of it")
        selected |= dict.fromkeys(hits)
    if "" in selected:
        problem = f"{'a joint' if is_of_joints else 'an actuator'} of the robot that this is of has no name"
        loaded.note(path, problem, "name it in the robot's file")
    return tuple(selected)


def _observations(
    loaded: Loaded, sensors: Sequence[PlannedSensor], layouts: Mapping[str, Layout], read: JointsRead
) -> tuple[PlannedObservation, ...]:
    """Return the observation terms in the document's order; mistakes are noted."""
    reading_of = {reading.name: (reading, layouts[sensor.name]) for sensor in sensors for reading in sensor.readings}
    terms: list[PlannedObservation] = []
    for group, i, spec in _terms(loaded):
        if isinstance(spec, OfReading):
            terms += _of_reading(loaded, group, i, spec, reading_of)
        elif isinstance(spec, JointSpec):
            selected, every = read.terms[group, i], read.joints if PROPRIOCEPTION[spec.type].rows == "joint" else read.actuators
            constants = {} if selected == every else {"rows": np.array([every.index(n) for n in selected], dtype=np.int64)}
            terms.append(PlannedObservation(group, i, spec.type, spec.type, (0,), len(selected), constants))
        else:
            count = observations.HAND_ONLY.get(spec.type_name, 0)
            terms.append(PlannedObservation(group, i, spec.type_name, None, (), count, {}))
    return tuple(terms)


def _of_reading(
    loaded: Loaded, group: str, i: int, spec: OfReading, readings: Mapping[str, tuple[PlannedReading, Layout]]
) -> list[PlannedObservation]:
    """Return the observation of a sensor's reading, or nothing if it is wrong."""
    path: Path = ("observations", group, i)
    if spec.of not in readings:
        loaded.note((*path, "of"), f'there is no reading "{spec.of}"', did_you_mean(spec.of, readings, "readings"))
        return []
    reading, layout = readings[spec.of]
    if isinstance(spec, ReadingObservation):
        channel_names: Sequence[str] = _channels(loaded, path, spec, reading)
    else:
        channel_names = spec.needs
        if reading.rows != spec.rows or not set(channel_names) <= set(reading.channels):
            needs = f"{', '.join(channel_names)} of each {spec.rows}"
            problem = f'"{spec.type_name}" needs {needs}, which "{spec.of}" does not read'
            loaded.note(path, problem, f"it reads {', '.join(reading.channels)} of each {reading.rows}")
            return []
    constants = dict(sorted(spec.lower(layout).items()))
    channels = tuple(reading.channels.index(channel) for channel in channel_names)
    per_call = spec.num_features(len(channels), reading.num_rows, len(layout.links))
    axes = spec.axes if isinstance(spec, observations.AggForceObservation) else ""
    return [PlannedObservation(group, i, spec.type_name, spec.of, channels, max(reading.steps, 1) * per_call, constants, axes)]


def _channels(loaded: Loaded, path: Path, spec: ReadingObservation, reading: PlannedReading) -> tuple[str, ...]:
    """Return the channels that a `reading` takes, each once, in the order in which they are first named."""
    selected: dict[str, None] = {}
    for k, pattern in enumerate(spec.channels or ("*",)):
        hits = matching(pattern, reading.channels)
        if not hits:
            problem = f'no channel of "{reading.name}" matches "{pattern}"'
            loaded.note((*path, "channels", k), problem, did_you_mean(pattern, reading.channels, "channels"))
        selected |= dict.fromkeys(hits)
    return tuple(selected)


def _proprioception(types: Collection[str], read: JointsRead, robot: RobotJoints) -> tuple[PlannedReading, ...]:
    """Return the readings of joints and actuators that are observed, in the order of `PROPRIOCEPTION`."""
    num_rows = {"joint": len(read.joints), "actuator": len(read.actuators)}
    is_slide = [name in robot.slides for name in read.joints]
    readings = []
    for name, quantity in PROPRIOCEPTION.items():
        if name in types:
            hinge, slide = quantity.units
            unit = hinge if hinge == slide or not any(is_slide) else slide if all(is_slide) else f"{hinge} or {slide}"
            readings.append(PlannedReading(name, quantity.rows, num_rows[quantity.rows], (quantity.channel,), (unit,)))
    return tuple(readings)


def unfelt_taxels(resolved: Resolved, sensors: Sequence[LoweredSensor], pruned: Pruned) -> tuple[Unfelt, ...]:
    """Return the taxels where some sensor cannot sense its objects.

    A sensor that reads contacts cannot on a body that is never in contact with its objects. If no object collides with a body,
    objects can enter it, and no taxel is too deep in it. Readings of bodies do not count.
    """
    layout, within = resolved.layout, resolved.reach
    names = np.array([link.body for link in layout.links], dtype=object)[layout.link_id]
    is_deaf, is_kept_out = np.zeros(layout.num_taxels, dtype=bool), np.zeros(layout.num_taxels, dtype=bool)
    is_deep = within.is_buried | (within.cover >= 0)
    for sensor in sensors:
        objects = {name for request in sensor.requests for name in request.objects}
        if not objects or sensor.rows.name != "taxel":
            continue
        if any(request.is_gated or request.wants_contacts for request in sensor.requests):
            met = {pair.link for pair in pruned.contact_pairs if pair.object in objects}
            is_deaf[sensor.taxels] |= ~np.isin(names[sensor.taxels], sorted(met))
        touched = set().union(*(resolved.objects[name].touched for name in objects))
        deep = sensor.taxels[is_deep[sensor.taxels]]
        for body in dict.fromkeys(names[deep]):
            geoms = [geom.id for geom in resolved.scene.rigid_geoms(resolved.link_bodies[body]) if geom.is_colliding]
            is_kept_out[deep[names[deep] == body]] |= resolved.scene.geoms_can_collide(geoms, touched)
    within = replace(
        within,
        is_collided=~is_deaf | (layout.radius == 0),
        is_buried=within.is_buried & is_kept_out,
        cover=np.where(is_kept_out, within.cover, -1),
    )
    return unfelt(resolved.colliders, layout, within)


def _warn_of_unfelt(file: str, found: Sequence[Unfelt], num_taxels: int) -> None:
    """Warn once of all taxels that cannot feel, by link and reason."""
    if found:
        problem = f"{len(unfelt_ids(found))} of {num_taxels} taxels cannot feel: {'; '.join(map(str, found[:SHOWN]))}"
        problem += f"; and {len(found) - SHOWN} more, see `explain`" if len(found) > SHOWN else ""
        ways = {BURIED: "`surface: collision`", COVERED: "`exposed: true`"}
        hints = [hint for reason, hint in ways.items() if any(taxels.reason == reason for taxels in found)]
        problem += f"; in the layout {' and '.join(hints)} would place them elsewhere" if hints else ""
        warnings.warn(f"{file}: {problem}", UnfeltWarning, stacklevel=3)


def _report_hopeless(loaded: Loaded, scene: Model, pruned: Pruned) -> None:
    """Note sensors that can never feel an object of theirs."""
    for sensor, target in pruned.hopeless:
        spec = loaded.spec.sensors[sensor]
        path: Path = ("sensors", sensor, "feels", list(spec.objects).index(target))
        if spec.is_gated:
            problem, hint = "the simulator does not collide them", "let them collide, or use `gate: geometric`"
            if flag := scene.flag_without_contacts:
                problem, hint = f'the scene\'s <option> has <flag {flag}="disable"/>', "take it out, or use `gate: geometric`"
            problem = f'"{target}" can never be in contact with a link of this sensor: {problem}'
        else:
            problem, hint = f'"{target}" and the links of this sensor are one rigid body', "put a joint between them"
        loaded.note(path, problem, hint)


Parts = dict[str, tuple[ContactPart, ...]]  # by name, the geoms whose contacts count, unless they are one whole body's


def _object_parts(loaded: Loaded, resolved: Resolved, sensors: Sequence[LoweredSensor], pruned: Pruned) -> Parts:
    """Return the geoms whose contacts are an object's; objects that share some of their geoms are a mistake."""
    objects = {}
    for name in sorted({pair.object for pair in pruned.contact_pairs}):
        sensed = resolved.objects[name]
        report = partial(loaded.note, ("objects", name, "surface"))
        parts = contact_parts(resolved.scene, sensed.bodies, sensed.touched, report)
        objects |= {name: parts} if parts != (ContactPart("body", sensed.body),) else {}
    for name, request in ((s.sensor, r) for s in sensors for r in s.requests if r.wants_contacts):
        for (_, first), (i, second) in itertools.combinations(enumerate(request.objects), 2):
            one, two = resolved.objects[first].touched, resolved.objects[second].touched
            if one & two and not (one <= two or two <= one):
                problem = f'"{second}" and "{first}" share some of their geoms, whose force would be counted twice'
                path: Path = ("sensors", name, "feels", i)
                loaded.note(path, problem, "give each a separate sensor, or separate surfaces")
    return objects


def _link_parts(loaded: Loaded, resolved: Resolved, sensors: Sequence[LoweredSensor], pruned: Pruned) -> Parts:
    """Return the geoms whose contacts are a link's; indistinguishable geoms are a mistake."""
    parts = {}
    for link in sorted({pair.link for pair in pruned.contact_pairs}):
        at: Path = ("sensors", next(sensor.sensor for sensor in sensors if link in sensor.layout.bodies), "links")

        def report(problem: str, hint: str, at: Path = at, link: str = link) -> None:
            loaded.note(at, f'body "{link}" and bodies welded to it: {problem}', hint)

        contact_geoms = link_parts(resolved.scene, resolved.link_bodies[link], report)
        parts |= {link: contact_geoms} if contact_geoms else {}
    return parts


def _quantity_parts(
    loaded: Loaded,
    resolved: Resolved,
    pruned: Pruned,
    numbered: Numbered,
    shared: Shared,
    asked: Sequence[Quantity],
    joints: tuple[str, ...],
    progress: Progress,
) -> dict[str, Any]:
    """Return the part of the Plan of each quantity, by its name; mistakes are noted."""
    planning = Planning(
        layout=resolved.layout,
        sensed=resolved.objects,
        pairs=pruned.pairs,
        contact_pairs=pruned.contact_pairs,
        objects=numbered.objects,
        bodies=numbered.bodies,
        geoms_of=resolved.geoms_of,
        report=loaded.note,
        progress=progress,
        joints=joints,
        anchors={name: resolved.anchor_of(name) for name in joints if name},
    )
    parts = {}
    for quantity in asked:
        uses = shared.uses[quantity.name]
        try:
            part = quantity.plan(planning, uses)
        except (LowerError, BakeError) as error:
            loaded.note(("sensors", uses[0].sensors[0]), error if isinstance(error, LowerError) else str(error))
            continue
        if not isinstance(part, quantity.part):
            problem = f"`plan` returns {type(part).__name__}, expected its part, {quantity.part.__name__}"
            raise TgdslError(f'quantity "{quantity.name}": {problem}')
        if unknown := sorted(set(quantity.fields(part)) - set(SHAPES)):
            hint = did_you_mean(unknown[0], SHAPES, "fields")
            raise TgdslError(f'quantity "{quantity.name}" reads the field {unknown[0]}; {hint}')
        parts[quantity.name] = part
    return parts


def _is_timed(sensor: LoweredSensor) -> bool:
    return sensor.kind.is_timed or sensor.spec.rate is not None or (sensor.noise is not None and sensor.noise.needs_dt)


def _sensor(
    sensor: LoweredSensor, joined: Joined, shared: Shared, parts: Mapping[str, Any], asked: Sequence[Quantity]
) -> PlannedSensor[np.ndarray]:
    """Return a sensor as the Plan has it."""
    lowered, spec, bodies = sensor.lowered, sensor.spec, body_axis(sensor.layout)
    report_rows = {key: lowered.report_rows.get(key, bodies) for key in lowered.reports}
    reports = [_reading(f"{sensor.sensor}/{key}", report_rows[key], channels, 0) for key, channels in lowered.reports.items()]
    readings = [_reading(name, sensor.rows, lowered.channels, _steps(sensor)) for name in sensor.readings]
    signal = tuple(channel.name for channel in lowered.signal or lowered.channels)
    noise = sensor.noise
    return PlannedSensor(
        name=sensor.name,
        sensor=sensor.sensor,
        kind=sensor.kind.name,
        links=sensor.layout.links,
        taxels=sensor.taxels,
        uses=shared.of_sensor.get(sensor.name, {}),
        joined=tuple(other.name for other in joined.get(sensor.name, ())),
        rows=passes.rows_of(sensor, joined),
        constants=dict(sorted(lowered.constants.items())),
        state=_state(sensor, shared, parts, asked, (len(signal), sensor.rows.size)),
        signal=signal,
        readings=(*readings, *reports),
        axes=(*[_axis(sensor.rows)] * len(readings), *[_axis(rows) for rows in report_rows.values()]),
        noise=None if noise is None else PlannedNoise(noise.terms, noise.streams, dict(sorted(noise.constants.items()))),
        period=0.0 if spec.rate is None else 1.0 / spec.rate,
        history=None if spec.history is None else PlannedHistory(spec.history.length, spec.history.reduce, spec.history.view),
        notes=lowered.notes,
        is_timed=sensor.kind.is_timed,
        substeps=lowered.substeps,
        upstream=sensor.upstream,
        provides=tuple(sorted(lowered.provides)),
        is_random=sensor.kind.is_random,
        timestep=lowered.timestep,
    )


def _steps(sensor: LoweredSensor) -> int:
    """Return the number of calls, or samples of a block, stacked in a sensor's reading; 0 if none."""
    history, lowered = sensor.spec.history, sensor.lowered
    if lowered.substeps:
        return lowered.substeps * max(lowered.samples, 1)
    return history.length if history is not None and history.reduce == "stack" else 0


def _reading(name: str, rows: Axis, channels: Sequence[Channel], steps: int) -> PlannedReading:
    return PlannedReading(name, rows.name, rows.size, tuple(c.name for c in channels), tuple(c.unit for c in channels), steps)


def _axis(rows: Axis) -> PlannedAxis:
    arrays = {name: column for name, column in rows.table.items() if isinstance(column, np.ndarray)}
    numbers = {name: column for name, column in arrays.items() if column.dtype.kind in "biuf"}
    texts = {name: tuple(map(str, column)) for name, column in rows.table.items() if name not in numbers}
    return PlannedAxis(rows.name, rows.size, texts, numbers)


def _state(
    sensor: LoweredSensor, shared: Shared, parts: Mapping[str, Any], asked: Sequence[Quantity], shape: tuple[int, int]
) -> dict[str, PlannedMemory]:
    """Return the memory that a sensor carries between calls; `shape`: its signal's shape."""
    memory = {}
    for name, part in sensor.lowered.state.items():
        rows = part.shape if isinstance(part.shape, tuple) else (sensor.rows.size,)
        if isinstance(part.shape, type):
            quantity = next(quantity for quantity in asked if quantity.request is part.shape)
            rows = (quantity.num_rows(parts[quantity.name], shared.of_sensor[sensor.name][quantity.name]),)
        memory[name] = PlannedMemory(part.rest, rows, overwritten=part.overwritten)
    if sensor.noise is not None:
        for name, past in sensor.noise.memory.items():
            memory[f"noise/{name}"] = PlannedMemory(0.0, shape, past)
    if sensor.spec.rate is not None:
        memory["sample/phase"] = PlannedMemory(0.0, ())
        held = ["measured", "clean"][: len(sensor.readings)]
        memory |= {f"sample/{which}": PlannedMemory(0.0, shape) for which in held}
    return memory

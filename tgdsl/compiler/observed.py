"""From a document's observations to the plan's: which channels of which readings, and which joints."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tgdsl.compiler.links import joints_matching
from tgdsl.compiler.resolve import Resolved
from tgdsl.errors import did_you_mean
from tgdsl.formats.joints import RobotJoints
from tgdsl.layout.layout import Layout
from tgdsl.observations import observations
from tgdsl.observations.observations import ObservationSpec, OfReading, ReadingObservation, ReadingSpec
from tgdsl.observations.proprioception import PROPRIOCEPTION, JointObservation, JointSpec
from tgdsl.plan.sensors import PlannedObservation, PlannedReading, PlannedSensor
from tgdsl.schema.loaded import Loaded
from tgdsl.schema.select import matching
from tgdsl.schema.yaml import Path


@dataclass(frozen=True)
class Observed:
    """What a document observes.

    Attributes:
        terms: The observation terms, in the document's order.
        proprioception: Readings of joints and actuators that some of them want.
    """

    terms: tuple[PlannedObservation, ...]
    proprioception: tuple[PlannedReading, ...]


@dataclass(frozen=True)
class Wanted:
    """The joints and actuators that a document reads.

    Attributes:
        rows: Those of each observation term of joints, by group and number, in its order.
        joints: Names of all joints that are read, by observations and sensors, in the robot's order.
        actuators: Names of all actuators that are read.
    """

    rows: Mapping[tuple[str, int], tuple[str, ...]]
    joints: tuple[str, ...]
    actuators: tuple[str, ...]


def wanted(loaded: Loaded, resolved: Resolved) -> Wanted:
    """Return the joints and actuators that a document reads."""
    all_joints, selected = resolved.joints, {}
    requested: dict[str, set[str]] = {"joint": set().union(*resolved.on_joints.values()), "actuator": set()}
    for group, i, spec in _terms(loaded):
        if isinstance(spec, JointObservation):
            selected[group, i] = _rows(loaded, ("observations", group, i), spec, all_joints)
            requested[PROPRIOCEPTION[spec.type].rows].update(selected[group, i])
    joints = tuple(name for name in all_joints.joints if name in requested["joint"])
    actuators = tuple(actuator.name for actuator in all_joints.actuators if actuator.name in requested["actuator"])
    return Wanted(selected, joints, actuators)


def _terms(loaded: Loaded) -> list[tuple[str, int, ObservationSpec]]:
    return [(group, i, spec) for group, terms in loaded.spec.observations.items() for i, spec in enumerate(terms)]


def observed(
    loaded: Loaded,
    resolved: Resolved,
    sensors: Sequence[PlannedSensor],
    layouts: Mapping[str, Layout],
    read: Wanted,
) -> Observed:
    """Return a document's observations; what is wrong with one is noted among the document's problems."""
    specs, all_joints, joints, actuators = _terms(loaded), resolved.joints, read.joints, read.actuators
    reading_of = {reading.name: (reading, layouts[sensor.name]) for sensor in sensors for reading in sensor.readings}
    terms: list[PlannedObservation] = []
    for group, i, spec in specs:
        if isinstance(spec, OfReading):
            terms += _of_reading(loaded, group, i, spec, reading_of)
        elif isinstance(spec, JointObservation):
            rows = joints if PROPRIOCEPTION[spec.type].rows == "joint" else actuators
            terms.append(_of_joints(group, i, spec, read.rows[group, i], rows))
        else:
            count = observations.HAND_ONLY.get(spec.type, 0)
            terms.append(PlannedObservation(group, i, spec.type, None, (), count, {}))
    return Observed(tuple(terms), _proprioception({spec.type for _, _, spec in specs}, joints, actuators, all_joints))


def _of_reading(
    loaded: Loaded,
    group: str,
    i: int,
    spec: ReadingSpec,
    found: Mapping[str, tuple[PlannedReading, Layout]],
) -> list[PlannedObservation]:
    """Return the observation of a sensor's reading, or nothing if it is wrong."""
    path: Path = ("observations", group, i)
    if spec.of not in found:
        loaded.note((*path, "of"), f'there is no reading "{spec.of}"', did_you_mean(spec.of, found, "readings"))
        return []
    reading, layout = found[spec.of]
    if isinstance(spec, ReadingObservation):
        wanted = _channels(loaded, path, spec, reading)
    else:
        wanted, rows = observations.WANTED[spec.type]
        if reading.rows != rows or not set(wanted) <= set(reading.channels):
            problem = f'"{spec.type}" needs {", ".join(wanted)} of each {rows}, which "{spec.of}" does not read'
            loaded.note(path, problem, f"it reads {', '.join(reading.channels)} of each {reading.rows}")
            return []
    constants = observations.lower(spec, layout)
    channels = tuple(reading.channels.index(channel) for channel in wanted)
    per_call = observations.num_features(spec.type, len(channels), reading.num_rows, len(layout.links))
    axes = spec.axes if isinstance(spec, observations.AggForceObservation) else ""
    count = max(reading.steps, 1) * per_call
    return [PlannedObservation(group, i, spec.type, spec.of, channels, count, dict(sorted(constants.items())), axes)]


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


def _rows(loaded: Loaded, path: Path, spec: JointSpec, own: RobotJoints) -> tuple[str, ...]:
    """Return the joints, or for a `last_action` the actuators, that an observation is of, in its order."""
    is_of_joints = PROPRIOCEPTION[spec.type].rows == "joint"
    selected: dict[str, None] = {}
    if spec.joints is None:
        names = own.joints[: own.num_actuated] if is_of_joints else tuple(actuator.name for actuator in own.actuators)
        selected = dict.fromkeys(names)
        if not names:
            hint = 'name them: joints: ["*"]' if is_of_joints and own.joints else ""
            loaded.note(path, f"the robot has no actuated joints, so there is no {spec.type} of them", hint)
    for k, pattern in enumerate(spec.joints or ()):
        hits = joints_matching(loaded, (*path, "joints", k), pattern, own)
        if not is_of_joints and hits:
            joints, hits = hits, [actuator.name for actuator in own.actuators if set(actuator.joints) & set(hits)]
            if not hits:
                problem = f"no actuator acts on {', '.join(joints)}"
                loaded.note((*path, "joints", k), problem, "so there is no last action of it")
        selected |= dict.fromkeys(hits)
    if "" in selected:
        problem = f"{'a joint' if is_of_joints else 'an actuator'} of the robot that this is of has no name"
        loaded.note(path, problem, "name it in the robot's file")
    return tuple(selected)


def _proprioception(
    types: Collection[str], joints: Sequence[str], actuators: Sequence[str], own: RobotJoints
) -> tuple[PlannedReading, ...]:
    """Return the readings of joints and actuators that are observed, in the order of `PROPRIOCEPTION`."""
    num_rows = {"joint": len(joints), "actuator": len(actuators)}
    is_slide = [name in own.slides for name in joints]
    readings = []
    for name, quantity in PROPRIOCEPTION.items():
        if name in types:
            hinge, slide = quantity.units
            unit = hinge if hinge == slide or not any(is_slide) else slide if all(is_slide) else f"{hinge} or {slide}"
            readings.append(PlannedReading(name, quantity.rows, num_rows[quantity.rows], (quantity.channel,), (unit,)))
    return tuple(readings)


def _of_joints(
    group: str,
    i: int,
    spec: JointSpec,
    chosen: Sequence[str],
    wanted: Sequence[str],
) -> PlannedObservation:
    is_all = list(chosen) == list(wanted)
    constants = {} if is_all else {"rows": np.array([wanted.index(name) for name in chosen], dtype=np.int64)}
    return PlannedObservation(group, i, spec.type, spec.type, (0,), len(chosen), constants)

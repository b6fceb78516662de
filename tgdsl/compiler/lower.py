"""From a Layout to a Plan: each kind lowers its sensors, the passes of `passes` settle the rest."""

from __future__ import annotations

import numpy as np

from tgdsl import observations
from tgdsl.compiler import passes
from tgdsl.compiler.felt import settle
from tgdsl.compiler.passes import Draft, DraftSensor
from tgdsl.compiler.resolve import Resolved
from tgdsl.errors import BakeError, did_you_mean
from tgdsl.plan import Origin, Plan, PlannedObservation, PlannedSensor, SceneFile
from tgdsl.schema.load import Loaded
from tgdsl.schema.yaml import Path
from tgdsl.sensors import Kind


def draft(loaded: Loaded, resolved: Resolved, kinds: tuple[Kind, ...]) -> Draft:
    """Lower every sensor of a document; nothing is shared or dropped yet."""
    by_name = {kind.name: kind for kind in kinds}
    sensors = []
    for name, spec in loaded.spec.sensors.items():
        kind = by_name[spec.kind]  # type: ignore[attr-defined]
        taxels = resolved.layout.taxels_of(resolved.links[name])
        lowered = kind.lower(spec, resolved.layout.take(taxels))
        readings = (name, f"{name}/clean") if spec.readout == "both" else (name,)
        sensors.append(DraftSensor(name, kind.name, taxels, spec.feels, spec.is_gated, lowered, readings))
    return Draft(resolved.layout, sensors, dict(resolved.objects), resolved.scene, list(resolved.unused))


def plan(loaded: Loaded, resolved: Resolved, kinds: tuple[Kind, ...], origin: Origin) -> Plan:
    """Return the Plan of a document, its scene still empty.

    Raises:
        SpecError: If an observation does not fit its sensor, or a sensor can never feel what it should.
    """
    work = draft(loaded, resolved, kinds)
    for sensor, target in passes.prune(work):
        path: Path = ("sensors", sensor, "feels", list(loaded.spec.sensors[sensor].feels).index(target))
        what = f'"{target}" can never be in contact with a link of this sensor: the simulator does not collide them'
        loaded.problems.append(loaded.problem(path, what, "let them collide, or use `gate: geometric`"))
    _settle(loaded, work)
    loaded.raise_problems()
    queries, answer_of = passes.share(work)
    arrays: dict[str, np.ndarray] = passes.fold(work)
    objects, inputs = passes.pack(work, queries, arrays)
    sensors = tuple(_sensor(part, answer_of[part.name], arrays) for part in work.sensors)
    terms = _observations(loaded, resolved, work, sensors, arrays)
    loaded.raise_problems()
    return Plan(
        origin=origin,
        inputs=inputs,
        links=work.layout.links,
        groups=work.layout.groups,
        objects=objects,
        queries=tuple(query.planned for query in queries),
        sensors=sensors,
        observations=terms,
        dropped=tuple(work.dropped),
        arrays={name: _frozen(arrays[name]) for name in sorted(arrays)},
        scene=SceneFile("", {}, ()),
    )


def _settle(loaded: Loaded, work: Draft) -> None:
    """Decide how the distance to each geom is found; a mesh that no grid within its budget suits is a mistake."""
    for name, felt in work.objects.items():
        target = loaded.spec.objects[name]
        margin = passes.margin(work, name)
        try:
            work.settled[name] = tuple(tuple(settle(geom, target, margin, name) for geom in geoms) for geoms in felt.variants)
        except BakeError as error:
            loaded.problems.append(loaded.problem(("objects", name), str(error)))


def _sensor(part: DraftSensor, place: tuple[int, int], arrays: dict[str, np.ndarray]) -> PlannedSensor:
    for name, value in part.lowered.constants.items():
        arrays[f"sensors/{part.name}/{name}"] = value
    return PlannedSensor(
        name=part.name,
        kind=part.kind,
        query=place[0],
        answer=place[1],
        channels=tuple(channel.name for channel in part.lowered.channels),
        units=tuple(channel.unit for channel in part.lowered.channels),
        constants=tuple(sorted(part.lowered.constants)),
        state=dict(part.lowered.state),
        readings=part.readings,
    )


def _observations(
    loaded: Loaded, resolved: Resolved, work: Draft, sensors: tuple[PlannedSensor, ...], arrays: dict[str, np.ndarray]
) -> tuple[PlannedObservation, ...]:
    by_reading = {reading: sensor for sensor in sensors for reading in sensor.readings}
    terms = []
    for group, specs in loaded.spec.observations.items():
        for i, spec in enumerate(specs):
            path: Path = ("observations", group, i)
            sensor = by_reading.get(spec.of)
            if sensor is None:
                hint = did_you_mean(spec.of, by_reading, "readings")
                loaded.problems.append(loaded.problem((*path, "of"), f'there is no reading "{spec.of}"', hint))
                continue
            wanted = observations.WANTED_CHANNELS[spec.type]
            lacking = [channel for channel in wanted if channel not in sensor.channels]
            if lacking:
                what = f'"{spec.type}" needs {", ".join(lacking)}, which "{spec.of}" ({sensor.kind}) does not read'
                loaded.problems.append(loaded.problem(path, what, f"it reads {', '.join(sensor.channels)}"))
                continue
            layout = resolved.layout.take(next(part.taxels for part in work.sensors if part.name == sensor.name))
            constants = observations.lower(spec, layout)
            for name, value in constants.items():
                arrays[f"observations/{group}/{i}/{name}"] = value
            terms.append(
                PlannedObservation(
                    group=group,
                    index=i,
                    type=spec.type,
                    reading=spec.of,
                    channels=tuple(sensor.channels.index(channel) for channel in wanted),
                    constants=tuple(sorted(constants)),
                    num_features=observations.num_features(spec.type, layout.num_taxels, len(layout.links)),
                )
            )
    return tuple(terms)


def _frozen(array: np.ndarray) -> np.ndarray:
    """Return an array in one of the Plan's dtypes, row by row in memory and read-only; only grids are float32."""
    kind = np.int64 if array.dtype.kind in "iub" else np.float32 if array.dtype == np.float32 else np.float64
    array = np.ascontiguousarray(array, dtype=kind).reshape(array.shape)
    array.flags.writeable = False
    return array

"""From a Layout to a Plan: each kind lowers its sensors, the passes of `passes` settle the rest."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Literal

import numpy as np

from tgdsl.compiler import passes
from tgdsl.compiler.felt import contact_parts, settle
from tgdsl.compiler.imperfections import imperfections, knobs_of, measured_spec
from tgdsl.compiler.observed import Observed, observed
from tgdsl.compiler.passes import Draft, DraftQuery, DraftSensor
from tgdsl.compiler.resolve import Resolved
from tgdsl.console.progress import Progress, silent
from tgdsl.errors import BakeError, LowerError
from tgdsl.layout.layout import Link
from tgdsl.plan.plan import (
    Inputs,
    Origin,
    Plan,
    PlannedHistory,
    PlannedMemory,
    PlannedNoise,
    PlannedReading,
    PlannedSensor,
    SceneFile,
)
from tgdsl.quantities.moments.tables import moment_tables
from tgdsl.quantities.points.tables import cloud, own_geoms, planned_skin
from tgdsl.schema.loaded import Loaded
from tgdsl.schema.objects import ObjectSpec
from tgdsl.schema.yaml import Path
from tgdsl.sensors import Kind
from tgdsl.sensors.base import Channel
from tgdsl.sensors.known import check_names
from tgdsl.sensors.noise.lower import LoweredNoise


def draft(loaded: Loaded, resolved: Resolved, kinds: tuple[Kind, ...], progress: Progress = silent) -> Draft:
    """Lower every sensor of a document; nothing is shared or dropped yet."""
    by_name = {kind.name: kind for kind in kinds}
    sensors: list[DraftSensor] = []
    for name, spec in loaded.spec.sensors.items():
        progress(f"lowering sensor {name}")
        try:
            sensors += _ways(loaded, resolved, name, by_name[spec.kind])  # type: ignore[attr-defined]
        except LowerError as error:
            path: Path = ("sensors", name, *([error.field] if error.field else []))
            loaded.problems.append(loaded.problem(path, error.what, error.hint))
    loaded.raise_problems()
    return Draft(resolved.layout, sensors, dict(resolved.objects), resolved.scene, list(resolved.unused))


def _ways(loaded: Loaded, resolved: Resolved, name: str, kind: Kind) -> list[DraftSensor]:
    """Return a sensor's measured and clean reading, computed together if noise comes after the equation alone."""
    spec = loaded.spec.sensors[name]
    taxels = resolved.layout.taxels_of(resolved.links[name])
    layout = resolved.layout.take(taxels)
    clean = kind.lower(spec, layout, resolved.surface_of)
    check_names(kind, clean)
    if spec.readout == "clean":
        return [DraftSensor(name, kind.name, spec, taxels, clean, f"sensors/{name}", (name,), None, kind.is_pointwise)]
    knobs = knobs_of(loaded, resolved, name, layout, kind)
    loaded.raise_problems()
    noisy = measured_spec(spec, knobs)
    lowered = clean if noisy is spec else kind.lower(noisy, layout, resolved.surface_of)
    noise = imperfections(name, spec, kind, knobs, lowered, layout, loaded.spec.noise)
    both = spec.readout == "both"
    if noise is not None and noise.radius > 0 and clean.moments is not None:
        request = dataclasses.replace(clean.moments, radius_noise=noise.radius)
        lowered = clean = dataclasses.replace(clean, moments=request)
    apart = noise is not None and (noise.radius > 0 or kind.decide is not None or kind.gains_depth)
    readings = (name, f"{name}/clean") if both and not apart else (name,)
    folder = f"sensors/{name}"
    ways = [DraftSensor(name, kind.name, spec, taxels, lowered, folder, readings, noise, kind.is_pointwise)]
    if both and apart:
        own = folder if lowered is clean else f"{folder}/clean"
        without = dataclasses.replace(clean, reports={})
        again = f"{name}/clean"
        ways.append(DraftSensor(again, kind.name, spec, taxels, without, own, (again,), None, kind.is_pointwise))
    return ways


def plan(loaded: Loaded, resolved: Resolved, kinds: tuple[Kind, ...], origin: Origin, progress: Progress = silent) -> Plan:
    """Return the Plan of a document, its scene still empty.

    Args:
        loaded: The document.
        resolved: What it means on its robot.
        kinds: The kinds that it may use.
        origin: What it was made of.
        progress: Is told what is done.

    Raises:
        SpecError: If a kind cannot be on its links, an observation does not fit its sensor, or a sensor can never feel what it
            should.
    """
    work = draft(loaded, resolved, kinds, progress)
    for name, target in passes.prune(work):
        sensor = name.removesuffix("/clean")
        path: Path = ("sensors", sensor, "feels", list(loaded.spec.sensors[sensor].feels).index(target))
        if loaded.spec.sensors[sensor].is_gated:
            what, hint = "the simulator does not collide them", "let them collide, or use `gate: geometric`"
            what = f'"{target}" can never be in contact with a link of this sensor: {what}'
        else:
            what, hint = f'"{target}" and the links of this sensor are one rigid body', "put a joint between them"
        loaded.problems.append(loaded.problem(path, what, hint))
    _settle_contacts(loaded, work)
    _settle(loaded, work, progress)
    _settle_moments(loaded, work, progress)
    _settle_points(loaded, resolved, work, progress)
    loaded.raise_problems()
    passes.join(work)
    queries, answer_of = passes.share(work)
    arrays: dict[str, np.ndarray] = passes.fold(work)
    objects, inputs = passes.pack(work, queries, arrays)
    sensors = tuple(_sensor(work, part, queries, answer_of[part.name], arrays) for part in work.sensors)
    layouts = {part.name: resolved.layout.take(part.taxels) for part in work.sensors}
    seen = observed(loaded, resolved, sensors, layouts, arrays)
    loaded.raise_problems()
    return Plan(
        origin=origin,
        inputs=_with_joints(inputs, seen),
        links=work.layout.links,
        groups=work.layout.groups,
        objects=objects,
        skin=planned_skin(work.skins),
        queries=tuple(query.planned for query in queries),
        sensors=sensors,
        proprioception=seen.proprioception,
        observations=seen.terms,
        dropped=tuple(work.dropped),
        arrays={name: _frozen(arrays[name]) for name in sorted(arrays)},
        scene=SceneFile("", {}, ()),
    )


def _settle_contacts(loaded: Loaded, work: Draft) -> None:
    """Decide which geoms' contacts are an object's; what cannot be told apart is a mistake."""
    for name in sorted({pair.object for pair in work.gated}):

        def report(what: str, hint: str, at: Path = ("objects", name, "surface")) -> None:
            loaded.problems.append(loaded.problem(at, what, hint))

        work.contacts_of[name] = contact_parts(work.scene, work.objects[name], report)
    for sensor in (sensor for sensor in work.sensors if "contacts" in sensor.lowered.needs):
        for (_, first), (i, second) in itertools.combinations(enumerate(sensor.feels), 2):
            one, two = work.objects[first].touched, work.objects[second].touched
            if one & two and not (one <= two or two <= one):
                what = f'"{second}" and "{first}" share some of their geoms, whose force would be counted twice'
                path: Path = ("sensors", sensor.sensor, "feels", i)
                loaded.problems.append(loaded.problem(path, what, "give each a sensor of its own, or surfaces apart"))


def _with_joints(inputs: Inputs, seen: Observed) -> Inputs:
    """Return a module's inputs with what its observations want besides."""
    own = [reading.name for reading in seen.proprioception]
    last = [name for name in inputs.fields if name == "dt"]
    fields = [name for name in inputs.fields if name not in last] + own + last
    return dataclasses.replace(inputs, fields=tuple(fields), joints=seen.joints, actuators=seen.actuators)


def _settle(loaded: Loaded, work: Draft, progress: Progress) -> None:
    """Decide how the distance to each geom is found; a mesh that no grid within its budget suits is a mistake."""
    for name, felt in work.objects.items():
        target = loaded.spec.objects[name]
        margin = passes.margin(work, name)
        if margin is None:
            continue
        try:
            rows = []
            for i, geoms in enumerate(felt.variants):
                which = f" ({i + 1} of {len(felt.variants)} variants)" if len(felt.variants) > 1 else ""
                progress(f"object {name}: distances{which}")
                rows.append(tuple(settle(geom, target, margin, f"object {name}") for geom in geoms))
            work.settled[name] = tuple(rows)
        except BakeError as error:
            loaded.problems.append(loaded.problem(("objects", name), str(error)))


def _settle_moments(loaded: Loaded, work: Draft, progress: Progress) -> None:
    """Compute the moments of objects beforehand; an object that has none, or too large ones, is a mistake."""
    for sensor in work.sensors:
        request = sensor.lowered.moments
        if request is None:
            continue
        path: Path = ("sensors", sensor.sensor)
        for i, name in enumerate(sensor.feels):
            users = [s for s in work.sensors if s.lowered.moments == request and name in s.feels]
            radii = sorted({float(r) for s in users for r in passes.reach_of(work, s) if r > 0})
            try:
                if (request, name) not in work.moments and radii:
                    progress(f"object {name}: moments of its surface")
                    work.moments[request, name] = moment_tables(work.objects[name], request, radii)
            except LowerError as error:
                loaded.problems.append(loaded.problem((*path, *(["feels", i] if error.field else [])), error.what, error.hint))
        areas = [work.moments[request, name].area for name in sensor.feels if (request, name) in work.moments]
        if request.with_area and len(areas) == len(sensor.feels) and not sum(area.min() for area in areas) > 0:
            what = f"{', '.join(sensor.feels)}: planes alone have no area to share the density among"
            loaded.problems.append(loaded.problem(path, what, "give `reference_area`, or feel an object that is no plane"))


def _settle_points(loaded: Loaded, resolved: Resolved, work: Draft, progress: Progress) -> None:
    """Sample objects, and decide how distances to the links that they meet are found; what has no surface is a mistake."""
    for sensor in (sensor for sensor in work.sensors if sensor.lowered.points is not None):
        request, path = sensor.lowered.points, ("sensors", sensor.sensor)
        assert request is not None
        for i, name in enumerate(sensor.feels):
            try:
                if (request.num_points, name) not in work.clouds:
                    progress(f"object {name}: points on its surface")
                    work.clouds[request.num_points, name] = cloud(work.objects[name], request.num_points)
            except LowerError as error:
                loaded.problems.append(loaded.problem((*path, "feels", i), error.what, error.hint))
        for link in work.layout.take(sensor.taxels).links:
            if link.name in work.skins:
                continue
            progress(f"link {link.name}: distances")
            margin = _skin_margin(work, link)
            geoms = own_geoms(resolved, link.name)
            try:
                settled = tuple(settle(geom, ObjectSpec(body=link.body), margin, f"link {link.name}") for geom in geoms)
                work.skins[link.name] = geoms, settled
            except BakeError as error:
                what = f'link "{link.name}": {error}'
                loaded.problems.append(loaded.problem((*path, "links"), what, "or use `anchors: taxels`"))


def _skin_margin(work: Draft, link: Link) -> float:
    """Return the largest distance from a link's own surface that any sensor on it asks for [m].

    Where sensors tell nothing apart outside the surface, the probes' radii say how deep points come.
    """
    found = []
    for sensor in work.sensors:
        own = work.layout.take(sensor.taxels)
        if sensor.lowered.points is not None and link in own.links:
            found += [sensor.lowered.points.range, float(own.radius.max())]
    return max(found)


def _sensor(
    work: Draft, part: DraftSensor, queries: Sequence[DraftQuery], place: tuple[int, int], arrays: dict[str, np.ndarray]
) -> PlannedSensor:
    lowered, num_taxels = part.lowered, len(part.taxels)
    for name, value in lowered.constants.items():
        arrays[f"{part.folder}/{name}"] = value
    rows = {"taxel": num_taxels, "body": len(work.layout.take(part.taxels).bodies)}
    history = part.spec.history
    steps = history.length if history is not None and history.reduce == "stack" else 0

    def reading(name: str, kind: Literal["taxel", "body"], channels: tuple[Channel, ...], steps: int) -> PlannedReading:
        return PlannedReading(name, kind, rows[kind], tuple(c.name for c in channels), tuple(c.unit for c in channels), steps)

    readings = [reading(name, lowered.rows, lowered.channels, steps) for name in part.readings]
    reports = [reading(f"{part.sensor}/{key}", "body", channels, 0) for key, channels in lowered.reports.items()]
    points = queries[place[0]].planned.answers[place[1]].points
    num_points = 0 if points is None else points.num_points * sum(map(len, points.links))
    shapes = {None: (num_taxels,), "points": (num_points,)}
    memory = {
        n: PlannedMemory(m.rest, m.shape if isinstance(m.shape, tuple) else shapes[m.shape]) for n, m in lowered.state.items()
    }
    signal = lowered.signal or lowered.channels
    shape = (len(signal), rows[lowered.rows])
    if part.noise is not None:
        for name, value in part.noise.constants.items():
            arrays[f"sensors/{part.name}/noise/{name}"] = value
        for term in part.noise.memory:
            past = part.noise.past if term == "ring" else 0.0
            memory[f"noise/{term}"] = PlannedMemory(0.0, shape, past)
    if part.spec.rate is not None:
        memory["sample/phase"] = PlannedMemory(0.0, ())
        held = ["measured", "clean"][: len(readings)]
        memory |= {f"sample/{which}": PlannedMemory(0.0, shape) for which in held}
    return PlannedSensor(
        name=part.name,
        sensor=part.sensor,
        kind=part.kind,
        query=place[0],
        answer=place[1],
        joined=tuple(other.name for other in part.joined),
        rows=_rows(part),
        folder=part.folder,
        constants=tuple(sorted(lowered.constants)),
        state=memory,
        signal=tuple(channel.name for channel in signal),
        readings=(*readings, *reports),
        noise=None if part.noise is None else _noise(part.noise),
        period=0.0 if part.spec.rate is None else 1.0 / part.spec.rate,
        history=None if history is None else PlannedHistory(history.length, history.reduce, history.view),
        notes=lowered.notes,
    )


def _rows(part: DraftSensor) -> tuple[int, int]:
    """Return which rows of its answer a sensor has: the first, and one beyond the last."""
    before = [len(other.taxels) for other in part.joined[: part.joined.index(part)]] if part.joined else []
    return sum(before), sum(before) + len(part.taxels)


def _noise(noise: LoweredNoise) -> PlannedNoise:
    return PlannedNoise(noise.terms, tuple(sorted(noise.constants)), noise.streams)


def _frozen(array: np.ndarray) -> np.ndarray:
    """Return an array in one of the Plan's dtypes, row by row in memory and read-only; only grids are float32."""
    kind = np.int64 if array.dtype.kind in "iub" else np.float32 if array.dtype == np.float32 else np.float64
    array = np.ascontiguousarray(array, dtype=kind).reshape(array.shape)
    array.flags.writeable = False
    return array

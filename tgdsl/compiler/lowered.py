"""From a document's sensors to what their kinds make of them: constants, state, requests and noise; nothing is shared yet."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tgdsl.compiler.resolve import Models, Resolved, taxels_of_all_links
from tgdsl.console.progress import Progress
from tgdsl.errors import LowerError, TgdslError, did_you_mean, listed
from tgdsl.fields.models import Selection
from tgdsl.fields.regions import RegionPart
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Request
from tgdsl.schema.load import Loaded
from tgdsl.schema.select import select
from tgdsl.schema.yaml import Path
from tgdsl.sensors import Kind
from tgdsl.sensors.base import AnySensorSpec, Axis, Fitting, Lowered, ReadSensor, body_axis, taxel_axis
from tgdsl.sensors.known import check_lowered
from tgdsl.sensors.noise import Knobs, built_in, resolve_noise
from tgdsl.sensors.noise.pipeline import LoweredNoise, lower_noise
from tgdsl.sensors.noise.spec import quantity
from tgdsl.surfaces.surface import Surface


@dataclass(frozen=True, eq=False)
class LoweredSensor:
    """One way to read a sensor, lowered."""

    name: str  # its name, see `plan.PlannedSensor`
    kind: Kind
    spec: AnySensorSpec
    taxels: np.ndarray  # its taxels, rows of the layout
    layout: Layout  # they, or its links if it is on links
    lowered: Lowered  # what its kind says of it
    readings: tuple[str, ...]  # names of its readings, reports left out
    noise: LoweredNoise | None  # its imperfections
    upstream: tuple[str, ...] = ()  # names of the sensors whose planes it reads, in order

    @property
    def sensor(self) -> str:
        """The sensor's name in the document."""
        return self.name.removesuffix("/clean")

    @property
    def radius_noise(self) -> float:
        """Largest disturbance of a radius [m]."""
        return 0.0 if self.noise is None else self.noise.radius

    @property
    def requests(self) -> tuple[Request, ...]:
        """What it asks of the scene."""
        return self.lowered.requests

    @property
    def rows(self) -> Axis:
        """What its own reading has rows of."""
        return rows_of(self.lowered, self.layout, self.spec)


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The triangles of a document's links and objects: a `sensors.base.SurfaceOf`."""

    loaded: Loaded
    resolved: Resolved
    progress: Progress

    def __call__(self, link: str, region: Sequence[RegionPart]) -> Surface:
        """Return the triangles of a link, or of a region of it, in its body's frame [m]."""
        return self.resolved.surface_of(link, region)

    def of_object(self, name: str) -> Surface:
        """Return the triangles of an object's geoms in its body's frame [m]."""
        return self.resolved.surface_of_object(name)

    def taxels(self, resolution: str, layout: Layout) -> Layout:
        """Return the taxels that another resolution of the layout puts on a sensor's links."""
        assert self.loaded.layout is not None
        names, layouts = self.loaded.layout.spec.resolutions, self.resolved.layouts
        if resolution not in names:
            hint = did_you_mean(resolution, names, "resolutions")
            raise LowerError(f'the layout has no resolution "{resolution}"', "markers", hint)
        if resolution not in layouts:
            spec = self.loaded.spec.model_copy(update={"resolution": resolution})
            models = Models(self.resolved.robot, self.resolved.scene)
            layouts[resolution] = taxels_of_all_links(dataclasses.replace(self.loaded, spec=spec), models)
        every, links = layouts[resolution], tuple(link.name for link in layout.links)
        if missing := [name for name in links if name not in {link.name for link in every.links}]:
            raise LowerError(f'the resolution "{resolution}" has no taxels on {listed(missing)}', "markers")
        return every.take(every.taxels_of(links))


def rows_of(lowered: Lowered, layout: Layout, spec: AnySensorSpec) -> Axis:
    """Return what a sensor's own reading has rows of: what its kind says, else its taxels, or its bodies if it has none."""
    if lowered.rows is not None:
        return lowered.rows
    return taxel_axis(layout) if spec.is_on_taxels and layout.num_taxels else body_axis(layout)


def lowered_sensors(loaded: Loaded, resolved: Resolved, kinds: Sequence[Kind], progress: Progress) -> tuple[LoweredSensor, ...]:
    """Lower every sensor of a document."""
    by_name = {kind.name: kind for kind in kinds}
    sensors: list[LoweredSensor] = []
    for name, spec in loaded.spec.sensors.items():
        progress(f"lowering sensor {name}")
        try:
            sensors += ways(loaded, resolved, name, by_name[spec.kind], progress)  # type: ignore[attr-defined]
        except LowerError as error:
            loaded.note(("sensors", name), error)
    loaded.raise_problems()
    sensors = _fit_all(loaded, sensors, resolved.scene.compiled.opt.timestep)
    blocks = [sensor for sensor in sensors if sensor.lowered.substeps]
    for sensor in blocks[1:]:
        first, substeps = blocks[0], sensor.lowered.substeps
        if substeps != first.lowered.substeps:
            problem = f'it is advanced at {substeps} physics steps of a call, "{first.sensor}" at {first.lowered.substeps}'
            loaded.note(("sensors", sensor.sensor), problem, "expected as many of all")
    loaded.raise_problems()
    return tuple(sensors)


def ways(loaded: Loaded, resolved: Resolved, name: str, kind: Kind, progress: Progress) -> list[LoweredSensor]:
    """Return a sensor's measured and clean reading, computed together if noise comes after the equation alone."""
    spec = loaded.spec.sensors[name]
    if getattr(spec, "timestep", 0.0) is None:
        spec = spec.model_copy(update={"timestep": float(resolved.scene.compiled.opt.timestep)})
    taxels, layout = resolved.layout_on(name)
    surfaces = Surfaces(loaded, resolved, progress)
    clean = kind.lower(spec, layout, surfaces)
    check_lowered(kind, clean, spec)
    _check_accuracy(loaded, name, clean)
    _check_places(kind, clean, layout, spec, resolved)
    if spec.readout == "clean":
        return [LoweredSensor(name, kind, spec, taxels, layout, clean, (name,), None)]
    knobs = _knobs_of(loaded, resolved, name, layout, kind)
    loaded.raise_problems()
    noisy = _measured_spec(spec, knobs)
    lowered = clean if noisy is spec else kind.lower(noisy, layout, surfaces)
    is_noisy = built_in(spec.noise, loaded.spec.noise) == "noisy"
    noise = _imperfections(name, spec, kind, knobs, lowered, layout, is_noisy)
    again, both = f"{name}/clean", spec.readout == "both"
    apart = both and noise is not None and (noise.radius > 0 or kind.decide is not None or kind.gains_depth)
    readings = (name, again) if both and not apart else (name,)
    measured = LoweredSensor(name, kind, spec, taxels, layout, lowered, readings, noise)
    without = dataclasses.replace(clean, reports={})
    return [measured, *([LoweredSensor(again, kind, spec, taxels, layout, without, (again,), None)] if apart else [])]


def _knobs_of(loaded: Loaded, resolved: Resolved, name: str, layout: Layout, kind: Kind) -> list[Knobs]:
    """Return the knobs of each link that carries a sensor; a pattern that matches none is a mistake."""
    written = loaded.spec.sensors[name].noise
    base, apart = resolve_noise(written, kind.name, loaded.spec.noise)
    of_links = [base] * len(layout.links)
    for pattern, knobs in apart:
        assert loaded.layout is not None
        groups, selection = loaded.layout.spec.groups, Selection(include=(pattern,))
        in_line = not isinstance(written, str) and pattern in written.links
        missing: list[tuple[str, str]] = []
        local, every = ([[link.name, link.body] for link in part.links] for part in (layout, resolved.layout))
        select(selection, local if in_line else every, groups, lambda _, text, hint, to=missing: to.append((text, hint)))
        for problem, hint in missing:
            path = ("sensors", name, "noise", "links", pattern) if in_line else ("sensors", name, "noise")
            loaded.note(path, problem if in_line else f'in the profile "{written}": {problem}', hint)
        for i in select(selection, local, groups, lambda *_: None):
            of_links[i] = knobs.over(of_links[i])
    return of_links


def _measured_spec(spec: AnySensorSpec, knobs: Sequence[Knobs]) -> AnySensorSpec:
    """Return the spec of the measured reading: knobs may set fields of the sensor."""
    released = [knob.release_threshold for knob in knobs if knob.release_threshold is not None]
    if not released:
        return spec
    lowest, highest = min(low for low, _ in released), max(high for _, high in released)
    threshold = getattr(spec, "threshold", None)
    if threshold is None:
        raise LowerError("release_threshold is of a sensor with a threshold, and this one has none", "noise", "leave it out")
    if highest > threshold:
        problem = f"release_threshold {highest:g} m is above the sensor's threshold {threshold:g} m"
        raise LowerError(problem, field="noise", hint="expected at most that")
    return spec.model_copy(update={"release_threshold": min(lowest, np.nextafter(threshold, 0.0))})


def _imperfections(
    name: str, spec: AnySensorSpec, kind: Kind, knobs: Sequence[Knobs], lowered: Lowered, layout: Layout, is_noisy: bool
) -> LoweredNoise | None:
    """Return the lowered noise of a sensor whose links have `knobs`; None if all of them are neutral.

    `is_noisy`: whether its noise is the built-in profile "noisy".
    """
    if not any(knob.active() for knob in knobs):
        if is_noisy:
            warnings.warn(f'sensor "{name}": the profile "noisy" has no knobs for {kind.name}, so it reads clean', stacklevel=2)
        return None
    rows, different = rows_of(lowered, layout, spec), list(dict.fromkeys(knob.model_dump_json() for knob in knobs))
    of_link = np.array([different.index(knob.model_dump_json()) for knob in knobs])
    sets = [knobs[int(np.flatnonzero(of_link == i)[0])] for i in range(len(different))]
    if any(knob.release_threshold is not None for knob in sets):
        released = Knobs.model_validate({"release_threshold": getattr(spec, "release", 0.0)})
        sets = [released.over(knob) if knob.release_threshold is None else knob for knob in sets]
    if rows.link_id is None and len(different) > 1:
        problem = f"its rows are on no link (they are of a {rows.name} each), so noise cannot differ between links"
        raise LowerError(problem, field="noise", hint="leave `links` of the noise out")
    which = of_link[rows.link_id] if rows.link_id is not None else np.zeros(rows.size, dtype=np.int64)
    if rows.name != "taxel" and any(knob.crosstalk is not None for knob in knobs):
        problem = f"crosstalk mixes neighbouring taxels, and this sensor reads one value per {rows.name}"
        raise LowerError(problem, field="noise", hint="leave `crosstalk` out")
    channels = [channel.name for channel in lowered.signal or lowered.channels]
    noise = lower_noise([_without_idle(name, kind, knob) for knob in sets], which, channels, layout)
    return noise if noise.terms else None


def _without_idle(name: str, kind: Kind, knobs: Knobs) -> Knobs:
    """Return knobs without the ones that change nothing in the kind's readings; warn of them."""
    idle = [knob for knob in knobs.active() if knob in kind.idle_knobs]
    for knob in idle:
        warnings.warn(f'sensor "{name}": {knob} changes nothing in what {kind.name} reads', stacklevel=2)
    return knobs.plain.model_validate({knob: knobs.defaults()[knob] for knob in idle}).over(knobs)


def _fit_all(loaded: Loaded, sensors: Sequence[LoweredSensor], timestep: float) -> list[LoweredSensor]:
    """Return sensors fitted to the scene's time step [s] and to their upstream sensors; mistakes are noted."""
    reading = {sensor.name: _upstream_of(loaded, sensor, sensors) for sensor in sensors}
    loaded.raise_problems()
    done: dict[str, LoweredSensor] = {}
    while ready := [s for s in sensors if s.name not in done and all(name in done for name in reading[s.name])]:
        for sensor in ready:
            names = reading[sensor.name]
            fitting = Fitting(timestep, {name: ReadSensor(done[name].lowered, done[name].rows) for name in names})
            try:
                done[sensor.name] = _fitted(sensor, fitting)
            except LowerError as error:
                loaded.note(("sensors", sensor.sensor), error)
                done[sensor.name] = sensor
    if circle := [sensor for sensor in sensors if sensor.name not in done]:
        names = " → ".join([*(sensor.sensor for sensor in circle), circle[0].sensor])
        loaded.note(("sensors", circle[0].sensor, circle[0].kind.reads), "sensors read one another in a circle", names)
    return [done.get(sensor.name, sensor) for sensor in sensors]


def _fitted(sensor: LoweredSensor, fitting: Fitting) -> LoweredSensor:
    """Return a sensor fitted to its upstream sensors."""
    lowered = sensor.lowered
    if sensor.kind.fit is not None:
        lowered = sensor.kind.fit(sensor.spec, lowered, fitting)
        check_lowered(sensor.kind, lowered, sensor.spec)
    for name, other in fitting.upstream.items():
        if other.lowered.substeps != lowered.substeps:
            substeps, read = lowered.substeps, other.lowered.substeps
            problem = f'it is advanced at {substeps} physics steps of a call, and reads "{name}", which is at {read}'
            raise TgdslError(f'kind "{sensor.kind.name}": {problem}; expected as many')
    return dataclasses.replace(sensor, lowered=lowered, upstream=tuple(fitting.upstream))


def _upstream_of(loaded: Loaded, sensor: LoweredSensor, sensors: Sequence[LoweredSensor]) -> tuple[str, ...]:
    """Return the names of a sensor's upstream sensors, each without noise; mistakes are noted."""
    upstream = sensor.lowered.upstream
    if upstream is None:
        return ()
    able = {
        candidate.sensor: candidate for candidate in sensors if upstream.planes <= candidate.lowered.provides
    }  # of two ways the second is clean
    if not upstream.sensors:
        if not able:
            problem = f"no sensor of the document makes {upstream.what}, so there is none to read"
            loaded.note(("sensors", sensor.sensor), problem)
        return tuple(candidate.name for candidate in able.values())
    for i, name in enumerate(upstream.sensors):
        path: Path = ("sensors", sensor.sensor, sensor.kind.reads, i)
        kinds = {candidate.sensor: candidate.kind.name for candidate in sensors}
        if name not in kinds:
            loaded.note(path, f'unknown sensor "{name}"', did_you_mean(name, kinds, "sensors"))
        elif name not in able:
            problem = f'"{name}" ({kinds[name]}) makes no {upstream.what}, as it is written'
            loaded.note(path, problem, f"sensors that do: {', '.join(able) or 'none'}")
        elif name in upstream.sensors[:i]:
            loaded.note(path, f'sensor "{name}" is listed twice', "name it once")
    return tuple(able[name].name for name in upstream.sensors if name in able)


def _check_places(kind: Kind, lowered: Lowered, layout: Layout, spec: AnySensorSpec, resolved: Resolved) -> None:
    """Refuse requests of unknown objects, and rows that disagree with the layout."""
    for request in lowered.requests:
        if request.wants_contacts and not request.objects:
            raise TgdslError(f'kind "{kind.name}": {type(request).__name__} is asked of no objects, expected at least one')
        if unknown := [name for name in request.objects if name not in resolved.objects]:
            problem = f'{type(request).__name__} is asked of "{unknown[0]}", which is none of the objects that its spec has'
            raise TgdslError(f'kind "{kind.name}": {problem}; its `objects`: {", ".join(spec.objects) or "none"}')
    rows = rows_of(lowered, layout, spec)
    sizes = {"taxel": layout.num_taxels, "body": len(layout.bodies)}
    if sizes.get(rows.name, rows.size) != rows.size:
        problem = f"its rows are {rows.size}, each called a {rows.name}, but the sensor has {sizes[rows.name]}"
        raise TgdslError(f'kind "{kind.name}": {problem}; give them another name, `Axis("…", {rows.size})`')
    link_id = rows.link_id
    if link_id is not None and (link_id.shape != (rows.size,) or ((link_id < 0) | (link_id >= len(layout.links))).any()):
        problem = (
            f"`link_id` of its rows has shape {link_id.shape}, expected ({rows.size},) of numbers below {len(layout.links)}"
        )
        raise TgdslError(f'kind "{kind.name}": {problem}')


def _check_accuracy(loaded: Loaded, name: str, lowered: Lowered) -> None:
    """Note an `accuracy` that does not match the sensor's quantities."""
    accuracy = loaded.spec.sensors[name].accuracy
    if accuracy is None:
        return
    units = {quantity(channel.name): channel.unit for channel in lowered.channels}
    at: Path = ("sensors", name, "accuracy")
    quantities = listed([f"{quantity} [{unit}]" for quantity, unit in units.items()])
    for key, bound in accuracy.bounds:
        path = (*at, key) if key else at
        if key and key not in units:
            loaded.note(path, f'the reading has no quantity "{key}"', did_you_mean(key, units, "quantities"), on_key=True)
        of = [key] if key in units else [] if key else units
        if any(bound.unit not in ("", units[quantity]) for quantity in of):
            loaded.note(path, f'"{bound.text}" is in {bound.unit}, and the reading has {quantities}', _hint(units))
    missing = [quantity for quantity in units if accuracy.of(quantity) is None]
    if missing:
        loaded.note(at, f"the reading has {listed(missing)} too, without a bound", "expected a bound of each quantity")


def _hint(units: Mapping[str, str]) -> str:
    fraction = 'expected a fraction of the largest change, such as "1 %"'
    if len(units) == 1 or "1" in units.values():
        amounts = {unit for unit in units.values() if unit != "1"}
        return f"{fraction}, or an amount in {amounts.pop()}" if len(units) == 1 and amounts else fraction
    each = ", ".join(f"{name}: {'1 %' if i else f'… {unit}'}" for i, (name, unit) in enumerate(units.items()))
    return f"{fraction}, or one of each: {{{each}}}"

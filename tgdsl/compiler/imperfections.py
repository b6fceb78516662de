"""Which knobs each taxel of a sensor has: those of its noise, those of some links apart, lowered."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence

import numpy as np

from tgdsl.compiler.resolve import Resolved
from tgdsl.errors import LowerError
from tgdsl.fields.models import Selection
from tgdsl.layout.layout import Layout, Link
from tgdsl.schema.loaded import Loaded
from tgdsl.schema.select import select
from tgdsl.sensors import Kind
from tgdsl.sensors.base import AnySensorSpec, Axis, Lowered
from tgdsl.sensors.noise import Knobs, NoiseSpec, built_in, resolve_noise
from tgdsl.sensors.noise.lower import LoweredNoise, lower_noise


def measured_spec(spec: AnySensorSpec, knobs: Sequence[Knobs]) -> AnySensorSpec:
    """Return the spec of the measured reading: knobs may set what is a field of the sensor's own.

    Raises:
        LowerError: If such a knob does not fit the sensor.
    """
    released = [own.release_threshold for own in knobs if own.release_threshold is not None]
    if not released:
        return spec
    lowest, highest = min(low for low, _ in released), max(high for _, high in released)
    threshold = getattr(spec, "threshold", None)
    if threshold is None:
        raise LowerError("release_threshold is of a sensor with a threshold, and this one has none", "noise", "leave it out")
    if highest > threshold:
        what = f"release_threshold {highest:g} m is above the sensor's threshold {threshold:g} m"
        raise LowerError(what, field="noise", hint="expected at most that")
    return spec.model_copy(update={"release_threshold": min(lowest, np.nextafter(threshold, 0.0))})


def knobs_of(loaded: Loaded, resolved: Resolved, name: str, layout: Layout, kind: Kind) -> list[Knobs]:
    """Return the knobs of each link that carries a sensor; a pattern that matches none is a mistake."""
    spec = loaded.spec.sensors[name]
    base, apart = resolve_noise(spec.noise, kind.name, loaded.spec.noise)
    own = [base] * len(layout.links)
    for pattern, knobs in apart:
        for i in _matching(loaded, resolved, name, layout.links, pattern):
            own[i] = knobs.over(own[i])
    return own


def _matching(loaded: Loaded, resolved: Resolved, name: str, links: Sequence[Link], pattern: str) -> list[int]:
    assert loaded.layout is not None
    spec = loaded.spec.sensors[name]
    in_line = not isinstance(spec.noise, str) and pattern in spec.noise.links
    missing: list[tuple[str, str]] = []
    among = links if in_line else resolved.layout.links

    def chosen(candidates: Sequence[Link], report: list[tuple[str, str]]) -> list[int]:
        assert loaded.layout is not None
        names = [[link.name, link.body] for link in candidates]
        groups = loaded.layout.spec.groups
        return select(Selection(include=(pattern,)), names, groups, lambda _, what, hint: report.append((what, hint)))

    chosen(among, missing)
    for what, hint in missing:
        path = ("sensors", name, "noise", "links", pattern) if in_line else ("sensors", name, "noise")
        loaded.problems.append(loaded.problem(path, what if in_line else f'in the profile "{spec.noise}": {what}', hint))
    return chosen(links, [])


def imperfections(
    name: str,
    spec: AnySensorSpec,
    kind: Kind,
    knobs: Sequence[Knobs],
    lowered: Lowered,
    rows: Axis,
    layout: Layout,
    named: Mapping[str, NoiseSpec],
) -> LoweredNoise | None:
    """Return the lowered noise of a sensor; None if all its knobs are neutral.

    Args:
        name: The sensor's name.
        spec: Its spec.
        kind: Its kind.
        knobs: The knobs of each of its links.
        lowered: The sensor, lowered.
        rows: What its reading has rows of.
        layout: Its taxels.
        named: The noise profiles of the document.

    Raises:
        LowerError: If a knob names a quantity that the sensor does not read.
    """
    if not any(own.active() for own in knobs):
        if built_in(spec.noise, named) == "noisy":
            warnings.warn(f'sensor "{name}": the profile "noisy" has no knobs for {kind.name}, so it reads clean', stacklevel=2)
        return None
    different = list(dict.fromkeys(own.model_dump_json() for own in knobs))
    of_link = np.array([different.index(own.model_dump_json()) for own in knobs])
    sets = [knobs[int(np.flatnonzero(of_link == i)[0])] for i in range(len(different))]
    if any(own.release_threshold is not None for own in sets):
        release = getattr(spec, "release", 0.0)
        sets = [
            Knobs.model_validate({"release_threshold": release}).over(own) if own.release_threshold is None else own
            for own in sets
        ]
    if rows.link_id is None and len(different) > 1:
        what = f"its rows are on no link (they are of a {rows.name} each), so noise cannot differ between links"
        raise LowerError(what, field="noise", hint="leave `links` of the noise out")
    which = of_link[rows.link_id] if rows.link_id is not None else np.zeros(rows.size, dtype=np.int64)
    if rows.name != "taxel" and any(own.crosstalk is not None for own in knobs):
        what = f"crosstalk mixes neighbouring taxels, and what this sensor reads is of a {rows.name} each"
        raise LowerError(what, field="noise", hint="leave `crosstalk` out")
    channels = [channel.name for channel in lowered.signal or lowered.channels]
    sets = [_without_idle(name, kind, own) for own in sets]
    noise = lower_noise(sets, which, channels, layout, rows.name == "taxel")
    return noise if noise.terms else None


def _without_idle(name: str, kind: Kind, knobs: Knobs) -> Knobs:
    """Return knobs without those that change nothing in what the kind reads, of which a warning says so."""
    idle = [knob for knob in knobs.active() if knob in kind.idle_knobs]
    for knob in idle:
        warnings.warn(f'sensor "{name}": {knob} changes nothing in what {kind.name} reads', stacklevel=2)
    neutral = {knob: Knobs.model_fields[knob].default for knob in idle}
    return Knobs.model_validate(neutral).over(knobs)

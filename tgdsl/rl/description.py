"""The features of each group of observations in order: name, unit, frame, link and scale.

A task describes its own groups by `Task.describe`, a document's term its group by `ObservationTerm.describe`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Any

import numpy as np

from tgdsl.console.tables import text_table
from tgdsl.observations.observations import PerLink
from tgdsl.rl.groups import link_forces, runs_of
from tgdsl.rl.load import LoadedTask
from tgdsl.rl.sensors import Source, TaskSensors, sensors_document
from tgdsl.rl.task import Features, Task
from tgdsl.rl.terms import ObservationTerm, Term

HEADER = ("group", "features", "what", "unit", "frame", "link", "scale", "note")


class Description(dict[str, tuple[tuple[slice, Features], ...]]):
    """The features of each group with their slices; it prints as a table."""

    def rows(self) -> list[tuple[str, ...]]:
        """Return the cells under `HEADER`, a row for adjacent features of one kind."""
        return [
            (
                group,
                f"{place.start}:{place.stop}",
                each.name + (f", rows {each.rows.start}:{each.rows.stop} of {each.sensor}" if each.rows else ""),
                each.unit,
                each.frame or "–",
                each.link or "–",
                f"{each.scale:g}",
                each.note,
            )
            for group, features in self.items()
            for place, each in features
        ]

    def __repr__(self) -> str:
        return text_table(HEADER, self.rows())


def describe(
    loaded: LoadedTask, sensors: TaskSensors, task: Task[Any], terms: Mapping[str, Term], sizes: Mapping[str, int]
) -> Description:
    """Return the features of each group of observations."""
    setup, substeps = task.setup, loaded.spec.physics.substeps if loaded.spec.temporal == "stack" else 0
    names, is_slide = setup.actuators.names, setup.actuators.is_slide.tolist()
    by_group: dict[str, Sequence[Features]] = {
        "proprio": _joints(names, is_slide, loaded.spec.proprio.vel_scale),
        "priv_proprio": [*_joints(names, is_slide, 1.0), *link_forces(setup.links)],
    }
    by_group |= {name: _touch(sensors, source, substeps) for name, source in sensors.groups.items()} | dict(task.describe())
    by_group |= {name: term.describe(setup) for name, term in terms.items() if isinstance(term, ObservationTerm)}
    result, notes = {}, _notes(loaded)
    for group, size in sizes.items():
        features = [
            replace(each, note=notes.get(each.sensor, "")) for each in by_group.get(group) or [Features("not described", size)]
        ]
        stops = np.cumsum([each.size for each in features]).tolist()
        result[group] = tuple((slice(stop - each.size, stop), each) for stop, each in zip(stops, features, strict=True))
    return Description(result)


def _notes(loaded: LoadedTask) -> dict[str, str]:
    """Return by sensor where its readings are cut off."""
    notes = {}
    for name, sensor in sensors_document(loaded).spec.sensors.items():
        if (most := getattr(sensor, "max_range", None)) is not None:
            notes[name] = f"at most {most:g} m"
        elif getattr(sensor, "gate", None) == "contact_pair":
            notes[name] = "0 while the solver has no contact of link and object"
    return notes


def _joints(names: Sequence[str], is_slide: Sequence[bool], vel_scale: float) -> list[Features]:
    units = ["m" if each else "rad" for each in is_slide]
    pos = [Features(f"position of {name}", 1, unit) for name, unit in zip(names, units, strict=True)]
    vel = [Features(f"velocity of {name}", 1, f"{unit}/s", scale=vel_scale) for name, unit in zip(names, units, strict=True)]
    return pos + vel + [Features(f"last action of {name}", 1) for name in names]


def _touch(sensors: TaskSensors, source: Source, substeps: int) -> list[Features]:
    """Return the features of a group of touch: by physics step if these are stacked, then channel, then link."""
    touch = sensors.touch
    (term,) = (term for term in touch.plan.observations if term.group == source.observation)
    assert term.reading is not None
    (output,) = (output for output in touch.outputs if output.name == term.reading)
    table, spec = touch.rows[term.reading], source.spec
    links = table["link" if "link" in (table.dtype.names or ()) else "body"].tolist()
    if isinstance(spec, PerLink):
        links, channels = list(dict.fromkeys(links)), spec.features
    else:
        frame = "link" if len(spec.needs) > 1 else ""
        channels = tuple((output.channels[i], output.units[i], frame, 1.0) for i in term.channels)
    columns = range(term.num_features) if source.columns is None else source.columns.tolist()
    has_calls, features = term.num_features > len(channels) * len(links), []
    for index, group in groupby(columns, key=lambda column: column // len(links)):
        call, channel = divmod(index, len(channels))
        name, unit, frame, scale = channels[channel]
        for link, rows in runs_of(links, [column % len(links) for column in group]):
            text = f"{name} of call {call}" if has_calls else name
            places = range(0) if isinstance(spec, PerLink) else rows
            features.append(Features(text, len(rows), unit, frame, link, scale, places, term.reading))
    steps = [replace(each, name=f"{each.name} of physics step {step}") for step in range(substeps) for each in features]
    return steps or features

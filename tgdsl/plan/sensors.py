"""Sensors and observations as the Plan has them.

Shapes: `taxel` taxels of one sensor, `row` rows of a reading, `channel` numbers per row, `end` 1, or 2 for a range.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, Literal, TypeVar

import numpy as np

from tgdsl.layout.layout import Link
from tgdsl.plan.tree import INLINE

Array = TypeVar("Array")


@dataclass(frozen=True, eq=False)
class PlannedAxis:
    """What the rows of a reading are, for users.

    Attributes:
        name: What one is called: "taxel", "body", "voxel", …
        size: How many there are.
        texts: Columns of a table with a row for each, by name: texts.
        numbers: Columns of numbers, (row, …).
    """

    name: str
    size: int
    texts: Mapping[str, tuple[str, ...]]
    numbers: Mapping[str, np.ndarray]


@dataclass(frozen=True)
class PlannedReading:
    """One entry of a module's readings: its name, what it has rows of, name and unit of each channel.

    `steps` calls, or samples of a block, are stacked in it, oldest first; 0: it is of one call and has no such dimension.
    """

    name: str
    rows: str
    num_rows: int
    channels: tuple[str, ...]
    units: tuple[str, ...]
    steps: int = 0


@dataclass(frozen=True)
class PlannedMemory:
    """What a sensor carries from one call to the next: its value at rest, and its shape after the leading `env`.

    With `past` it is a ring of what was so at each call of so many seconds before the present one, (env, call, *shape). What
    is `overwritten` a kernel may write over in place.
    """

    rest: float
    shape: tuple[int, ...]
    past: float = 0.0
    overwritten: bool = False


@dataclass(frozen=True, eq=False)
class PlannedNoise(Generic[Array]):
    """The imperfections of a sensor.

    Attributes:
        terms: The stages there are, in their order, see `sensors.noise.pipeline`.
        constants: Values that they read, ([end,] channel, row), see `sensors.noise.pipeline`.
        streams: What random numbers are drawn for, see `sensors.noise.random`.
    """

    terms: tuple[str, ...]
    streams: tuple[int, ...]
    constants: Mapping[str, Array] = field(metadata=INLINE)


@dataclass(frozen=True)
class PlannedHistory:
    """How many calls a reading holds or combines, how, and whether a stack of them is a view of the memory."""

    length: int
    reduce: Literal["stack", "last", "median", "mean"]
    view: bool = False


@dataclass(frozen=True, eq=False)
class PlannedSensor(Generic[Array]):
    """One way to read a sensor: what is computed for it alone.

    A sensor that is read both clean and measured is computed once where noise comes after its equation, else twice.

    Attributes:
        name: Its name, `touch`, or `touch/clean` where another one is the measured sensor.
        sensor: The sensor's name in the document.
        kind: Its kind.
        links: The links that carry it.
        taxels: Its taxels, rows of the layout.
        uses: What it asked for: by quantity the number of the use.
        joined: The sensors that are computed as one, in the order of the uses' rows; empty if it is alone.
        rows: Which of the uses' rows are its own: the first, and one beyond the last.
        constants: What its kind folded.
        state: What it carries from one call to the next: the kind's own, `noise/…` and `sample/…`.
        signal: Channels of the signal that noise and sampling act on.
        readings: Its readings: first its own, measured if it has noise; then the clean one, if that is read too; then reports.
        axes: What their rows are, one for each.
        noise: Its imperfections.
        period: Time between its samples [s]; 0: it takes one at every call.
        history: What is read of the last calls.
        notes: What an account of it says of its parameters, line by line.
        is_timed: Whether its kind wants to know when it is called: see `sensors.base.Context`.
        substeps: Physics steps of a call that it is advanced at; 0: once per call.
        upstream: Sensors whose planes it reads, see `sensors.upstream`: they are evaluated before it.
        provides: Planes that it has for others.
        is_random: Whether its kind draws random numbers of its own.
        timestep: Time between the calls of its kind that its constants are made for [s]; 0: any will do.
    """

    name: str
    sensor: str
    kind: str
    links: tuple[Link, ...]
    taxels: Array
    uses: Mapping[str, int]
    joined: tuple[str, ...]
    rows: tuple[int, int]
    state: Mapping[str, PlannedMemory]
    signal: tuple[str, ...]
    readings: tuple[PlannedReading, ...]
    axes: tuple[PlannedAxis, ...]
    constants: Mapping[str, Array] = field(metadata=INLINE)
    noise: PlannedNoise[Array] | None
    period: float
    history: PlannedHistory | None
    notes: tuple[str, ...]
    is_timed: bool
    substeps: int
    upstream: tuple[str, ...]
    provides: tuple[str, ...]
    is_random: bool
    timestep: float

    @property
    def wants_clock(self) -> bool:
        """Whether it needs the time of a reading: for chance, noise with memory, its rate or its kind."""
        return (
            self.is_timed
            or self.is_random
            or bool(self.noise and self.noise.streams)
            or any("/" in name for name in self.state)
        )

    @property
    def own_readings(self) -> tuple[PlannedReading, ...]:
        """Its readings without reports: the measured one, the clean one, or both."""
        return tuple(reading for reading in self.readings if reading.name in (self.name, f"{self.name}/clean"))

    @property
    def windows(self) -> tuple[PlannedReading, ...]:
        """Those of its readings whose last calls are remembered."""
        return () if self.history is None or self.history.reduce == "last" else self.own_readings


@dataclass(frozen=True, eq=False)
class PlannedObservation(Generic[Array]):
    """One term of an observation group.

    Attributes:
        group: The group.
        index: Which of its terms.
        type: Its type.
        reading: The reading that is observed; None if it is of none.
        channels: Channels of the reading.
        constants: What was folded for it; `rows` of joints or actuators that are observed, if not all.
        num_features: How many features it gives.
        axes: Order of the link-frame axes of an aggregate force; else empty.
    """

    group: str
    index: int
    type: str
    reading: str | None
    channels: tuple[int, ...]
    num_features: int
    constants: Mapping[str, Array] = field(metadata=INLINE)
    axes: Literal["", "xyz", "zyx"] = ""

    @property
    def key(self) -> str:
        """Where its constants are: the group and its number."""
        return f"{self.group}/{self.index}"

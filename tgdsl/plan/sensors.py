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
    """What the rows of a reading are, for users."""

    name: str  # what one is called: "taxel", "body", "voxel", …
    size: int  # how many there are
    texts: Mapping[str, tuple[str, ...]]  # columns of a table with a row for each, by name: texts
    numbers: Mapping[str, np.ndarray]  # columns of numbers, (row, …)


@dataclass(frozen=True)
class PlannedReading:
    """One entry of a module's readings: its name, the axis of its rows, name and unit of each channel.

    `steps` calls, or samples of a block, are stacked in it, oldest first; 0: it is of one call and has no such dimension.
    """

    name: str
    rows: str
    num_rows: int
    channels: tuple[str, ...]
    units: tuple[str, ...]
    steps: int = 0

    @property
    def shape(self) -> tuple[int, ...]:
        """Its shape after `env`."""
        return (*([self.steps] if self.steps else []), self.num_rows, len(self.channels))


@dataclass(frozen=True)
class PlannedMemory:
    """What a sensor carries from one call to the next: its value at rest, and its shape after the leading `env`.

    With `past` [s] it is a ring of the values at all calls in that time before the present one, (env, call, *shape). A kernel
    may write an `overwritten` memory in place.
    """

    rest: float
    shape: tuple[int, ...]
    past: float = 0.0
    overwritten: bool = False


@dataclass(frozen=True, eq=False)
class PlannedNoise(Generic[Array]):
    """The imperfections of a sensor."""

    terms: tuple[str, ...]  # the stages there are, in their order, see `sensors.noise.pipeline`
    streams: tuple[int, ...]  # what random numbers are drawn for, see `sensors.noise.random`
    constants: Mapping[str, Array] = field(metadata=INLINE)  # ([end,] channel, row), see `sensors.noise.pipeline`


@dataclass(frozen=True)
class PlannedHistory:
    """How many calls a reading holds or combines, how, and whether a stack of them is a view of the memory."""

    length: int
    reduce: Literal["stack", "last", "median", "mean"]
    view: bool


@dataclass(frozen=True, eq=False)
class PlannedSensor(Generic[Array]):
    """One way to read a sensor: the computation that it does not share.

    A sensor that is read both clean and measured is computed once where noise comes after its equation, else twice.
    """

    name: str  # its name, `touch`, or `touch/clean` where another one is the measured sensor
    sensor: str  # the sensor's name in the document
    kind: str
    links: tuple[Link, ...]  # the links that carry it
    taxels: Array  # its taxels, rows of the layout
    uses: Mapping[str, int]  # index of its use, by quantity
    joined: tuple[str, ...]  # the sensors that are computed as one, in the order of the uses' rows; empty if it is alone
    rows: tuple[int, int]  # its rows among the uses' rows: the first, and one beyond the last
    state: Mapping[str, PlannedMemory]  # its state between calls: the kind's, `noise/…` and `sample/…`
    signal: tuple[str, ...]  # channels of the signal that noise and sampling act on
    readings: tuple[PlannedReading, ...]  # its own, measured if it has noise; the clean one, if read too; reports
    axes: tuple[PlannedAxis, ...]  # axis of each reading's rows
    constants: Mapping[str, Array] = field(metadata=INLINE)  # constants of its kind
    noise: PlannedNoise[Array] | None  # its imperfections
    period: float  # time between its samples [s]; 0: it takes one at every call
    history: PlannedHistory | None  # how it combines the last calls
    notes: tuple[str, ...]  # lines about its parameters in a report
    is_timed: bool  # whether its kind needs the time of a call: see `sensors.base.Context`
    substeps: int  # physics steps of a call that it is advanced at; 0: once per call
    upstream: tuple[str, ...]  # sensors whose planes it reads, see `sensors.upstream`: they are evaluated before it
    provides: tuple[str, ...]  # planes that it has for others
    is_random: bool  # whether its kind draws random numbers
    timestep: float  # time between calls that its constants assume [s]; 0: any

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
        """Its readings that have a history."""
        return () if self.history is None or self.history.reduce == "last" else self.own_readings


@dataclass(frozen=True, eq=False)
class PlannedObservation(Generic[Array]):
    """One term of an observation group."""

    group: str  # the group
    index: int  # which of its terms
    type: str  # its type
    reading: str | None  # the reading that is observed; None if it is of none
    channels: tuple[int, ...]  # channels of the reading
    num_features: int  # how many features it gives
    constants: Mapping[str, Array] = field(metadata=INLINE)  # `rows`: joints or actuators that are observed, if not all
    axes: Literal["", "xyz", "zyx"] = ""  # order of the link-frame axes of an aggregate force; else empty

    @property
    def key(self) -> str:
        """Where its constants are: the group and its number."""
        return f"{self.group}/{self.index}"

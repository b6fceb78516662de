"""What a sensor kind is: a spec, an equation, and how it is lowered and computed.

A kind is one file that holds, in this order: what it measures, its spec, `reference` (the definition, float64), `lower`
(constants, state, requests; no physics), `forward` (batched, in component planes), and last a `Kind` that ties them together.

Shapes: `env` environments, `taxel` taxels of one sensor, `body` bodies that carry it, `row` rows of a reading.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float, Int, UInt64
from pydantic import Field
from torch import Tensor

from tgdsl.console.progress import Progress
from tgdsl.fields.accuracy import AccuracyField
from tgdsl.fields.history import History
from tgdsl.fields.models import Frequency, Selector, SpecModel, Usual
from tgdsl.fields.regions import RegionPart
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Gathered, Quantity, Request
from tgdsl.sensors.noise import BASE, NoiseField
from tgdsl.sensors.noise.random import Stream
from tgdsl.sensors.upstream import Upstream
from tgdsl.surfaces.surface import Surface


class AnySensorSpec(SpecModel):
    """What every kind of sensor has, wherever it is. A kind's own spec adds `kind: Literal["its_name"]` and its parameters."""

    noise: NoiseField = "clean"
    """A noise profile's name, or the knobs in line."""
    readout: Literal["clean", "measured", "both"] = "measured"
    """`measured` with the imperfections of `noise`, `clean` without, or `both`: `<name>` and `<name>/clean`."""
    rate: Annotated[Frequency | None, Usual("frequency", low=0.1, high=1e5)] = None
    """How often the sensor takes a sample, which it reads until the next one [Hz]; default: at every call."""
    history: History | None = None
    """How many calls are read, `stack`ed or reduced: `history: 5`, or `history: {length: 5, reduce: mean}`."""
    accuracy: AccuracyField = None
    """RMS error that its reading may have on states of the scene, before noise: a fraction of the largest change, `1 %`, an
    amount, `0.02 mm`, or one of each quantity, `{force: 5 mN, torque: 1 %}`. The cheapest fields that hold it are then chosen
    among those that nobody wrote, here and in the objects that it feels."""
    is_on_taxels: ClassVar[bool] = True
    """Whether `links` chooses among the links that the layout gives taxels; else among all bodies of the robot."""
    needs_taxels: ClassVar[bool] = True
    """Whether it reads its taxels. One that does not may be in a document without a layout, on any of the robot's bodies."""

    @property
    def objects(self) -> tuple[str, ...]:
        """Objects that the sensor feels; none by default."""
        return ()

    @property
    def named_bodies(self) -> Mapping[str, str]:
        """Bodies of the scene that the spec names, by the field that does; none by default."""
        return {}

    @property
    def is_gated(self) -> bool:
        """Whether an object counts only while the simulator has it in contact with the taxel's link."""
        return False


class SensorSpec(AnySensorSpec):
    """A sensor that some links carry."""

    links: Selector
    """Links that carry the sensor: a link group, names, shell wildcards, or include/exclude."""


class OnJointsSpec(AnySensorSpec):
    """A sensor that has a place on each of some joints; its layout's links are called as these are, on the bodies they move."""

    joints: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """Names or shell wildcards of hinges and slides; default: the robot's actuated joints, in the order of the actuators."""
    is_on_taxels: ClassVar[bool] = False
    needs_taxels: ClassVar[bool] = False


class LinkSpec(SensorSpec):
    """A sensor that has a place on each link, whether the link has taxels or not."""

    is_on_taxels: ClassVar[bool] = False
    needs_taxels: ClassVar[bool] = False


class ProbeSpec(SensorSpec):
    """A sensor whose taxels are spherical probes that feel objects."""

    feels: Annotated[tuple[str, ...], Field(min_length=1)]
    """Objects that the probes can feel."""

    @property
    def objects(self) -> tuple[str, ...]:
        """Objects that the sensor feels."""
        return self.feels


class ContactProbeSpec(ProbeSpec):
    """Probes that feel what their link touches."""

    gate: Literal["contact_pair", "geometric"] = "contact_pair"
    """When an object is felt: `contact_pair` only while the simulator has it in contact with the taxel's link (the paper);
    `geometric` whenever a probe's sphere reaches into it, so a 4 mm probe feels it 4 mm before it touches."""

    @property
    def is_gated(self) -> bool:
        """Whether an object counts only while the simulator has it in contact with the taxel's link."""
        return self.gate == "contact_pair"


@dataclass(frozen=True)
class Channel:
    """One number per taxel: its name and unit."""

    name: str
    unit: str


@dataclass(frozen=True)
class Memory:
    """A tensor (env, *shape) that is carried from one call to the next.

    Attributes:
        rest: Its value at rest.
        shape: Its shape; None: (row,) of the kind's own reading; a type of request: as many rows as its value has.
        overwritten: Whether a kernel may write the new state over the old; it is then left out of what `forward` returns.
    """

    rest: float = 0.0
    shape: tuple[int, ...] | type[Request] | None = None
    overwritten: bool = False


@dataclass(frozen=True, eq=False)
class Axis:
    """What the rows of a reading are.

    Attributes:
        name: What one is called: "taxel", "body", "voxel", "sample", …
        size: How many there are.
        table: Columns of a table for users, a row for each: texts, or arrays (row, …).
        link_id: Which of the layout's links each row is on, for noise that differs between links; None: they are on none.
    """

    name: str
    size: int
    table: Mapping[str, Sequence[str] | np.ndarray] = field(default_factory=dict)
    link_id: Int[np.ndarray, " row"] | None = None


def taxel_axis(layout: Layout) -> Axis:
    """Return a row for each taxel."""
    return Axis("taxel", layout.num_taxels, {}, layout.link_id)


def body_axis(layout: Layout) -> Axis:
    """Return a row for each body that carries the sensor, in order."""
    first = [[link.body for link in layout.links].index(body) for body in layout.bodies]
    return Axis("body", len(layout.bodies), {"body": layout.bodies}, np.array(first, dtype=np.int64))


@dataclass(frozen=True, eq=False)
class Lowered:
    """A sensor, ready to be planned.

    Attributes:
        channels: What the sensor's own reading holds, in order.
        constants: Arrays that `forward` gets as tensors.
        state: What is carried from one call to the next.
        requests: What is asked of the scene, at most one of each type.
        rows: What the reading has one row of; None: of each taxel, or of each body if the kind is not on taxels.
        reports: Further readings: `<sensor>/<name>` holds these channels, with a row per body.
        report_rows: What the rows of a report are, where they are not bodies.
        notes: What an account of the sensor says of its parameters, line by line.
        signal: What `forward` returns, if the kind decides: what noise acts on.
        substeps: Physics steps of a call at each of which `forward` is called; the reading is then a block of so many samples,
            or of so many times `samples`. 0: it is called once per call, with the state of the last one.
        samples: Samples of a block that `forward` returns at once, as "signal" (env, sample, channel, row); 0: it is none.
        provides: Planes that `forward` returns for other sensors to read, of those of `Kind.provides`.
        sound: Samples of sound that it provides at each call of `forward`; 0: none, see `sensors.upstream`.
        upstream: What it asks of other sensors: `forward` gets it as `gathered[Upstream]`, see `sensors.upstream`.
        timestep: Time between the calls of `forward` that its constants are made for [s]; 0: any will do. Where the time
            between calls is another one, a warning says so.
    """

    channels: tuple[Channel, ...]
    constants: Mapping[str, np.ndarray] = field(default_factory=dict)
    state: Mapping[str, Memory] = field(default_factory=dict)
    requests: tuple[Request, ...] = ()
    rows: Axis | None = None
    reports: Mapping[str, tuple[Channel, ...]] = field(default_factory=dict)
    report_rows: Mapping[str, Axis] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    signal: tuple[Channel, ...] | None = None
    substeps: int = 0
    samples: int = 0
    timestep: float = 0.0
    provides: frozenset[str] = frozenset()
    sound: int = 0
    upstream: Upstream | None = None


class ReadSensor(NamedTuple):
    """A sensor that another one reads: what its kind made of it, and what it has rows of."""

    lowered: Lowered
    rows: Axis


class Fitting(NamedTuple):
    """What is known once all that a sensor reads is lowered.

    Attributes:
        timestep: Time of a physics step of the scene [s].
        upstream: The sensors that it reads, by their names, in order.
    """

    timestep: float
    upstream: Mapping[str, ReadSensor]


class Context(NamedTuple):
    """When a kind is called. Only a kind that `is_timed` may look: to others it is `UNTIMED`, which holds nothing.

    Attributes:
        dt: Time since the last call, or the last substep [s], a scalar.
        step: Number of this call of each environment, (env, 1).
        substep: Which substep of the call this is, from 0.
        time: Time since each environment's reset [s], (env, 1); 0 at the first call after it.
        is_first: Whether it is the first call after each environment's reset, (env, 1).
        stream: Random words of this call, or this substep, of a kind that `is_random`: see `noise.random`.
    """

    dt: Tensor
    step: Tensor
    substep: int
    time: Tensor
    is_first: Tensor
    stream: Stream | None = None


UNTIMED = Context(*[None] * 5)  # type: ignore[arg-type]
"""What a kind gets that does not want to know the time."""


class ReferenceContext(NamedTuple):
    """The same for one environment, in numbers."""

    dt: float
    step: int
    substep: int
    time: float
    is_first: bool
    words: Callable[[UInt64[np.ndarray, "*word"]], UInt64[np.ndarray, "*word"]]
    """Returns the random words of this call, or this substep, by their numbers: those of `Context.stream`."""


@runtime_checkable
class SurfaceOf(Protocol):
    """Triangles of links and objects."""

    def __call__(self, link: str, region: Sequence[RegionPart]) -> Surface:
        """Return the triangles of a link, by its name, or of a region of it, in its body's frame [m]."""
        ...

    def of_object(self, name: str) -> Surface:
        """Return the triangles of an object's geoms, by its name, in its body's frame [m]; of several variants the first."""
        ...

    def taxels(self, resolution: str, layout: Layout) -> Layout:
        """Return the taxels that another resolution of the document's layout puts on the links of a sensor's layout."""
        ...

    @property
    def progress(self) -> Progress:
        """Is told what is done with them, where that takes long."""
        ...


Array = TypeVar("Array")
"""`np.ndarray` where constants are made, `Tensor` where they are read."""
Constants = Mapping[str, Tensor]
"""Constants of a kind without a dataclass for them."""
State = Mapping[str, Tensor]
ReferenceState = Mapping[str, np.ndarray]
Planes = Mapping[str, Tensor]
Kept = dict[str, np.ndarray]
ReferenceAnswer = tuple[np.ndarray, Kept] | tuple[np.ndarray, Kept, Mapping[str, np.ndarray]]
"""A reading (row, channel), or (sample, row, channel) of a block, and what is kept; and planes, where a kind provides them."""


class Alternative(NamedTuple):
    """Another choice of a sensor's or an object's fields that reads the same thing, at another error and another cost.

    Attributes:
        label: What to call it: `svd, 0.1 %`.
        changes: Fields and what they are then, as a document has them; None: left out.
        unused: Fields that mean nothing then: who wrote one of them does not want this choice.
        is_exact: Whether it is exact but for rounding, so that errors of others may be measured against it and it may be chosen
            without one.
        is_other: Whether what is read then has another shape, or other times: `accuracy` never chooses it.
    """

    label: str
    changes: Mapping[str, Any]
    unused: tuple[str, ...] = ()
    is_exact: bool = False
    is_other: bool = False


Warn = Callable[[str, Mapping[str, np.ndarray], Sequence[str], np.ndarray], Sequence[str]]


def no_alternatives(spec: Any) -> Sequence[Alternative]:
    """Return no alternatives: nothing in a spec trades speed for error."""
    return ()


def no_indices(constants: Mapping[str, np.ndarray], num_taxels: int) -> Mapping[str, int]:
    """Return of how many things constants are indices: none is one."""
    return {}


@dataclass(frozen=True)
class Kind:
    """A kind of sensor.

    Attributes:
        spec: Its pydantic model; `kind` is a `Literal` with the kind's name.
        lower: `(spec, layout, surface_of) → Lowered`; the layout holds the sensor's own taxels, or no taxels and its links. May
            raise `LowerError`.
        forward: `(gathered, context, constants, state) → (planes by channel name, new state)`: planes (env, row), at least
            those of the channels; pure, traceable; the new state is like the old. Where all channels are one tensor
            (env, channel, row) already it stands for them, as "signal", or of a report as "<report>/signal".
        reference: `(spec, layout, gathered, context, state) → (reading (row, channel), new state)` for one environment, in
            NumPy: what was asked for is what the quantities' references return; of a block it is called once per substep.
        decide: `(planes, constants, state) → (planes, new state)`, if the reading is made of the signal by a threshold: what
            `forward` returns is then the signal, which noise disturbs first.
        knobs: Names of the noise knobs that it has.
        gains_depth: Whether a gain is of the depth that `forward` gets rather than of the reading; of rows that are taxels.
        idle_knobs: Those of its knobs that change nothing in what it reads.
        is_pointwise: Whether each row of what `forward` returns is of one taxel alone. Sensors on different taxels may then be
            computed as one, where they have no state, and parameters that are scalars are given as (taxel,).
        is_timed: Whether it wants to know when it is called: a clock is kept, and the state's `dt` is wanted.
        is_random: Whether it draws random numbers of its own, from `Context.stream`.
        retimed: `(constants, dt) → constants`: those of its constants that depend on the time between calls of `forward` [s],
            again. The module calls it whenever that time is another one than `Lowered.timestep`, or was at the last call.
        quantities: Quantities of its own that it asks for, which no installed package brings.
        indices: `(constants, number of taxels) → {name: count}` of those constants that are indices, of so many things.
        alternatives: `(spec) → choices` of fields that trade speed for error, from coarse to fine: errors of all of them are
            measured against the last that can be had. One that the spec does not allow, or its links do not, is left out.
        provides: Planes that `forward` can return beside its channels for other sensors to read, see `sensors.upstream`:
            it does so for those of `Lowered.provides`, and `reference` returns them too, by name, as a third value.
        reads: The field of its spec that names sensors that it reads, if it does so.
        warns: Names of its state, and `(sensor's name, constants, rows of the sensors that it reads, largest numbers of all
            environments) → messages`: what users are to be warned of, each once.
        fit: `(spec, lowered, fitting) → Lowered`, if sizes follow from the scene's time step, or from sensors that it reads.
        constants: A dataclass with a field for each constant, None where it may be left out: `forward` and `decide` get one,
            and `lower` makes `Lowered.constants` of one by `by_name`. None: they get a mapping.
    """

    spec: type[AnySensorSpec]
    lower: Callable[[Any, Layout, SurfaceOf], Lowered]
    forward: Callable[[Gathered, Context, Any, State], tuple[Planes, State]]
    reference: Callable[[Any, Layout, Any, ReferenceContext, ReferenceState], ReferenceAnswer]
    decide: Callable[[Planes, Any, State], tuple[Planes, State]] | None = None
    knobs: frozenset[str] = BASE
    gains_depth: bool = False
    idle_knobs: frozenset[str] = frozenset()
    is_pointwise: bool = False
    is_timed: bool = False
    is_random: bool = False
    retimed: Callable[[Mapping[str, np.ndarray], float], Mapping[str, np.ndarray]] | None = None
    quantities: tuple[Quantity, ...] = ()
    indices: Callable[[Mapping[str, np.ndarray], int], Mapping[str, int]] = no_indices
    alternatives: Callable[[Any], Sequence[Alternative]] = no_alternatives
    provides: frozenset[str] = frozenset()
    reads: str = ""
    warns: tuple[tuple[str, Warn], ...] = ()
    fit: Callable[[Any, Lowered, Fitting], Lowered] | None = None
    constants: type[Any] | None = None

    def typed(self, constants: Mapping[str, Tensor]) -> Any:
        """Return constants as `forward` gets them."""
        return constants if self.constants is None else self.constants(**constants)

    @property
    def name(self) -> str:
        """The kind's name in the grammar."""
        (name,) = self.spec.model_fields["kind"].annotation.__args__  # type: ignore[union-attr]
        return name


def by_name(constants: Any) -> dict[str, np.ndarray]:
    """Return the fields of a dataclass of constants as `Lowered.constants` has them, without those that are None."""
    fields = {part.name: getattr(constants, part.name) for part in dataclasses.fields(constants)}
    return {name: value for name, value in fields.items() if value is not None}


def scalar(value: float) -> Float[np.ndarray, ""]:
    """Return a parameter as the array that `Lowered.constants` wants."""
    return np.asarray(value, dtype=np.float64)

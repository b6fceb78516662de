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
from tgdsl.fields.models import Frequency, History, Selector, SpecModel, Usual
from tgdsl.fields.regions import RegionPart
from tgdsl.geometry.planes import Vec
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Gathered, Quantity, Request
from tgdsl.sensors.noise import BASE, NoiseField
from tgdsl.sensors.noise.random import Stream
from tgdsl.sensors.upstream import Upstream
from tgdsl.surfaces.surface import Surface


class AnySensorSpec(SpecModel):
    """Fields of every kind. A kind's spec adds `kind: Literal["its_name"]` and its parameters."""

    noise: NoiseField = "clean"
    """A noise profile's name, or the knobs in line."""
    readout: Literal["clean", "measured", "both"] = "measured"
    """`measured` with the imperfections of `noise`, `clean` without, or `both`: `<name>` and `<name>/clean`."""
    rate: Annotated[Frequency | None, Usual("frequency", low=0.1, high=1e5)] = None
    """Sample rate [Hz]; between samples the reading is held; default: a sample at every call."""
    history: History | None = None
    """Calls in a reading, stacked or reduced: `history: 5`, or `history: {length: 5, reduce: mean}`."""
    accuracy: AccuracyField = None
    """Largest RMS error of the reading over states of the scene, before noise: a fraction of the largest change, `1 %`, an
    amount, `0.02 mm`, or one per quantity, `{force: 5 mN, torque: 1 %}`. Fields that the document leaves out, here and in the
    sensed objects, then get the cheapest values that meet it."""
    is_on_taxels: ClassVar[bool] = True
    """Whether `links` chooses among the links that the layout gives taxels; else among all bodies of the robot."""
    needs_taxels: ClassVar[bool] = True
    """Whether it reads its taxels. A kind that does not works without a layout, on any body of the robot."""

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
    """A sensor on joints: its layout has a link for each joint, with the joint's name, on the body that the joint moves."""

    joints: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    """Names or shell wildcards of hinges and slides; default: the robot's actuated joints, in the order of the actuators."""
    is_on_taxels: ClassVar[bool] = False
    needs_taxels: ClassVar[bool] = False


class LinkSpec(SensorSpec):
    """A sensor on links, with or without taxels."""

    is_on_taxels: ClassVar[bool] = False
    needs_taxels: ClassVar[bool] = False


class ProbeSpec(SensorSpec):
    """A sensor whose taxels are spherical probes that sense objects."""

    feels: Annotated[tuple[str, ...], Field(min_length=1)]
    """Objects that the probes sense."""

    @property
    def objects(self) -> tuple[str, ...]:
        """Objects that the sensor feels."""
        return self.feels


class ContactProbeSpec(ProbeSpec):
    """Probes that sense objects in contact with their link."""

    gate: Literal["contact_pair", "geometric"] = "contact_pair"
    """When probes sense an object: `contact_pair` only while the simulator has it in contact with the taxel's link (the paper);
    `geometric` whenever a probe's sphere overlaps it, so a 4 mm probe senses it 4 mm before contact."""

    @property
    def is_gated(self) -> bool:
        """Whether an object counts only while the simulator has it in contact with the taxel's link."""
        return self.gate == "contact_pair"


@dataclass(frozen=True)
class Channel:
    """A number per row of a reading: its name and unit."""

    name: str
    unit: str


def vector(name: str, unit: str) -> tuple[Channel, ...]:
    """Return the channels of a vector's components."""
    return tuple(Channel(f"{name}_{axis}", unit) for axis in "xyz")


def components(name: str, planes: Vec) -> dict[str, Tensor]:
    """Return a vector's planes by its channels."""
    return {f"{name}_{axis}": plane for axis, plane in zip("xyz", planes, strict=True)}


@dataclass(frozen=True)
class Memory:
    """A tensor (env, *shape) that is carried from one call to the next."""

    rest: float = 0.0  #: its value after a reset
    #: its shape; None: (row,) of the reading; a type of request: the rows of that quantity's value
    shape: tuple[int, ...] | type[Request] | None = None
    overwritten: bool = False  #: whether a kernel may overwrite it in place; `forward` then returns no new value


@dataclass(frozen=True, eq=False)
class Axis:
    """The rows of a reading."""

    name: str  #: noun for a row: "taxel", "body", "voxel", "sample", …
    size: int  #: number of rows
    #: columns of a table for users: texts, or arrays (row, …)
    table: Mapping[str, Sequence[str] | np.ndarray] = field(default_factory=dict)
    #: the layout's link of each row, for noise that differs between links; None: rows are on no link
    link_id: Int[np.ndarray, " row"] | None = None


def taxel_axis(layout: Layout) -> Axis:
    """Return a row for each taxel."""
    return Axis("taxel", layout.num_taxels, {}, layout.link_id)


def body_axis(layout: Layout) -> Axis:
    """Return a row for each body that carries the sensor, in order."""
    first = [[link.body for link in layout.links].index(body) for body in layout.bodies]
    return Axis("body", len(layout.bodies), {"body": layout.bodies}, np.array(first, dtype=np.int64))


def _named(constants: Any, path: str = "") -> dict[str, Any]:
    """Return the arrays of dataclasses, mappings and tuples by their paths, without None."""
    if dataclasses.is_dataclass(constants):
        constants = {part.name: getattr(constants, part.name) for part in dataclasses.fields(constants)}
    elif isinstance(constants, tuple):
        constants = {str(i): part for i, part in enumerate(constants)}
    if not isinstance(constants, Mapping):
        return {} if constants is None else {path: constants}
    parts = [_named(part, f"{path}/{name}" if path else name) for name, part in constants.items()]
    return {name: array for part in parts for name, array in part.items()}


@dataclass(frozen=True, eq=False)
class Lowered:
    """A sensor, ready to be planned."""

    channels: tuple[Channel, ...]  #: channels of the sensor's reading, in order
    #: arrays that `forward` gets as tensors: a mapping, or a dataclass, which becomes a mapping by path
    constants: Any = field(default_factory=dict)
    state: Mapping[str, Memory] = field(default_factory=dict)  #: tensors carried from one call to the next
    requests: tuple[Request, ...] = ()  #: requests to the scene, at most one of each type
    rows: Axis | None = None  #: rows of the reading; None: taxels, or bodies if the kind is not on taxels
    #: further readings `<sensor>/<name>` with these channels and a row per body
    reports: Mapping[str, tuple[Channel, ...]] = field(default_factory=dict)
    report_rows: Mapping[str, Axis] = field(default_factory=dict)  #: rows of a report, where they are not bodies
    notes: tuple[str, ...] = ()  #: lines about its parameters for `explain`
    signal: tuple[Channel, ...] | None = None  #: channels that `forward` returns and noise disturbs, if the kind has `decide`
    #: number of physics steps per call. `forward` is called at each, and the reading is a block of this many samples, times
    #: `samples`. 0: `forward` is called once per call, with the state of the last physics step.
    substeps: int = 0
    samples: int = 0  #: samples that `forward` returns at once, as "signal" (env, sample, channel, row); 0: a single reading
    timestep: float = 0.0  #: time between calls of `forward` that the constants are for [s]; another one is warned of. 0: any.
    provides: frozenset[str] = frozenset()  #: planes that `forward` returns for other sensors, among `Kind.provides`
    sound: int = 0  #: samples of sound per call of `forward`, see `sensors.upstream`; 0: none
    upstream: Upstream | None = None  #: request to other sensors: `forward` gets `gathered[Upstream]`, see `sensors.upstream`

    def __post_init__(self) -> None:
        """Name the constants."""
        object.__setattr__(self, "constants", _named(self.constants))


class ReadSensor(NamedTuple):
    """A sensor that another one reads, lowered, and its rows."""

    lowered: Lowered
    rows: Axis


class Fitting(NamedTuple):
    """What `Kind.fit` gets, after the sensors that a sensor reads were lowered."""

    timestep: float  # physics time step of the scene [s]
    upstream: Mapping[str, ReadSensor]  # the sensors that it reads by name, in order


class Context(NamedTuple):
    """When `forward` is called. A kind without `is_timed` gets `UNTIMED`, whose fields are None."""

    dt: Tensor  #: time since the last call or substep [s], a scalar
    step: Tensor  #: number of this call of each environment, (env, 1)
    substep: int  #: index of the substep within the call
    time: Tensor  #: time since each environment's reset [s], (env, 1); 0 at the first call after it
    is_first: Tensor  #: whether this is the first call after each environment's reset, (env, 1)
    stream: Stream | None = None  #: random words of this call or substep, for a kind with `is_random`: see `noise.random`


UNTIMED = Context(*[None] * 5)  # type: ignore[arg-type]
"""The context of a kind without `is_timed`."""


class ReferenceContext(NamedTuple):
    """The same for one environment, in numbers."""

    dt: float
    step: int
    substep: int
    time: float
    is_first: bool
    words: Callable[[UInt64[np.ndarray, "*word"]], UInt64[np.ndarray, "*word"]]
    """Returns random words of `Context.stream` by their numbers."""


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
        """Receives messages during long jobs."""
        ...


Array = TypeVar("Array")  # `np.ndarray` in `lower`, `Tensor` in `forward`
Constants = Mapping[str, Tensor]  # constants of a kind without a dataclass for them
State = Mapping[str, Tensor]
ReferenceState = Mapping[str, np.ndarray]
Planes = Mapping[str, Tensor]
ReferenceAnswer = tuple[np.ndarray, dict[str, np.ndarray]] | tuple[np.ndarray, dict[str, np.ndarray], Mapping[str, np.ndarray]]
"""A reading (row, channel), or (sample, row, channel) of a block; the new state; and the planes that the kind provides."""


class Alternative(NamedTuple):
    """Other values of a sensor's or an object's fields, with another error and cost."""

    label: str  # name for users: `svd, 0.1 %`
    changes: Mapping[str, Any]  # new values of fields, as a document has them; None: left out
    unused: tuple[str, ...] = ()  # fields that have no effect then. A document that sets one of them excludes this alternative.
    # whether it is exact up to rounding. Errors of others may be measured against it, and it needs no measurement.
    is_exact: bool = False
    is_other: bool = False  # whether its reading has another shape or other times. `accuracy` never chooses it.


Warn = Callable[[str, Mapping[str, np.ndarray], Sequence[str], np.ndarray], Sequence[str]]


def no_alternatives(spec: Any) -> Sequence[Alternative]:
    """Return no alternatives."""
    return ()


@dataclass(frozen=True)
class Kind:
    """A kind of sensor.

    Attributes:
        spec: Its pydantic model; `kind` is a `Literal` with the kind's name.
        lower: `(spec, layout, surface_of) → Lowered`. The layout has the sensor's taxels, or its links without taxels. May
            raise `LowerError`.
        forward: `(gathered, context, constants, state) → (planes, new state)`: planes (env, row) by name, at least of all
            channels; pure and traceable. One tensor (env, channel, row) of all channels may be returned as "signal", or
            for a report as "<report>/signal".
        reference: `(spec, layout, gathered, context, state) → (reading (row, channel), new state)` for one environment, in
            NumPy. `gathered` has the results of the quantities' references. Of a block it is called at each substep.
        decide: `(planes, constants, state) → (planes, new state)`, if the reading is a threshold of a signal: `forward` then
            returns the signal, and noise acts on that.
        knobs: Names of its noise knobs.
        gains_depth: Whether the noise stage `gain` scales the depth that `forward` gets, instead of the reading, if its
            rows are taxels.
        idle_knobs: Knobs that do not change its reading; a document that sets one gets a warning.
        is_pointwise: Whether each row of its planes depends on one taxel alone. Sensors without state on different taxels are
            then evaluated together, and scalar constants are passed as (taxel,).
        is_timed: Whether `forward` uses the context. The module then keeps a clock and requires the state's `dt`.
        is_random: Whether it draws random numbers from `Context.stream`.
        retimed: `(constants, dt) → constants`: the constants that depend on the time between calls of `forward` [s]. The
            module calls it when that time differs from the one of the constants.
        quantities: Quantities that it requests and that no installed package provides.
        alternatives: `(spec) → alternatives`, from coarse to fine. Errors are measured against the last one that can be
            compiled; one that the spec or its links do not allow is left out.
        provides: Planes that `forward` and `reference` (as a third value, by name) can return for other sensors, see
            `sensors.upstream`; `Lowered.provides` lists them for one sensor.
        reads: The field of its spec that names the sensors it reads; "": none.
        warns: Pairs of a state's name and `(sensor's name, constants, rows of the sensors that it reads, maxima over
            environments) → messages`, each shown once.
        fit: `(spec, lowered, fitting) → Lowered`, if sizes depend on the scene's time step or on the sensors that it reads.
        constants: A dataclass with a field for each constant, None where optional, or a function that makes one from
            constants by keyword: `forward` and `decide` get one, and `lower` passes one to `Lowered`. None: mappings.
        state: A NamedTuple with a field for each state, None where optional: `forward` and `decide` get and return one.
            None: mappings.
    """

    spec: type[AnySensorSpec]
    lower: Callable[[Any, Layout, SurfaceOf], Lowered]
    forward: Callable[[Gathered, Context, Any, Any], tuple[Planes, Any]]
    reference: Callable[[Any, Layout, Any, ReferenceContext, ReferenceState], ReferenceAnswer]
    decide: Callable[[Planes, Any, Any], tuple[Planes, Any]] | None = None
    knobs: frozenset[str] = BASE
    gains_depth: bool = False
    idle_knobs: frozenset[str] = frozenset()
    is_pointwise: bool = False
    is_timed: bool = False
    is_random: bool = False
    retimed: Callable[[Mapping[str, np.ndarray], float], Mapping[str, np.ndarray]] | None = None
    quantities: tuple[Quantity, ...] = ()
    alternatives: Callable[[Any], Sequence[Alternative]] = no_alternatives
    provides: frozenset[str] = frozenset()
    reads: str = ""
    warns: tuple[tuple[str, Warn], ...] = ()
    fit: Callable[[Any, Lowered, Fitting], Lowered] | None = None
    constants: Callable[..., Any] | None = None
    state: type[Any] | None = None

    def typed(self, constants: Mapping[str, Tensor]) -> Any:
        """Return constants as `forward` gets them."""
        return constants if self.constants is None else self.constants(**constants)

    def typed_state(self, state: Mapping[str, Tensor]) -> Any:
        """Return state as `forward` gets it."""
        return state if self.state is None else self.state(**state)

    @property
    def name(self) -> str:
        """The kind's name in the grammar."""
        (name,) = self.spec.model_fields["kind"].annotation.__args__  # type: ignore[union-attr]
        return name


def state_by_name(state: Any) -> dict[str, Tensor]:
    """Return a kind's state by name."""
    fields = zip(state._fields, state, strict=True) if isinstance(state, tuple) else state.items()  # type: ignore[attr-defined]
    return {name: value for name, value in fields if value is not None}


def scalar(value: float) -> Float[np.ndarray, ""]:
    """Return a parameter as the array that `Lowered.constants` wants."""
    return np.asarray(value, dtype=np.float64)

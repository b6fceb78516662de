"""What a sensor kind is: a spec, an equation, and how it is lowered and computed.

A kind is one file that holds, in this order: what it measures, its spec, `reference` (the definition, float64), `lower`
(constants and state, no physics), `forward` (batched, in component planes), and last a `Kind` that ties them together.

Shapes: `env` environments, `taxel` taxels of one sensor, `body` bodies that carry them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import BeforeValidator, Field, StrictBool, StrictInt, WithJsonSchema, model_validator
from torch import Tensor

from tgdsl.fields.models import Frequency, Selector, SpecModel, Usual
from tgdsl.fields.regions import RegionPart
from tgdsl.layout.layout import Layout
from tgdsl.quantities.contact_depth.query import Felt, Probes
from tgdsl.quantities.reference import Touch
from tgdsl.sensors.noise import BASE, NoiseField
from tgdsl.surfaces.surface import Surface


class HistorySpec(SpecModel):
    """What is read of the last calls."""

    length: Annotated[StrictInt, Field(ge=1), Usual("number", high=1000.0)]
    """Calls that count, this one included; before there are so many since a reset, the first one stands for the missing."""
    reduce: Literal["stack", "last", "median", "mean"] = "stack"
    """`stack`: all of them, oldest first, as a further dimension; or one reading made of them."""
    view: StrictBool = False
    """Whether a stack is handed out as a view of the module's own memory, which the next call overwrites and which
    carries no gradient; default: a copy."""

    @model_validator(mode="after")
    def _is_used(self) -> HistorySpec:
        if self.view and self.reduce != "stack":
            raise ValueError("`view` is used by `reduce: stack` alone, expected it to be left out")
        return self


History = Annotated[
    HistorySpec,
    BeforeValidator(lambda found: {"length": found} if isinstance(found, int) else found),
    WithJsonSchema({"anyOf": [{"type": "integer", "minimum": 1}, HistorySpec.model_json_schema()]}),
]


class SensorSpec(SpecModel):
    """What every kind of sensor has. A kind's own spec adds `kind: Literal["its_name"]` and its parameters."""

    links: Selector
    """Links that carry the sensor: a link group, names, shell wildcards, or include/exclude."""
    noise: NoiseField = "clean"
    """A noise profile's name, or the knobs in line."""
    readout: Literal["clean", "measured", "both"] = "measured"
    """`measured` with the imperfections of `noise`, `clean` without, or `both`: `<name>` and `<name>/clean`."""
    rate: Annotated[Frequency | None, Usual("frequency", low=0.1, high=1e5)] = None
    """How often the sensor takes a sample, which it reads until the next one [Hz]; default: at every call."""
    history: History | None = None
    """How many calls are read, `stack`ed or reduced: `history: 5`, or `history: {length: 5, reduce: mean}`."""


class ProbeSpec(SensorSpec):
    """A sensor whose taxels are spherical probes that feel objects."""

    feels: Annotated[tuple[str, ...], Field(min_length=1)]
    """Objects that the probes can feel."""

    @property
    def is_gated(self) -> bool:
        """Whether an object is felt only while the simulator has it in contact with the taxel's link."""
        return False


class ContactProbeSpec(ProbeSpec):
    """Probes that feel what their link touches."""

    gate: Literal["contact_pair", "geometric"] = "contact_pair"
    """When an object is felt: `contact_pair` only while the simulator has it in contact with the taxel's link (the paper);
    `geometric` whenever a probe's sphere reaches into it, so a 4 mm probe feels it 4 mm before it touches."""

    @property
    def is_gated(self) -> bool:
        """Whether an object is felt only while the simulator has it in contact with the taxel's link."""
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
        shape: Its shape; None: (taxel,); "points": one row of all points of `Felt.points`, one after the other.
    """

    rest: float = 0.0
    shape: tuple[int, ...] | Literal["points"] | None = None


@dataclass(frozen=True)
class MomentsRequest:
    """How moments of objects' surfaces are found.

    Attributes:
        backend: "field": from a baked field; "points": by a sum over sampled points. Planes are exact in both.
        num_points: Points of each object.
        tolerance: Root mean square error of a field as a fraction of full scale.
        gradient_tolerance: Error that 99.9 % of S0's gradients by place may have, as a fraction of the largest; None: any.
        max_bytes: Largest size of all fields of an object, or of its lists of points [bytes].
        with_area: Whether the area of the felt objects is wanted, so that there must be one.
        radius_noise: By how much radii may differ from the probes' own [m]; set by the compiler.
    """

    backend: Literal["field", "points"]
    num_points: int
    tolerance: float
    gradient_tolerance: float | None
    max_bytes: int
    with_area: bool
    radius_noise: float = 0.0


@dataclass(frozen=True)
class PointsRequest:
    """Points that are sampled on the outer surface of each object and measured against the links' own surfaces.

    Attributes:
        num_points: Points of each object.
        range: Distance from a link's surface up to which readings tell it apart [m].
    """

    num_points: int
    range: float


@dataclass(frozen=True, eq=False)
class Lowered:
    """A sensor, ready to be planned.

    Attributes:
        channels: What the sensor's own reading holds, in order.
        constants: Arrays that `forward` gets as tensors.
        state: What is carried from one call to the next.
        rows: What the reading has one row of: "taxel", or "body" for each body that carries taxels, in order.
        reports: Further readings, with a row per body: `<sensor>/<name>` holds these channels.
        needs: Optional parts of `Felt` that `forward` reads: "normal", "motion", "distance", "frame", "contacts", "moments",
            "points".
        range: Distance from an object's surface up to which readings tell it apart [m], if more than the probe's radius.
        radius: How far from each taxel objects are felt [m], (taxel,); default: the probes' radii. Inactive ones feel nothing.
        slots: Contacts per body and object that are wanted, if `needs` has "contacts"; 0: the net force alone.
        moments: How moments are found, if `needs` has "moments".
        points: Which points, if `needs` has "points".
        notes: What an account of the sensor says of its parameters, line by line.
        signal: What `forward` returns, if the kind decides: what noise acts on.
    """

    channels: tuple[Channel, ...]
    constants: Mapping[str, np.ndarray] = field(default_factory=dict)
    state: Mapping[str, Memory] = field(default_factory=dict)
    rows: Literal["taxel", "body"] = "taxel"
    reports: Mapping[str, tuple[Channel, ...]] = field(default_factory=dict)
    needs: frozenset[str] = frozenset()
    range: float = 0.0
    radius: Float[np.ndarray, " taxel"] | None = None
    slots: int = 0
    moments: MomentsRequest | None = None
    points: PointsRequest | None = None
    notes: tuple[str, ...] = ()
    signal: tuple[Channel, ...] | None = None


SurfaceOf = Callable[[str, Sequence[RegionPart]], Surface]
"""Returns the triangles of a link, by its name, or of a region of it, in its body's frame [m]."""
Constants = Mapping[str, Tensor]
State = Mapping[str, Tensor]
ReferenceState = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Kind:
    """A kind of sensor.

    Attributes:
        spec: Its pydantic model; `kind` is a `Literal` with the kind's name.
        lower: `(spec, layout, surface_of) → Lowered`; the layout holds the sensor's own taxels. May raise `LowerError`.
        forward: `(felt, probes, constants, state) → (planes by channel name, new state)`: planes (env, taxel) or, of what has
            a row per body, (env, body), at least those of the channels; pure, traceable; the new state is like the old. Where
            all channels are one tensor (env, channel, row) already it stands for them, as "signal", or of a report as
            "<report>/signal". A kernel may write new state of points over the old; it is then left out of what is returned.
        reference: `(spec, layout, touch, state) → (reading (row, channel), new state)` for one environment, in NumPy.
        decide: `(planes, constants, state) → (planes, new state)`, if the reading is made of the signal by a threshold: what
            `forward` returns is then the signal, which noise disturbs first.
        knobs: Names of the noise knobs that it has.
        gains_depth: Whether a taxel's gain is of the depth that `forward` gets rather than of the reading.
        idle_knobs: Those of its knobs that change nothing in what it reads.
        is_pointwise: Whether each row of what `forward` returns is of one taxel alone. Sensors on different taxels may then be
            computed as one, where they have no state, and parameters that are scalars are given as (taxel,).
    """

    spec: type[ProbeSpec]
    lower: Callable[[Any, Layout, SurfaceOf], Lowered]
    forward: Callable[[Felt, Probes, Constants, State], tuple[Mapping[str, Tensor], State]]
    reference: Callable[[Any, Layout, Touch, ReferenceState], tuple[Float[np.ndarray, "row channel"], dict[str, np.ndarray]]]
    decide: Callable[[Mapping[str, Tensor], Constants, State], tuple[Mapping[str, Tensor], State]] | None = None
    knobs: frozenset[str] = BASE
    gains_depth: bool = False
    idle_knobs: frozenset[str] = frozenset()
    is_pointwise: bool = False

    @property
    def name(self) -> str:
        """The kind's name in the grammar."""
        (name,) = self.spec.model_fields["kind"].annotation.__args__  # type: ignore[union-attr]
        return name


def scalar(value: float) -> Float[np.ndarray, ""]:
    """Return a parameter as the array that `Lowered.constants` wants."""
    return np.asarray(value, dtype=np.float64)

"""What a sensor kind is: a spec, an equation, and how it is lowered and computed.

A kind is one file that holds, in this order: what it measures, its spec, `reference` (the definition, float64), `lower`
(constants and state, no physics), `forward` (batched, in component planes), and last a `Kind` that ties them together.

Shapes: `env` environments, `taxel` taxels of one sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field, Tag
from torch import Tensor

from tgdsl.fields import TEXT_OR_OTHER, Selector, SpecModel, Text
from tgdsl.geometry.query import Felt, Probes
from tgdsl.geometry.reference import Touch
from tgdsl.layout import Layout
from tgdsl.sensors.noise import NoiseSpec


class SensorSpec(SpecModel):
    """What every kind of sensor has. A kind's own spec adds `kind: Literal["its_name"]` and its parameters."""

    links: Selector
    """Links that carry the sensor: a link group, names, shell wildcards, or include/exclude."""
    noise: Annotated[Text | Annotated[NoiseSpec, Tag("other")], TEXT_OR_OTHER] = "clean"
    """A noise profile's name, or the knobs in line."""
    readout: Literal["clean", "measured", "both"] = "measured"
    """`measured` with the imperfections of `noise`, `clean` without, or `both`: `<name>` and `<name>/clean`."""


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


@dataclass(frozen=True, eq=False)
class Lowered:
    """A sensor, ready to be planned.

    Attributes:
        channels: What a reading holds, in order.
        constants: Arrays that `forward` gets as tensors: scalars, or shapes that end in (taxel,).
        state: Rest value of each plane (env, taxel) that is carried from one call to the next.
        range: Distance from an object's surface up to which readings tell it apart [m], if more than the probe's radius.
        needs: Optional parts of `Felt` that `forward` reads: "normal", "motion", "distance".
    """

    channels: tuple[Channel, ...]
    constants: Mapping[str, np.ndarray] = field(default_factory=dict)
    state: Mapping[str, float] = field(default_factory=dict)
    needs: frozenset[str] = frozenset()
    range: float = 0.0


Constants = Mapping[str, Tensor]
State = Mapping[str, Tensor]
ReferenceState = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Kind:
    """A kind of sensor.

    Attributes:
        spec: Its pydantic model; `kind` is a `Literal` with the kind's name.
        lower: `(spec, layout) → Lowered`; the layout holds the sensor's own taxels.
        forward: `(felt, probes, constants, state) → (planes by channel name, new state)`: planes (env, taxel), at least
            those of `Lowered.channels`; pure, traceable; the new state has the keys of `Lowered.state`.
        reference: `(spec, layout, touch, state) → (readings (taxel, channel), new state)` for one environment, in NumPy.
    """

    spec: type[ProbeSpec]
    lower: Callable[[Any, Layout], Lowered]
    forward: Callable[[Felt, Probes, Constants, State], tuple[Mapping[str, Tensor], State]]
    reference: Callable[[Any, Layout, Touch, ReferenceState], tuple[Float[np.ndarray, "taxel channel"], dict[str, np.ndarray]]]

    @property
    def name(self) -> str:
        """The kind's name in the grammar."""
        (name,) = self.spec.model_fields["kind"].annotation.__args__  # type: ignore[union-attr]
        return name


def scalar(value: float) -> Float[np.ndarray, ""]:
    """Return a parameter as the array that `Lowered.constants` wants."""
    return np.asarray(value, dtype=np.float64)

"""A kind for oracles of what hears: a tone of each link, at the place of its frame's origin."""

from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field, StrictInt
from torch import Tensor

from tgdsl.fields.models import Frequency, Number
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.places import Places
from tgdsl.quantities.reference import References
from tgdsl.sensors.base import (
    Channel,
    Constants,
    Context,
    Kind,
    LinkSpec,
    Lowered,
    ReferenceContext,
    ReferenceState,
    State,
    SurfaceOf,
    body_axis,
    scalar,
)
from tgdsl.sensors.upstream import PLACE, SAMPLES, SOUND


class ToneSpec(LinkSpec):
    """A tone."""

    kind: Literal["tone"]
    """A tone [Pa]."""
    frequency: Frequency = 100.0
    """Of the first link [Hz]; that of others is 1.3, 1.6, … times as high."""
    pulse: StrictInt = -1
    """In place of a tone: a pulse at this sample of the episode's second step."""
    samples: Annotated[StrictInt, Field(ge=1)] = 16
    """Per step."""
    substeps: Annotated[StrictInt, Field(ge=1)] = 1
    """Steps per call."""
    amplitude: Number = 1.0
    """[Pa]."""


def reference(
    spec: ToneSpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the samples, and where they come from."""
    rows, count = len(layout.bodies), np.arange(1, spec.samples + 1)
    time = context.time - context.dt + count * context.dt / spec.samples
    rate = 2 * np.pi * spec.frequency * (1 + 0.3 * np.arange(rows))
    made = spec.amplitude * np.sin(np.outer(time, rate)) * (time >= 0)[:, None]
    return made[:, None, :, None].swapaxes(1, 2), {}, {SAMPLES: made, PLACE: gathered[Places].T}


def lower(spec: ToneSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """Rows are bodies."""
    rows = len(layout.bodies)
    constants = {
        "rate": 2 * np.pi * spec.frequency * (1 + 0.3 * np.arange(rows)),
        "share": np.arange(1, spec.samples + 1) / spec.samples - 1,
        "amplitude": scalar(spec.amplitude),
        "pulse": scalar(float(spec.pulse)),
    }
    places = Places(bodies=layout.bodies, offset=np.zeros((rows, 3)))
    blocks: dict[str, Any] = {"substeps": spec.substeps, "samples": spec.samples, "sound": spec.samples, "provides": SOUND}
    return Lowered((Channel("tone", "Pa"),), constants, requests=(places,), rows=body_axis(layout), **blocks)


def forward(gathered: Gathered, context: Context, constants: Constants, state: State) -> tuple[dict[str, Tensor], State]:
    """Return the samples, and where they come from."""
    time = context.time.double() + constants["share"].double() * context.dt.double()
    phase = time[:, :, None] * constants["rate"].double()
    made = constants["amplitude"] * (torch.sin(phase) * (time >= 0)[:, :, None]).to(context.time.dtype)
    count = torch.arange(made.shape[1], device=made.device)[None, :, None]
    is_pulse = (count == constants["pulse"]) & (torch.abs(context.time - context.dt) < 0.5 * context.dt)[..., None]
    made = torch.where(constants["pulse"] >= 0, is_pulse.to(made.dtype), made)
    return {"signal": made[:, :, None], SAMPLES: made, PLACE: torch.stack(gathered[Places], dim=1)}, {}


TONE = Kind(ToneSpec, lower, forward, reference, knobs=frozenset(), is_timed=True, provides=SOUND)

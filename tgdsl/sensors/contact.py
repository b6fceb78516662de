"""Contact: one bit per taxel, by two thresholds of the penetration depth (a Schmitt trigger).

    y_j(t) = 1  if  d_j(t) > η_on  or  (y_j(t−1) = 1 and d_j(t) > η_off),  else 0             [1]

d_j is the penetration depth of probe j [m] (see `contact_depth`), η_on the threshold and η_off ≤ η_on the release threshold
[m]; t counts calls. With η_off = η_on the kind has no state. After a reset y = 0.

Source: Chung et al., *Tactile Genesis*, appendix, "ContactProbe".

Departures: none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Generic, Literal, NamedTuple

import numpy as np
import torch
from pydantic import model_validator
from torch import Tensor

from tgdsl.fields.models import Radius, Usual
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.contact_depth import ContactDepth
from tgdsl.quantities.reference import References
from tgdsl.sensors.base import (
    Array,
    Channel,
    ContactProbeSpec,
    Context,
    Kind,
    Lowered,
    Memory,
    ReferenceContext,
    ReferenceState,
    SurfaceOf,
    scalar,
)
from tgdsl.sensors.noise import TAXEL


class ContactSpec(ContactProbeSpec):
    """Contact bit of each probe."""

    kind: Literal["contact"]
    """Whether each probe is in contact: 1 or 0."""
    threshold: Annotated[Radius, Usual("length", high=0.1)] = 5e-4
    """Depth above which a taxel switches on, η_on [m]."""
    release_threshold: Annotated[Radius | None, Usual("length", high=0.1)] = None
    """Depth below which it switches off again, η_off [m]; default: `threshold`."""

    @model_validator(mode="after")
    def _ordered(self) -> ContactSpec:
        if self.release_threshold is not None and self.release_threshold > self.threshold:
            raise ValueError(
                f"release_threshold {self.release_threshold:g} m is above threshold {self.threshold:g} m, expected at most that"
            )
        return self

    @property
    def release(self) -> float:
        """Depth below which a taxel switches off [m]."""
        return self.threshold if self.release_threshold is None else self.release_threshold


def reference(
    spec: ContactSpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return y (taxel, 1), and the new bit where there is memory."""
    depth = gathered[ContactDepth].depth
    bit = depth > spec.threshold
    if spec.release == spec.threshold:
        return bit[:, None].astype(np.float64), {}
    bit |= (state["bit"] == 1.0) & (depth > spec.release)
    return bit[:, None].astype(np.float64), {"bit": bit.astype(np.float64)}


@dataclass(frozen=True, eq=False)
class ContactConstants(Generic[Array]):
    """Depths at which a bit switches on, and off if that is another one [m]."""

    threshold: Array
    release_threshold: Array | None = None


class ContactState(NamedTuple):
    """The last bits; None where the two thresholds are one."""

    bit: Tensor | None = None


def lower(spec: ContactSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """The bit is state only where the two thresholds differ."""
    has_memory = spec.release != spec.threshold
    constants = ContactConstants(scalar(spec.threshold), scalar(spec.release) if has_memory else None)
    channels, signal = (Channel("contact", "1"),), (Channel("depth", "m"),)
    requests = (ContactDepth(spec.objects, spec.is_gated),)
    state = {"bit": Memory()} if has_memory else {}
    return Lowered(channels, constants, state, requests, signal=signal)


def forward(
    gathered: Gathered, context: Context, constants: ContactConstants[Tensor], state: ContactState
) -> tuple[dict[str, Tensor], ContactState]:
    """Return the depth plane [m], which is what noise acts on."""
    return {"depth": gathered[ContactDepth].depth}, ContactState()


def decide(
    signal: Mapping[str, Tensor], constants: ContactConstants[Tensor], state: ContactState
) -> tuple[dict[str, Tensor], ContactState]:
    """Return the bit plane, 0 or 1 in the module's dtype."""
    depth, threshold = signal["depth"], constants.threshold
    if constants.release_threshold is not None and state.bit is not None:
        threshold = torch.where(state.bit > 0.5, constants.release_threshold, threshold)
    bit = (depth > threshold).to(depth.dtype)
    bit = torch.where(depth.isnan(), depth, bit)  # a broken pose must not look like no contact
    return {"contact": bit}, ContactState() if state.bit is None else ContactState(bit)


CONTACT = Kind(
    ContactSpec,
    lower,
    forward,
    reference,
    decide,
    TAXEL | {"release_threshold"},
    constants=ContactConstants,
    state=ContactState,
)

"""Link contact: per body, the solver's net contact force and a contact bit.

    f_b = Σ_o f_bo,   c_b = 1 if |f_b| > threshold, else 0                                    [N], [1]

with f_bo the solver's net contact force of object o on body b [N], over all its contacts (there are no slots), in the frame of
the body; the threshold in [N]. One row per body that carries the sensor, in the order of the layout. Forces of several objects
are summed before the threshold: a body squeezed between two objects with equal forces reads zero and no contact; to separate
objects, give each its own sensor. The bit is a step function and has no gradient.

Source: MuJoCo's contact sensor with the reduction `netforce` (XML reference, sensor/contact).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from tgdsl.fields.models import NonNegative
from tgdsl.geometry import planes
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.contacts import Contacts
from tgdsl.quantities.reference import References
from tgdsl.sensors.base import (
    Channel,
    Constants,
    Context,
    Kind,
    Lowered,
    ProbeSpec,
    ReferenceContext,
    ReferenceState,
    State,
    SurfaceOf,
    body_axis,
    scalar,
)


class LinkContactSpec(ProbeSpec):
    """Whether each body is in contact, and the force on it."""

    kind: Literal["link_contact"]
    """Contact bit [1] and the solver's force [N] of each body."""
    outputs: Annotated[tuple[Literal["contact", "force"], ...], Field(min_length=1)] = ("contact", "force")
    """What a reading holds, the bit before the force."""
    threshold: NonNegative = 0.0
    """Force above which a body counts as touched [N]."""
    needs_taxels: ClassVar[bool] = False


def reference(
    spec: LinkContactSpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return c [1] and f [N] of the outputs asked for: (body, channel)."""
    net = gathered[Contacts].net
    is_touched = np.linalg.norm(net, axis=1) > spec.threshold
    parts = {"contact": is_touched[:, None].astype(np.float64), "force": net}
    return np.concatenate([parts[name] for name in parts if name in spec.outputs], axis=1), {}


def lower(spec: LinkContactSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """The net force alone is wanted: no slots, and no probe."""
    channels: list[Channel] = []
    if "contact" in spec.outputs:
        channels.append(Channel("contact", "1"))
    if "force" in spec.outputs:
        channels += [Channel(f"force_{axis}", "N") for axis in "xyz"]
    constants = {"threshold": scalar(spec.threshold)}
    force = tuple(Channel(f"force_{axis}", "N") for axis in "xyz")
    requests = (Contacts(spec.objects),)
    return Lowered(tuple(channels), constants, requests=requests, rows=body_axis(layout), signal=force)


def forward(gathered: Gathered, context: Context, constants: Constants, state: State) -> tuple[dict[str, Tensor], State]:
    """Return the force planes [N], by body, which are what noise acts on."""
    return {f"force_{axis}": plane for axis, plane in zip("xyz", gathered[Contacts].net, strict=True)}, {}


def decide(signal: Mapping[str, Tensor], constants: Constants, state: State) -> tuple[dict[str, Tensor], State]:
    """Return the bit [1] and the force planes [N], by body."""
    force = (signal["force_x"], signal["force_y"], signal["force_z"])
    size = planes.safe_sqrt(planes.dot(force, force))
    bit = torch.where(size.isnan(), size, (size > constants["threshold"]).to(size.dtype))
    return {**signal, "contact": bit}, {}


LINK_CONTACT = Kind(LinkContactSpec, lower, forward, reference, decide)

"""Link contact: per body, the solver's net contact force, a contact bit, and the sum of the contacts' normal forces.

    f_b = Σ_o f_bo,   c_b = 1 if |f_b| > threshold, else 0                                    [N], [1]
    s_b = Σ_o Σ_c max(0, f_boc · n_boc)                                                       [N]

f_bo is the solver's net contact force of object o on body b, over all its contacts, in the body's frame [N]. f_boc is the
force of each contact c and n_boc its unit normal out of the object. There is one row per body that carries the sensor, in the
order of the layout. Forces of several objects are summed before the threshold, so a body squeezed between two objects with
equal forces reads zero and no contact, while s_b is twice that force. To separate objects, give each its own sensor.

s_b is a sum of magnitudes: two opposing contacts add up, and friction is not part of it. It reads contacts one by one, `slots`
for each pair of body and object; the others' force is distributed over these (see `quantities.contacts`).

Source: MuJoCo's contact sensor, with the reduction `netforce` for f_b and contact by contact for s_b (XML reference,
sensor/contact).

Limits: the bit is a step function and has no gradient. With more contacts than `slots`, s_b is exact only where all normals of
the pair agree, as under a flat face.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Generic, Literal

import numpy as np
import torch
from pydantic import Field, StrictInt, model_validator
from torch import Tensor

from tgdsl.fields.models import NonNegative
from tgdsl.geometry import planes
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.contacts import DEFAULT_SLOTS, Contacts
from tgdsl.quantities.reference import References
from tgdsl.sensors.base import (
    Array,
    Channel,
    Context,
    Kind,
    Lowered,
    ProbeSpec,
    ReferenceContext,
    ReferenceState,
    State,
    SurfaceOf,
    body_axis,
    components,
    scalar,
    vector,
)


class LinkContactSpec(ProbeSpec):
    """Whether each body is in contact, the force on it, and how hard it is pressed."""

    kind: Literal["link_contact"]
    """Contact bit [1] and the solver's force [N] of each body."""
    outputs: Annotated[tuple[Literal["contact", "force", "normal_force"], ...], Field(min_length=1)] = ("contact", "force")
    """Quantities of a reading: the bit, then the force, then the sum of the contacts' normal forces."""
    threshold: NonNegative = 0.0
    """Force above which a body counts as touched [N]."""
    slots: Annotated[StrictInt, Field(ge=1)] = DEFAULT_SLOTS
    """Contacts per pair of body and object whose normal forces are summed, for the output `normal_force` alone [1]."""
    needs_taxels: ClassVar[bool] = False

    @model_validator(mode="after")
    def _is_used(self) -> LinkContactSpec:
        if "slots" in self.model_fields_set and "normal_force" not in self.outputs:
            raise ValueError("`slots` is used by the output `normal_force` alone, expected it to be left out")
        if "threshold" in self.model_fields_set and "contact" not in self.outputs:
            raise ValueError("`threshold` has no effect without the output `contact`; remove it")
        return self


def reference(
    spec: LinkContactSpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return c [1], f [N] and s [N] of the outputs asked for: (body, channel)."""
    contacts = gathered[Contacts]
    net, pressed = contacts.net, np.zeros((len(contacts.net), 1))
    is_touched = np.linalg.norm(net, axis=1) > spec.threshold
    for body, force, normal in zip(contacts.body, contacts.force, contacts.normal, strict=True):
        pressed[body] += max(0.0, np.dot(force, normal))
    parts = {"contact": is_touched[:, None].astype(np.float64), "force": net, "normal_force": pressed}
    return np.concatenate([parts[name] for name in parts if name in spec.outputs], axis=1), {}


@dataclass(frozen=True, eq=False)
class LinkContactConstants(Generic[Array]):
    """Force above which a body counts as touched [N]."""

    threshold: Array


def lower(spec: LinkContactSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """The net force alone is wanted, without slots, unless normal forces are; and no probe."""
    force = vector("force", "N")
    parts = {"contact": (Channel("contact", "1"),), "force": force, "normal_force": (Channel("normal_force", "N"),)}
    channels = tuple(channel for name, part in parts.items() if name in spec.outputs for channel in part)
    signal, slots = (force + parts["normal_force"], spec.slots) if "normal_force" in spec.outputs else (force, 0)
    constants = LinkContactConstants(scalar(spec.threshold))
    return Lowered(channels, constants, requests=(Contacts(spec.objects, slots=slots),), rows=body_axis(layout), signal=signal)


def forward(
    gathered: Gathered, context: Context, constants: LinkContactConstants[Tensor], state: State
) -> tuple[dict[str, Tensor], State]:
    """Return the force planes and the normal force [N], by body, which are what noise acts on."""
    contacts = gathered[Contacts]
    pressed = planes.dot(contacts.force, contacts.normal).clamp(min=0.0).sum(dim=-1)
    return {**components("force", contacts.net), "normal_force": pressed}, {}


def decide(
    signal: Mapping[str, Tensor], constants: LinkContactConstants[Tensor], state: State
) -> tuple[dict[str, Tensor], State]:
    """Return the bit [1], the force planes and, if it is there, the normal force [N], by body."""
    force = (signal["force_x"], signal["force_y"], signal["force_z"])
    size = planes.safe_sqrt(planes.dot(force, force))
    bit = torch.where(size.isnan(), size, (size > constants.threshold).to(size.dtype))
    return {**signal, "contact": bit}, {}


LINK_CONTACT = Kind(LinkContactSpec, lower, forward, reference, decide, constants=LinkContactConstants)

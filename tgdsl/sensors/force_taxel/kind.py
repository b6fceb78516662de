"""Force taxel: the solver's contact force on each body, distributed over the taxels near each contact.

    f_j = Σ_c γ_c λ_cj f_c                                                                    [N]
    p_j = max(0, −f_j · n_j) / A_j                                                            [Pa]
    missed = f_net − Σ_j f_j                                                                  [N]
    residual = Σ_c γ_c (x_c × f_c + τ_c) − Σ_j x_j × f_j                                      [N·m]

c runs over the solver's contacts of the sensor's objects on one body, with points x_c [m], forces f_c [N] and torques τ_c [N·m]
on the link and the net force f_net. j runs over that body's taxels, with positions x_j [m], outward normals n_j and areas A_j
[m²]. All vectors are in the link's frame. `footprint` defines the captured fraction γ_c [1] and the weights λ_cj ≥ 0 with
Σ_j λ_cj = 1. Weights are larger near the contact, on its side of the body and at large depth. They match the moment of the
contacts as far as non-negative weights can.

The load is conserved, static friction included: Σ_j f_j + missed = f_net always. Each f_j is a sum of contact forces with
non-negative weights, so it stays in every convex cone that contains these, such as the friction cone of a flat face. As a
contact slides off the sensor, or around an edge of its body, its force passes continuously to `missed`. `missed` also has the
force of contacts further than a footprint from every active taxel, or on the back of the body. The force of contacts beyond
`slots` acts at the centre of the others (see `quantities.contacts`). Inactive taxels carry nothing. `missed` and `residual`
have one row per body. The residual is a pure couple, the same about any point, since the distributed forces sum to the captured
ones.

Source: a solver's contacts are points on rigid bodies. This kind distributes their resultant as a Winkler foundation does,
whose pressure is proportional to depth (Johnson, *Contact Mechanics*, §4.3), and corrects the moment.

Limits: a probe has one depth, into the deepest object, so two objects within one footprint share their taxels. Weights follow
depth and distance per taxel, not per area. With the gate `contact_pair` depth jumps where a contact begins; the forces still
sum to the solver's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, StrictInt
from torch import Tensor

from tgdsl.errors import LowerError
from tgdsl.fields.models import PositiveLength, Usual
from tgdsl.geometry import planes
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.contact_depth import ContactDepth
from tgdsl.quantities.contacts import DEFAULT_SLOTS, Contacts
from tgdsl.quantities.reference import References
from tgdsl.sensors.base import (
    Alternative,
    Array,
    Channel,
    ContactProbeSpec,
    Context,
    Kind,
    Lowered,
    ReferenceContext,
    ReferenceState,
    State,
    SurfaceOf,
    components,
    vector,
)
from tgdsl.sensors.force_taxel import footprint
from tgdsl.sensors.noise import FORCE

SPACINGS = 3.0  # default radius of a footprint, in spacings of the taxels: the middle of a square of four is within half of it


class ForceTaxelSpec(ContactProbeSpec):
    """The solver's contact force, distributed over the taxels."""

    kind: Literal["force_taxel"]
    """Force [N] or pressure [Pa] of each taxel, which sum to the solver's contact force."""
    outputs: Annotated[tuple[Literal["force", "pressure"], ...], Field(min_length=1)] = ("force",)
    """Quantities of a reading, force before pressure."""
    footprint: Annotated[PositiveLength | None, Usual("length", high=0.1)] = None
    """Radius r_f around a contact in which taxels carry it [m]; a contact further than r_f/2 from the nearest taxel is partly
    missed. Default: on each body 3 times the taxels' spacing, the root of their mean area."""
    moment_iterations: Annotated[StrictInt, Field(ge=0, le=64)] = 4
    """Newton steps towards the contacts' moment; 0: shares by depth and distance alone [1]."""
    slots: Annotated[StrictInt, Field(ge=1)] = DEFAULT_SLOTS
    """Contacts per pair of body and object that are distributed one by one; the others' force acts at their centre [1]."""

    def radii(self, layout: Layout) -> np.ndarray:
        """Return r_f of each body [m]."""
        areas = [layout.area[(layout.body_id == b) & (layout.radius > 0)] for b in range(len(layout.bodies))]
        spacing = [float(np.sqrt(area.mean())) if len(area) else 1.0 for area in areas]
        return np.array([self.footprint or SPACINGS * each for each in spacing])

    @property
    def levenberg(self) -> tuple[float, ...]:
        """Least curvature of each Newton step [1]."""
        return (footprint.LEVENBERG,) * self.moment_iterations


def reference(
    spec: ForceTaxelSpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return f [N] and p [Pa], of the outputs asked for: (taxel, channel)."""
    force, _, _ = reference_reports(spec, layout, gathered)
    pressure = np.maximum(0.0, -np.sum(force * layout.normal, axis=1)) / np.where(layout.radius > 0, layout.area, 1.0)
    parts = {"force": force, "pressure": pressure[:, None]}
    return np.concatenate([parts[name] for name in parts if name in spec.outputs], axis=1), {}


def reference_reports(spec: ForceTaxelSpec, layout: Layout, gathered: References) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return f (taxel, 3) [N], missed (body, 3) [N] and residual (body, 3) [N·m]."""
    contacts, touch = gathered[Contacts], gathered[ContactDepth]
    force, missed, residual = np.zeros((layout.num_taxels, 3)), contacts.net.copy(), np.zeros_like(contacts.net)
    is_active = layout.radius > 0
    depth = np.where(is_active, touch.depth / np.where(is_active, layout.radius, 1.0), 0.0)
    for b in range(len(layout.bodies)):
        on_body, at = layout.body_id == b, contacts.body == b
        share, residual[b] = footprint.reference(
            layout.pos[on_body], is_active[on_body], depth[on_body], layout.normal[on_body],
            contacts.pos[at], contacts.force[at], contacts.torque[at], contacts.normal[at],
            spec.radii(layout)[b], spec.levenberg,
        )  # fmt: skip
        force[on_body] = share.T @ contacts.force[at]
        missed[b] -= force[on_body].sum(axis=0)
    return force, missed, residual


@dataclass(frozen=True, eq=False)
class ForceTaxelConstants(footprint.Bodies[Array]):
    """The bodies; r_f of each [m]; least curvature of each step [1]."""

    footprint: Array
    levenberg: Array
    inward: Array | None = None
    """Inward normals over the taxels' areas [1/m²], (3, taxel)."""


def lower(spec: ForceTaxelSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """Pad the taxels of each body to the same number, with inactive ones, so that all bodies are one batch."""
    is_active = layout.radius > 0
    channels: list[Channel] = []
    if "force" in spec.outputs:
        channels += vector("force", "N")
    if "pressure" in spec.outputs:
        if (layout.area[is_active] <= 0).any():
            raise LowerError("a taxel of no area has no pressure", field="outputs", hint="leave pressure out, or give its area")
        channels.append(Channel("pressure", "Pa"))
    counts = np.bincount(layout.body_id)
    first = np.concatenate([[0], np.cumsum(counts)])
    taxel = np.repeat(first[:-1, None], counts.max(), axis=1)  # padding repeats the body's own first taxel
    rank = np.arange(layout.num_taxels) - first[layout.body_id]
    inverse_radius = np.zeros(taxel.shape)
    taxel[layout.body_id, rank] = np.arange(layout.num_taxels)
    inverse_radius[layout.body_id, rank] = np.where(is_active, 1.0 / np.where(is_active, layout.radius, 1.0), 0.0)
    constants = ForceTaxelConstants(
        taxel=taxel,
        inverse_radius=inverse_radius,
        row=layout.body_id * counts.max() + rank,
        first=first,
        box=np.array([footprint.box(layout.pos[(layout.body_id == b) & is_active]) for b in range(len(counts))]),
        place=footprint.place(layout.pos, layout.normal, is_active),
        padded=np.concatenate([layout.pos.T, -2.0 * layout.normal.T])[:, taxel],
        footprint=spec.radii(layout),
        levenberg=np.array(spec.levenberg),
        inward=-layout.normal.T / np.where(is_active, layout.area, np.inf) if "pressure" in spec.outputs else None,
    )
    reports = {"missed": vector("missed", "N"), "residual": vector("residual", "N·m")}
    requests = (ContactDepth(spec.objects, spec.is_gated), Contacts(spec.objects, slots=spec.slots))
    return Lowered(tuple(channels), constants, requests=requests, reports=reports)


def forward(
    gathered: Gathered, context: Context, constants: ForceTaxelConstants[Tensor], state: State
) -> tuple[dict[str, Tensor], State]:
    """Return the force [N], the pressure [Pa] if wanted, and by body the missed force [N] and the residual moment [N·m]."""
    contacts, depth = gathered[Contacts], gathered[ContactDepth].depth
    shared = footprint.SHARED_FORCES(constants, depth, contacts, constants.footprint, constants.levenberg)
    readings = {"missed/signal": shared.missed, "residual/signal": shared.residual}
    if constants.inward is None:
        return {"signal": shared.force, **readings}, {}
    force = planes.vec(shared.force.unbind(1))
    readings |= components("force", force)
    readings["pressure"] = planes.dot(force, planes.vec(constants.inward)).clamp(min=0)
    return readings, {}


def alternatives(spec: ForceTaxelSpec) -> list[Alternative]:
    """Return numbers of Newton steps towards the contacts' moment."""
    return [Alternative(f"{num} Newton steps", {"moment_iterations": num}) for num in (0, 1, 2, 4, 8, 16)]


FORCE_TAXEL = Kind(
    ForceTaxelSpec,
    lower,
    forward,
    reference,
    knobs=FORCE,
    alternatives=alternatives,
    constants=ForceTaxelConstants,
)

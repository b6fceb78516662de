"""Kinematic taxel: force and torque from penetration depth, contact normal and relative velocity, without a deformable body.

    s_j = d_j^α
    f_j = k_n s_j m_j + c_n s_j v_n,j + k_t v_t,j                                             [N]
    τ_j = x_j × f_j + k_ω (ω · m_j) m_j                                                       [N·m]

where d_j > 0, and zero elsewhere. All vectors are in the frame of the taxel's link. d_j is the penetration depth [m] and m_j
the unit normal out of the object (see `contact_depth`). v_j is the velocity of the object's material at the probe relative to
the probe [m/s], v_n = (v · m) m its normal and v_t = v − v_n its tangential part. ω is the angular velocity of the object
relative to the link [rad/s] and x_j the probe's position [m]. Coefficients: stiffness k_n [N/m^α], normal damping c_n
[N·s/m^(1+α)], tangential damping k_t [N·s/m], spin damping k_ω [N·m·s/rad], depth exponent α [1]. Force and torque act on the
link, the torque about the link's origin; friction points along the object's motion.

Options, all off by default, applied in this order:

    densification D     s_j = d_j^α/(1 − min(d_j/D, 0.99)) replaces d_j^α
    loop Q, r           f_n,j ← max(0, f_n,j + Q e_j/r),  e_j ← clamp(e_j + Δd_j, −r, r), and 0 where d_j = 0
    balance solver      f_n,j ← λ_j W,  λ_j = q_j Q/(Q² + ε²),  q_j = max(0, f_n,j),  Q = Σ_j q_j,  W = Σ_c f_c · m_c
                        f_t,j ← f_t,j min(1, l_j/|f_t,j|),  l_j = λ_j Σ_c |f_c − (f_c · m_c) m_c|,  spin within ± l_j R_j
    friction_cone μ     f_t,j ← f_t,j min(1, l_j/|f_t,j|),  l_j = μ max(0, f_n,j), which replaces the l_j above
    torque_about taxel  τ_j without x_j × f_j

with f_n,j = f_j · m_j, f_t,j = k_t v_t,j and the spin torque k_ω (ω · m_j). j runs over the taxels of one body and c over the
solver's contacts on that body with all objects of the sensor. f_c is the contact's force on the body [N], m_c its normal and
R_j the probe's radius [m].

With `balance: solver` the magnitudes of a body's normal forces, each along its own m_j, sum to the solver's W in the
proportions of the law above. Under a ball or near an edge the normals diverge, and the vector sum is smaller than W. Friction
follows the law up to a limit: the cone of `friction_cone`, or else the solver's total tangential force, so that a frictionless
contact has none. The spin torque is limited to l_j R_j, because a contact patch is no larger than its probe. Forces stay
bounded as depth vanishes: |f_n,j| ≤ |W| and |f_t,j| ≤ l_j. A tensile f_n,j gets no part of W. ε is the normal force below
which a body counts as unloaded [N]: there the sum over taxels fades to zero. The force of contacts beyond `slots` acts at the
centre of the others.

`densification` models lattices and foams, which stiffen as their cells close. With α < 1 the force rises, levels off and rises
again. `loop` models the hysteresis of filled rubbers and magnetic elastomers: r is the depth over which the branches separate
and 2 Q their distance. It adds an elastoplastic element (Prandtl's stop operator) to the law, so that with α = 1 the force is
a Prandtl–Ishlinskii operator of the depth with one play of width r. It depends on the path of the depth, not on its rate.

Source: Chung et al., *Tactile Genesis*, appendix, "KinematicTaxel", with its parameters as defaults. The loop: Visintin,
*Differential Models of Hysteresis* (1994), chapter III. Densification: Gibson and Ashby, *Cellular Solids* (1997), chapter 5,
here a hyperbola.

Departures: the paper's tangential and spin terms have the opposite sign, −k_t v_t and −k_ω (ω · m) m. That is the force on the
object, although its normal force is the one on the sensor; `model: paper` keeps these signs. Velocities of the material are
computed from the velocities of body frame origins, which equals the paper's form from centres of mass. The options are ours.

Limits: unless balanced, the force follows depth and not load, as in the paper: its sum over a pad is not an object's weight.
The law has no static friction; `force_taxel` has.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Generic, Literal, NamedTuple

import numpy as np
import torch
from pydantic import Field, StrictInt, model_validator
from torch import Tensor

from tgdsl.fields.models import NonNegative, Positive, PositiveLength, Quantity, SpecModel, Usual
from tgdsl.geometry import planes
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.contact_depth import ContactDepth
from tgdsl.quantities.contacts import DEFAULT_SLOTS, ContactPoints, Contacts, ReferenceContacts
from tgdsl.quantities.reference import References
from tgdsl.sensors.base import (
    Array,
    ContactProbeSpec,
    Context,
    Kind,
    Lowered,
    Memory,
    ReferenceContext,
    ReferenceState,
    SurfaceOf,
    components,
    scalar,
    vector,
)
from tgdsl.sensors.noise import FORCE

CLOSED = 0.99  # largest depth over `densification`, so that the force stays finite


class LoopSpec(SpecModel):
    """A loop of loading and unloading: Prandtl's elastoplastic element."""

    force: Annotated[float, Quantity("force", gt=0.0), Usual("force", high=1e4)]
    """Q, half the distance of the two branches [N]."""
    width: Annotated[PositiveLength, Usual("length", high=0.1)]
    """r, depth over which the element yields [m]."""


class KinematicTaxelSpec(ContactProbeSpec):
    """Force and torque of each taxel from depth, normal and velocity."""

    kind: Literal["kinematic_taxel"]
    """Force [N] and torque [N·m] of each taxel from depth, normal and velocity."""
    outputs: Annotated[tuple[Literal["force", "torque"], ...], Field(min_length=1)] = ("force", "torque")
    """Quantities of a reading; others are not computed."""
    normal_stiffness: Annotated[NonNegative, Usual("number", high=1e7)] = 500.0
    """k_n, force per depth^α [N/m^α]."""
    normal_damping: NonNegative = 1.0
    """c_n, force per depth^α and normal velocity [N·s/m^(1+α)]."""
    depth_exponent: Positive = 1.2
    """α, power of the depth [1]."""
    shear_damping: NonNegative = 2.0
    """k_t, force per tangential velocity [N·s/m]."""
    spin_damping: NonNegative = 2.0
    """k_ω, torque per angular velocity about the normal [N·m·s/rad]."""
    model: Literal["tgdsl", "paper"] = "tgdsl"
    """`paper` keeps the paper's signs of the tangential and the spin term."""
    densification: Annotated[PositiveLength | None, Usual("length", high=1.0)] = None
    """D, depth at which the cells of a lattice are closed [m]; default: never."""
    loop: LoopSpec | None = None
    """Loop of loading and unloading; default: none."""
    friction_cone: NonNegative | None = None
    """μ, largest tangential over normal force [1]; default: no limit, as in the paper."""
    torque_about: Literal["link", "taxel"] = "link"
    """Point that torques are about: the link's origin as in the paper, or each taxel."""
    balance: Literal["none", "solver"] = "none"
    """`solver` has a body's taxels press with the solver's normal force, and bounds their friction; `none` as in the paper."""
    slots: Annotated[StrictInt, Field(ge=1)] = DEFAULT_SLOTS
    """Contacts per pair of body and object whose normals `balance` uses [1]."""

    @model_validator(mode="after")
    def _is_used(self) -> KinematicTaxelSpec:
        if self.balance == "none" and "slots" in self.model_fields_set:
            raise ValueError("`slots` is used by `balance: solver` alone, expected it to be left out")
        if "torque" not in self.outputs:
            for name in sorted(self.model_fields_set & {"spin_damping", "torque_about"}):
                raise ValueError(f"`{name}` has no effect without the output `torque`; remove it")
        return self

    @property
    def shear_sign(self) -> float:
        """Sign of the tangential and the spin term."""
        return -1.0 if self.model == "paper" else 1.0


def reference(
    spec: KinematicTaxelSpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return (f [N], τ [N·m]) of the outputs asked for, (taxel, 3) or (taxel, 6), and the loop's state."""
    touch = gathered[ContactDepth]
    forces, torques, num = np.zeros_like(layout.pos), np.zeros_like(layout.pos), layout.num_taxels
    pressed, shear, spin = np.zeros(num), np.zeros_like(layout.pos), np.zeros(num)
    stretch = np.zeros(num)
    for j, (d, m) in enumerate(zip(touch.depth, touch.normal, strict=True)):
        if d > 0:
            s, v = d**spec.depth_exponent, touch.velocity[j]
            s /= 1.0 if spec.densification is None else 1.0 - min(d / spec.densification, CLOSED)
            pressed[j] = spec.normal_stiffness * s + spec.normal_damping * s * (v @ m)
            if spec.loop is not None:
                width = spec.loop.width
                stretch[j] = np.clip(state["stretch"][j] + d - state["depth"][j], -width, width)
                pressed[j] = max(0.0, pressed[j] + spec.loop.force * stretch[j] / width)
            shear[j] = spec.shear_sign * spec.shear_damping * (v - (v @ m) * m)
            spin[j] = spec.shear_sign * spec.spin_damping * (touch.angular[j] @ m)
    limit = np.full(num, np.inf)
    if spec.balance == "solver":
        pressed, limit = reference_balance(pressed, layout.body_id, gathered[Contacts])
    if spec.friction_cone is not None:
        limit = spec.friction_cone * np.maximum(0.0, pressed)
    for j, (x, m) in enumerate(zip(layout.pos, touch.normal, strict=True)):
        size = np.linalg.norm(shear[j])
        forces[j] = pressed[j] * m + shear[j] * (limit[j] / size if size > limit[j] else 1.0)
        if spec.balance == "solver":
            spin[j] = np.clip(spin[j], -limit[j] * layout.radius[j], limit[j] * layout.radius[j])
        torques[j] = spin[j] * m
        if spec.torque_about == "link":
            torques[j] += np.cross(x, forces[j])
    parts = {"force": forces, "torque": torques}
    return np.concatenate([parts[name] for name in parts if name in spec.outputs], axis=1), (
        {} if spec.loop is None else {"stretch": stretch, "depth": touch.depth}
    )


def reference_balance(pressed: np.ndarray, body_id: np.ndarray, contacts: ReferenceContacts) -> tuple[np.ndarray, np.ndarray]:
    """Return normal forces f_n that sum to the solver's on each body [N], and the limits l of friction [N]: (taxel,)."""
    normal, limit = np.zeros_like(pressed), np.zeros_like(pressed)
    for b in np.unique(body_id):
        on_body, at = body_id == b, contacts.body == b
        along = np.sum(contacts.force[at] * contacts.normal[at], axis=1)
        across = np.linalg.norm(contacts.force[at] - along[:, None] * contacts.normal[at], axis=1)
        part = np.maximum(0.0, pressed[on_body])
        share = part * part.sum() / (part.sum() ** 2 + unloaded() ** 2)
        normal[on_body], limit[on_body] = share * along.sum(), share * across.sum()
    return normal, limit


@dataclass(frozen=True, eq=False)
class KinematicTaxelConstants(Generic[Array]):
    """Coefficients, with the sign of the model folded in; None where no output needs them."""

    normal_stiffness: Array
    normal_damping: Array
    depth_exponent: Array
    shear_damping: Array
    spin_damping: Array | None = None
    about_link: Array | None = None
    friction_cone: Array | None = None
    member: Array | None = None
    """Which body each taxel is on, 0 or 1 (taxel, body); with `body` only for `balance: solver`."""
    body: Array | None = None
    """The same as an index (taxel,)."""
    patch: Array | None = None
    """Radius of each probe [m]."""
    densification: Array | None = None
    """D [m]."""
    loop_stiffness: Array | None = None
    """Q/r [N/m]."""
    loop_width: Array | None = None
    """r [m]."""


class LoopState(NamedTuple):
    """Stretch e of the loop's element and the last depth, (env, taxel) [m]; None without a loop."""

    stretch: Tensor | None = None
    depth: Tensor | None = None


def lower(spec: KinematicTaxelSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """Fold the sign of the model into the damping constants; leave out what no output needs."""
    parts = {"force": vector("force", "N"), "torque": vector("torque", "N·m")}
    channels = tuple(channel for name, part in parts.items() if name in spec.outputs for channel in part)
    has_torque, is_balanced = "torque" in spec.outputs, spec.balance == "solver"
    member = layout.body_id[:, None] == np.arange(len(layout.bodies))
    constants = KinematicTaxelConstants(
        normal_stiffness=scalar(spec.normal_stiffness),
        normal_damping=scalar(spec.normal_damping),
        depth_exponent=scalar(spec.depth_exponent),
        shear_damping=scalar(spec.shear_sign * spec.shear_damping),
        spin_damping=scalar(spec.shear_sign * spec.spin_damping) if has_torque else None,
        about_link=scalar(1.0) if has_torque and spec.torque_about == "link" else None,
        friction_cone=None if spec.friction_cone is None else scalar(spec.friction_cone),
        member=member.astype(np.float64) if is_balanced else None,
        body=layout.body_id if is_balanced else None,
        patch=np.maximum(layout.radius, 0.0) if is_balanced and has_torque else None,
        densification=None if spec.densification is None else scalar(spec.densification),
        loop_stiffness=None if spec.loop is None else scalar(spec.loop.force / spec.loop.width),
        loop_width=None if spec.loop is None else scalar(spec.loop.width),
    )
    motion = bool(spec.normal_damping or spec.shear_damping or (has_torque and spec.spin_damping))
    depth = ContactDepth(spec.objects, spec.is_gated, normal=True, motion=motion)
    requests = (depth, Contacts(spec.objects, slots=spec.slots)) if is_balanced else (depth,)
    state = {} if spec.loop is None else {name: Memory() for name in LoopState._fields}
    return Lowered(channels, constants, state, requests)


def forward(
    gathered: Gathered, context: Context, constants: KinematicTaxelConstants[Tensor], state: LoopState
) -> tuple[dict[str, Tensor], LoopState]:
    """Return the force planes [N] and, if wanted, the torque planes [N·m], and the loop's state.

    Where nothing is touched, depth, normal and motion are all zero, and so is every term.
    """
    touch = gathered[ContactDepth]
    assert touch.normal is not None
    stiffness, after = planes.power(touch.depth, constants.depth_exponent), LoopState()
    if constants.densification is not None:
        stiffness = stiffness / (1.0 - (touch.depth / constants.densification).clamp(max=CLOSED))
    pressed, shear, limit = constants.normal_stiffness * stiffness, None, None
    if touch.velocity is not None:
        approach = planes.dot(touch.velocity, touch.normal)
        pressed = pressed + constants.normal_damping * stiffness * approach
        shear = planes.scale(constants.shear_damping, planes.sub(touch.velocity, planes.scale(approach, touch.normal)))
    if constants.loop_stiffness is not None and constants.loop_width is not None:
        assert state.stretch is not None and state.depth is not None
        width = constants.loop_width
        stretch = torch.minimum(torch.maximum(state.stretch + touch.depth - state.depth, -width), width)
        stretch = torch.where(touch.depth > 0, stretch, touch.depth)
        pressed, is_broken = (pressed + constants.loop_stiffness * stretch).clamp(min=0), touch.depth.isnan()
        fields = (torch.where(is_broken, *pair) for pair in ((state.stretch, stretch), (state.depth, touch.depth)))
        after = LoopState(*fields)  # after a pose that is not finite the loop goes on from the last finite depth
    if constants.member is not None and constants.body is not None:
        pressed, limit = _balanced(pressed, gathered[Contacts], constants.member, constants.body)
    if constants.friction_cone is not None:
        limit = constants.friction_cone * pressed.clamp(min=0)
    force = planes.scale(pressed, touch.normal)
    if shear is not None:
        force = planes.add(force, shear if limit is None else _within(limit, shear))
    readings = components("force", force)
    if constants.spin_damping is not None:
        none = touch.depth * 0.0  # not-a-number where the pose is
        torque = planes.cross(touch.pos, force) if constants.about_link is not None else (none, none, none)
        if touch.angular is not None:
            spin = constants.spin_damping * planes.dot(touch.angular, touch.normal)
            if constants.patch is not None and limit is not None:
                largest = constants.patch * limit
                spin = torch.minimum(torch.maximum(spin, -largest), largest)
            torque = planes.add(torque, planes.scale(spin, touch.normal))
        readings |= components("torque", torque)
    return readings, after


def unloaded() -> float:
    """Return ε, up to which normal force of its taxels [N] a body counts as unloaded."""
    return 1e-12


def _within(limit: Tensor, shear: planes.Vec) -> planes.Vec:
    size = planes.safe_sqrt(planes.dot(shear, shear))
    is_outside = size > limit
    return planes.scale(torch.where(is_outside, limit / torch.where(is_outside, size, 1.0), 1.0), shear)


def _balanced(pressed: Tensor, contacts: ContactPoints, member: Tensor, body: Tensor) -> tuple[Tensor, Tensor]:
    """Return normal forces that sum to the solver's on each body [N], and the limits of friction [N]: (env, taxel)."""
    along = planes.dot(contacts.force, contacts.normal)
    across = planes.sub(contacts.force, planes.scale(along, contacts.normal))
    part = pressed.clamp(min=0)
    total = part @ member
    per_part = total / (total * total + unloaded() ** 2)
    normal = per_part * along.sum(dim=-1)
    limit = per_part * planes.safe_sqrt(planes.dot(across, across)).sum(dim=-1)
    return part * normal[:, body], part * limit[:, body]


KINEMATIC_TAXEL = Kind(
    KinematicTaxelSpec,
    lower,
    forward,
    reference,
    knobs=FORCE,
    is_pointwise=True,
    constants=KinematicTaxelConstants,
    state=LoopState,
)

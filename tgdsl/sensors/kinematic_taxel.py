"""Kinematic taxel: force and torque from depth, contact normal and relative velocity, without a deformable substrate.

    s_j = d_j^α
    f_j = k_n s_j m_j + c_n s_j v_n,j + k_t v_t,j                                             [N]
    τ_j = x_j × f_j + k_ω (ω · m_j) m_j                                                       [N·m]

where d_j > 0, and zero elsewhere. All vectors are in the frame of the taxel's link: d_j contact depth [m] and m_j unit normal
out of the object (see `contact_depth`), v_j velocity of the object's material at the probe relative to the probe [m/s],
v_n = (v · m) m and v_t = v − v_n, ω angular velocity of the object relative to the link [rad/s], x_j the probe's place [m].
Force and torque act on the link, the torque about the link's origin: friction points along the object's motion.

Options, all off by default, in this order:

    friction_cone μ     f_t ← f_t min(1, μ max(0, f_n)/|f_t|), f_t = k_t v_t, f_n = f · m; the spin term is left as it is
    torque_about taxel  τ_j without x_j × f_j
    balance solver      f_j ← g f_j, τ_j ← g τ_j for all j of a body, g = Σ_c f_c · m_c / Σ_j f_n,j

with f_c the solver's forces on the body at its contacts c with the sensor's objects and m_c their normals: the taxels then
press with what the solver presses with. Where Σ_j f_n,j is not positive there is nothing to scale: the body's taxels read
zero, and the solver's force is not carried. What contacts beyond `slots` carry acts at the centre of the others, and counts.
`force_taxel` shares out forces.

Source: Chung et al., *Tactile Genesis*, appendix, "KinematicTaxel", with its parameters as defaults.

Departures: the paper's tangential and spin terms have the opposite sign, −k_t v_t and −k_ω (ω · m) m, which is the force on
the object while its normal force is the one on the sensor; `model: paper` keeps them. Velocities are those of the material at
the probe from the bodies' frame origins, which equals the paper's form from centres of mass. As in the paper the force
follows depth, not load, unless balanced: summed over a pad it is not the weight of what rests there. The options are ours.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import Field, StrictInt, model_validator
from torch import Tensor

from tgdsl.fields import NonNegative, Positive
from tgdsl.geometry import planes
from tgdsl.geometry.query import Felt, Probes
from tgdsl.geometry.reference import Touch
from tgdsl.layout import Layout
from tgdsl.sensors.base import Channel, Constants, ContactProbeSpec, Kind, Lowered, ReferenceState, State, SurfaceOf, scalar
from tgdsl.sensors.noise import FORCE


class KinematicTaxelSpec(ContactProbeSpec):
    """Force and torque of each taxel from depth, normal and velocity."""

    kind: Literal["kinematic_taxel"]
    """Force [N] and torque [N·m] of each taxel from depth, normal and velocity."""
    outputs: Annotated[tuple[Literal["force", "torque"], ...], Field(min_length=1)] = ("force", "torque")
    """What a reading holds; what is not listed is not computed."""
    normal_stiffness: NonNegative = 500.0
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
    friction_cone: NonNegative | None = None
    """μ, largest tangential over normal force [1]; default: no limit, as in the paper."""
    torque_about: Literal["link", "taxel"] = "link"
    """Point that torques are about: the link's origin as in the paper, or each taxel."""
    balance: Literal["none", "solver"] = "none"
    """`solver` scales a body's taxels so that they press with the solver's normal force; `none` as in the paper."""
    slots: Annotated[StrictInt, Field(ge=1)] = 8
    """Contacts per pair of body and object whose normals `balance` takes [1]."""

    @model_validator(mode="after")
    def _is_used(self) -> KinematicTaxelSpec:
        if self.balance == "none" and "slots" in self.model_fields_set:
            raise ValueError("`slots` is used by `balance: solver` alone, expected it to be left out")
        if "torque" not in self.outputs and "torque_about" in self.model_fields_set:
            raise ValueError("`torque_about` is not used without torque, expected it to be left out")
        return self

    @property
    def shear_sign(self) -> float:
        """Sign of the tangential and the spin term."""
        return -1.0 if self.model == "paper" else 1.0


def reference(
    spec: KinematicTaxelSpec, layout: Layout, touch: Touch, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return (f [N], τ [N·m]) of the outputs asked for, (taxel, 3) or (taxel, 6)."""
    forces, torques, pressed = np.zeros_like(layout.pos), np.zeros_like(layout.pos), np.zeros(layout.num_taxels)
    for j, (x, d, m) in enumerate(zip(layout.pos, touch.depth, touch.normal, strict=True)):
        if d > 0:
            s, v = d**spec.depth_exponent, touch.velocity[j]
            v_n = (v @ m) * m
            shear = spec.shear_sign * spec.shear_damping * (v - v_n)
            normal = spec.normal_stiffness * s * m + spec.normal_damping * s * v_n
            pressed[j], size = normal @ m, np.linalg.norm(shear)
            if spec.friction_cone is not None and size > 0:
                shear *= min(1.0, spec.friction_cone * max(0.0, pressed[j]) / size)
            forces[j] = normal + shear
            torques[j] = spec.shear_sign * spec.spin_damping * (touch.angular[j] @ m) * m
            if spec.torque_about == "link":
                torques[j] += np.cross(x, forces[j])
    if spec.balance == "solver":
        assert touch.contacts is not None
        for b in range(len(layout.bodies)):
            own, at = layout.body_id == b, touch.contacts.body == b
            wanted = np.sum(touch.contacts.force[at] * touch.contacts.normal[at])
            factor = wanted / pressed[own].sum() if pressed[own].sum() > no_force() else 0.0
            forces[own], torques[own] = factor * forces[own], factor * torques[own]
    return np.concatenate([{"force": forces, "torque": torques}[name] for name in _ordered(spec)], axis=1), {}


def _ordered(spec: KinematicTaxelSpec) -> tuple[str, ...]:
    return tuple(name for name in ("force", "torque") if name in spec.outputs)


def lower(spec: KinematicTaxelSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """Fold the sign of the model into the damping constants; leave out what no output needs."""
    constants = {
        "normal_stiffness": scalar(spec.normal_stiffness),
        "normal_damping": scalar(spec.normal_damping),
        "depth_exponent": scalar(spec.depth_exponent),
        "shear_damping": scalar(spec.shear_sign * spec.shear_damping),
    }
    channels: list[Channel] = []
    if "force" in spec.outputs:
        channels += [Channel(f"force_{axis}", "N") for axis in "xyz"]
    if "torque" in spec.outputs:
        channels += [Channel(f"torque_{axis}", "N·m") for axis in "xyz"]
        constants["spin_damping"] = scalar(spec.shear_sign * spec.spin_damping)
        if spec.torque_about == "link":
            constants["about_link"] = scalar(1.0)
    if spec.friction_cone is not None:
        constants["friction_cone"] = scalar(spec.friction_cone)
    needs = {"normal"}
    if spec.normal_damping or spec.shear_damping or ("torque" in spec.outputs and spec.spin_damping):
        needs.add("motion")
    if spec.balance == "none":
        return Lowered(tuple(channels), constants, needs=frozenset(needs))
    member = layout.body_id[:, None] == np.arange(len(layout.bodies))
    constants |= {"member": member.astype(np.float64), "body": layout.body_id}
    return Lowered(tuple(channels), constants, needs=frozenset({*needs, "contacts"}), slots=spec.slots)


def forward(felt: Felt, probes: Probes, constants: Constants, state: State) -> tuple[dict[str, Tensor], State]:
    """Return the force planes [N] and, if wanted, the torque planes [N·m].

    Where nothing is touched, depth, normal and motion are all zero, and so is every term.
    """
    assert felt.normal is not None
    stiffness = planes.power(felt.depth, constants["depth_exponent"])
    pressed = constants["normal_stiffness"] * stiffness
    force = planes.scale(pressed, felt.normal)
    if felt.velocity is not None:
        approach = planes.dot(felt.velocity, felt.normal)
        pressed = pressed + constants["normal_damping"] * stiffness * approach
        shear = planes.sub(felt.velocity, planes.scale(approach, felt.normal))
        shear = _in_cone(planes.scale(constants["shear_damping"], shear), pressed, constants.get("friction_cone"))
        force = planes.add(planes.scale(pressed, felt.normal), shear)
    factor = _balance(pressed, felt, constants) if "member" in constants else None
    force = force if factor is None else planes.scale(factor, force)
    readings = {f"force_{axis}": plane for axis, plane in zip("xyz", force, strict=True)}
    if "spin_damping" in constants:
        none = felt.depth * 0.0  # not-a-number where the pose is
        torque = planes.cross(probes.pos, force) if "about_link" in constants else (none, none, none)
        if felt.angular is not None:
            spin = constants["spin_damping"] * planes.dot(felt.angular, felt.normal)
            torque = planes.add(torque, planes.scale(spin if factor is None else spin * factor, felt.normal))
        readings |= {f"torque_{axis}": plane for axis, plane in zip("xyz", torque, strict=True)}
    return readings, {}


def no_force() -> float:
    """Return up to which normal force of a body's taxels [N] there is nothing to balance."""
    return 1e-9


def _in_cone(shear: planes.Vec, pressed: Tensor, friction: Tensor | None) -> planes.Vec:
    """Return tangential forces [N], scaled back to the friction cone of the normal forces where they leave it."""
    if friction is None:
        return shear
    size, limit = planes.safe_sqrt(planes.dot(shear, shear)), friction * pressed.clamp(min=0)
    is_outside = size > limit
    return planes.scale(torch.where(is_outside, limit / torch.where(is_outside, size, 1.0), 1.0), shear)


def _balance(pressed: Tensor, felt: Felt, constants: Constants) -> Tensor:
    """Return the factor of each taxel, (env, taxel), that makes its body's normal forces sum to the solver's."""
    contacts = felt.contacts
    assert contacts is not None
    wanted = planes.dot(contacts.force, contacts.normal).sum(dim=-1)
    total = pressed @ constants["member"]
    is_pressed = total > no_force()
    return torch.where(is_pressed, wanted / torch.where(is_pressed, total, 1.0), 0.0)[:, constants["body"]]


KINEMATIC_TAXEL = Kind(KinematicTaxelSpec, lower, forward, reference, knobs=FORCE, is_pointwise=True)

"""Kinematic taxel: force and torque from depth, contact normal and relative velocity, without a deformable substrate.

    s_j = d_j^α
    f_j = k_n s_j m_j + c_n s_j v_n,j + k_t v_t,j                                             [N]
    τ_j = x_j × f_j + k_ω (ω · m_j) m_j                                                       [N·m]

where d_j > 0, and zero elsewhere. All vectors are in the frame of the taxel's link: d_j contact depth [m] and m_j unit normal
out of the object (see `contact_depth`), v_j velocity of the object's material at the probe relative to the probe [m/s],
v_n = (v · m) m and v_t = v − v_n, ω angular velocity of the object relative to the link [rad/s], x_j the probe's place [m].
Force and torque act on the link, the torque about the link's origin: friction points along the object's motion.

Source: Chung et al., *Tactile Genesis*, appendix, "KinematicTaxel", with its parameters as defaults.

Departures: the paper's tangential and spin terms have the opposite sign, −k_t v_t and −k_ω (ω · m) m, which is the force on
the object while its normal force is the one on the sensor; `model: paper` keeps them. Velocities are those of the material at
the probe from the bodies' frame origins, which equals the paper's form from centres of mass. As in the paper the force
follows depth, not load: summed over a pad it is not the weight of what rests there, and it has no friction cone.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from torch import Tensor

from tgdsl.fields import NonNegative, Positive
from tgdsl.geometry import planes
from tgdsl.geometry.query import Felt, Probes
from tgdsl.geometry.reference import Touch
from tgdsl.layout import Layout
from tgdsl.sensors.base import Channel, Constants, ContactProbeSpec, Kind, Lowered, ReferenceState, State, SurfaceOf, scalar


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

    @property
    def shear_sign(self) -> float:
        """Sign of the tangential and the spin term."""
        return -1.0 if self.model == "paper" else 1.0


def reference(
    spec: KinematicTaxelSpec, layout: Layout, touch: Touch, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return (f [N], τ [N·m]) of the outputs asked for, (taxel, 3) or (taxel, 6)."""
    rows = []
    for x, d, m, v, w in zip(layout.pos, touch.depth, touch.normal, touch.velocity, touch.angular, strict=True):
        force, torque = np.zeros(3), np.zeros(3)
        if d > 0:
            s = d**spec.depth_exponent
            v_n = (v @ m) * m
            force = spec.normal_stiffness * s * m + spec.normal_damping * s * v_n
            force += spec.shear_sign * spec.shear_damping * (v - v_n)
            torque = np.cross(x, force) + spec.shear_sign * spec.spin_damping * (w @ m) * m
        rows.append(np.concatenate([{"force": force, "torque": torque}[name] for name in _ordered(spec)]))
    return np.stack(rows), {}


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
    needs = {"normal"}
    if spec.normal_damping or spec.shear_damping or ("torque" in spec.outputs and spec.spin_damping):
        needs.add("motion")
    return Lowered(tuple(channels), constants, needs=frozenset(needs))


def forward(felt: Felt, probes: Probes, constants: Constants, state: State) -> tuple[dict[str, Tensor], State]:
    """Return the force planes [N] and, if wanted, the torque planes [N·m].

    Where nothing is touched, depth, normal and motion are all zero, and so is every term.
    """
    assert felt.normal is not None
    stiffness = felt.depth ** constants["depth_exponent"]
    along_normal = constants["normal_stiffness"] * stiffness
    force = planes.scale(along_normal, felt.normal)
    if felt.velocity is not None:
        drag = constants["shear_damping"]
        approach = planes.dot(felt.velocity, felt.normal)
        along_normal = along_normal + (constants["normal_damping"] * stiffness - drag) * approach
        force = planes.add(planes.scale(along_normal, felt.normal), planes.scale(drag, felt.velocity))
    readings = {f"force_{axis}": plane for axis, plane in zip("xyz", force, strict=True)}
    if "spin_damping" in constants:
        torque = planes.cross(probes.pos, force)
        if felt.angular is not None:
            spin = constants["spin_damping"] * planes.dot(felt.angular, felt.normal)
            torque = planes.add(torque, planes.scale(spin, felt.normal))
        readings |= {f"torque_{axis}": plane for axis, plane in zip("xyz", torque, strict=True)}
    return readings, {}


KINEMATIC_TAXEL = Kind(KinematicTaxelSpec, lower, forward, reference)

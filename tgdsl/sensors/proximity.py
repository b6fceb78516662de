"""Proximity taxel: force and torque from the object surface within a sensing ball, and from its velocity.

    S0 = ∫ (R − |p − q|)₊ dA [m³]      S1 = ∫ (R − |p − q|)₊ (p − q) dA [m⁴]      ρ = density / A [1/m²]
    f = −k ρ S0 a + k_s ρ Σ_t                                                       [N]
    τ = −k ρ S1 × a                    Σ = S0 v + ω × S1,   Σ_t = Σ − (Σ · a) a     [N·m]

summed over the sensed objects, in the frame of the taxel's link. q is the taxel's position, R its radius [m] and a its outward
normal; p runs over an object's outer surface. v is the velocity of the object's material at q relative to the taxel [m/s] and ω
the object's angular velocity relative to the link [rad/s], so Σ = ∫ (R − |p − q|)₊ (v + ω × (p − q)) dA [m⁴/s]. A is the
surface area of all sensed objects except planes, which are infinite, or `reference_area` [m²]. k [N/m] and k_s [N·s/m²] are
`normal_stiffness` and `shear_damping`; `density` has no unit. Force and torque act on the link: surface in front pushes it
back, and tangential motion drags it along. The torque is about the taxel, or about the link's origin: τ + x × f with x the
taxel's position. There is no contact gate.

Source: Chung et al., *Tactile Genesis*, appendix, "ProximityTaxel", with its parameters as defaults. Its sum over N sampled
points with ρ = density / N converges to density ∫ … dA / A; `backend: points` sums over sampled points as the paper does.

Departures: the paper's normal force and its torque have the opposite sign, +k ρ S0 a and +k ρ S1 × a, which pulls the sensor
towards the object. The paper's slip is v + ω_object × (p − q) with the object's absolute angular velocity, so a hand that
rotates together with an object reads slip. `model: paper` keeps both.

Limits: as in the paper, the tangential force does not contribute to the torque about the taxel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Generic, Literal

import numpy as np
from pydantic import Field, StrictInt, model_validator
from torch import Tensor

from tgdsl.fields.models import Area, NonNegative, Positive, PositiveLength, Quantity, Usual
from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.moments import MomentsRequest, SurfaceMoments
from tgdsl.quantities.reference import References
from tgdsl.sensors.base import (
    Alternative,
    Array,
    Context,
    Kind,
    Lowered,
    ProbeSpec,
    ReferenceContext,
    ReferenceState,
    State,
    SurfaceOf,
    components,
    scalar,
    vector,
)
from tgdsl.sensors.noise import FORCE


class ProximitySpec(ProbeSpec):
    """Force and torque of each taxel from the surfaces near it."""

    kind: Literal["proximity"]
    """Force [N] and torque [N·m] of each taxel from the surfaces near it."""
    radius: Annotated[PositiveLength | None, Usual("length", low=1e-5, high=0.1)] = None
    """R, sensing radius of all of the sensor's taxels [m]; default: each taxel's radius in the layout."""
    backend: Literal["field", "points"] = "field"
    """`field`: interpolated from a field that is computed beforehand; `points`: a sum over sampled points (the paper). Planes
    are exact in both."""
    points: Annotated[StrictInt, Field(ge=1)] = 5000
    """Points of each object, for `backend: points`."""
    tolerance: Annotated[float, Quantity("number", gt=0.0), Field(lt=1.0)] = 0.005
    """Root mean square error that a field may have, as a fraction of full scale [1]."""
    gradient_tolerance: Annotated[float | None, Quantity("number", gt=0.0), Field(lt=1.0)] = None
    """Error that 99.9 % of the gradients of S0 by place may have, as a fraction of the largest one [1]: fields are then sums of
    quadratic B-splines, whose gradients have no jumps. Default: the error of gradients is not limited."""
    max_bytes: Annotated[StrictInt, Field(ge=1)] = 64 * 2**20
    """Largest size of an object's fields, or of its lists of points [bytes]."""
    outputs: Annotated[tuple[Literal["force", "torque"], ...], Field(min_length=1)] = ("force", "torque")
    """Quantities of a reading; others are not computed."""
    normal_stiffness: Annotated[NonNegative, Usual("number", high=1e7)] = 300.0
    """k, force per depth [N/m]."""
    shear_damping: NonNegative = 10.0
    """k_s, force per depth and velocity [N·s/m²]."""
    density: Positive = 100.0
    """Total weight of the sensed surface, or of its points [1]."""
    reference_area: Area | None = None
    """A, area that the density is spread over [m²]; default: the area of all sensed objects except planes."""
    torque_about: Literal["taxel", "link"] = "taxel"
    """Point that the torque is about: the taxel (the paper), or the link's origin."""
    model: Literal["tgdsl", "paper"] = "tgdsl"
    """`paper` keeps the paper's sign of the normal part, and its slip with the object's absolute angular velocity."""

    @model_validator(mode="after")
    def _is_used(self) -> ProximitySpec:
        unused = {"points"} if self.backend == "field" else {"tolerance", "gradient_tolerance"}
        for name in sorted(unused & self.model_fields_set):
            raise ValueError(f"`{name}` has no effect with `backend: {self.backend}`; remove it")
        if "torque" not in self.outputs and "torque_about" in self.model_fields_set:
            raise ValueError("`torque_about` has no effect without the output `torque`; remove it")
        if self.outputs == ("torque",) and self.torque_about == "taxel" and "shear_damping" in self.model_fields_set:
            raise ValueError("`shear_damping` has no effect on torque about the taxel; remove it")
        return self

    @property
    def normal_sign(self) -> float:
        """Sign of the normal part."""
        return 1.0 if self.model == "paper" else -1.0


def reference(
    spec: ProximitySpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return (f [N], τ [N·m]) of the outputs asked for, (taxel, 3) or (taxel, 6)."""
    near = gathered[MomentsRequest]
    area = near.area.sum() if spec.reference_area is None else spec.reference_area
    rho, rows = spec.density / area, []
    for t, (x, a) in enumerate(zip(layout.pos, layout.normal, strict=True)):
        force, torque = np.zeros(3), np.zeros(3)
        for k in range(near.mass.shape[1]):
            s0, s1 = near.mass[t, k], near.first[t, k]
            omega = near.angular[t, k] + (near.turn[t] if spec.model == "paper" else 0.0)
            slip = s0 * near.velocity[t, k] + np.cross(omega, s1)
            force += spec.normal_sign * spec.normal_stiffness * rho * s0 * a
            force += spec.shear_damping * rho * (slip - (slip @ a) * a)
            torque += spec.normal_sign * spec.normal_stiffness * rho * np.cross(s1, a)
        torque += np.cross(x, force) if spec.torque_about == "link" else 0.0
        rows.append(np.concatenate([{"force": force, "torque": torque}[n] for n in ("force", "torque") if n in spec.outputs]))
    return np.stack(rows), {}


@dataclass(frozen=True, eq=False)
class ProximityConstants(Generic[Array]):
    """Coefficients times density, with the sign of the model; None: the objects' area, and torques about the taxel."""

    normal: Array
    stiffness: Array
    damping: Array
    is_absolute: Array
    """Whether slip is of the object's absolute angular velocity."""
    area: Array | None = None
    about_link: Array | None = None


def lower(spec: ProximitySpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """Fold sign and density into the stiffness; leave out what no output needs."""
    is_about_link = "torque" in spec.outputs and spec.torque_about == "link"
    constants = ProximityConstants(
        normal=layout.normal.T,
        stiffness=scalar(spec.normal_sign * spec.normal_stiffness * spec.density),
        damping=scalar(spec.shear_damping * spec.density),
        is_absolute=np.asarray(spec.model == "paper"),
        area=None if spec.reference_area is None else scalar(spec.reference_area),
        about_link=scalar(1.0) if is_about_link else None,
    )
    parts = {"force": vector("force", "N"), "torque": vector("torque", "N·m")}
    channels = tuple(channel for name, part in parts.items() if name in spec.outputs for channel in part)
    request = MomentsRequest(
        objects=spec.objects,
        radius=spec.radius,
        backend=spec.backend,
        num_points=spec.points,
        tolerance=spec.tolerance,
        gradient_tolerance=spec.gradient_tolerance,
        max_bytes=spec.max_bytes,
        with_area=spec.reference_area is None,
        motion=bool(spec.shear_damping and ("force" in spec.outputs or is_about_link)),
    )
    return Lowered(channels, constants, requests=(request,))


def forward(
    gathered: Gathered, context: Context, constants: ProximityConstants[Tensor], state: State
) -> tuple[dict[str, Tensor], State]:
    """Return the force planes [N] and the torque planes [N·m]; planes that are not read cost nothing once compiled."""
    normal = planes.split(constants.normal.T)
    surfaces = gathered[MomentsRequest]
    zero = surfaces.none
    mass, first, slip = zero, (zero, zero, zero), (zero, zero, zero)
    for name, near in surfaces.moments.items():
        mass, first = mass + near.mass, planes.add(first, near.first)
        if name in surfaces.motions:
            slip = planes.add(slip, _slip(surfaces, name, constants.is_absolute))
    area = sum(surfaces.area.values(), start=zero[:1, :1]) if constants.area is None else constants.area
    stiffness, damping = constants.stiffness / area, constants.damping / area
    # Less its part along the normal. Without the inner product, which all three components would share, a compiler that fuses
    # computes all channels in one pass; it would else compute each of them for every number of a reading.
    slip = planes.cross(planes.cross(normal, slip), normal)
    force = planes.add(planes.scale(stiffness * mass, normal), planes.scale(damping, slip))
    torque = planes.scale(stiffness, planes.cross(first, normal))
    if constants.about_link is not None:
        torque = planes.add(torque, planes.cross(surfaces.pos, force))
    return components("force", force) | components("torque", torque), {}


def _slip(surfaces: SurfaceMoments, name: str, is_absolute: Tensor) -> Vec:
    """Return Σ of an object [m⁴/s]."""
    near, motion = surfaces.moments[name], surfaces.motions[name]
    velocity = planes.add(motion.linear, planes.cross(motion.angular, surfaces.pos))
    omega = planes.add(motion.angular, planes.scale(is_absolute, motion.turn))
    return planes.add(planes.scale(near.mass, velocity), planes.cross(omega, near.first))


def alternatives(spec: ProximitySpec) -> list[Alternative]:
    """Return sums over points, and fields of several tolerances."""
    of_fields, of_points = ("tolerance", "gradient_tolerance"), ("points",)
    clouds = [Alternative(f"{num} points", {"backend": "points", "points": num}, of_fields) for num in (1000, 5000)]
    fields = [
        Alternative(f"field, {100 * e:g} %", {"backend": "field", "tolerance": e}, of_points) for e in (0.05, 0.02, 0.005)
    ]
    finest = {"backend": "field", "tolerance": 0.002, "max_bytes": 2**28}
    return [*clouds, *fields, Alternative("field, 0.2 %", finest, of_points)]


PROXIMITY = Kind(ProximitySpec, lower, forward, reference, knobs=FORCE, alternatives=alternatives, constants=ProximityConstants)

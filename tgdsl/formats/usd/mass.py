"""Mass, centre of mass and inertia of USD bodies, by the precedence that UsdPhysics sets out in its MassAPI."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tgdsl.formats.model import LEAST_INERTIA
from tgdsl.formats.usd.attributes import read_custom
from tgdsl.formats.usd.geoms import Gprim
from tgdsl.formats.usd.joints import rotation_of
from tgdsl.formats.usd.stage import Prim, Stage

DENSITY = 1000.0  # what a collider weighs if nothing says so: UsdPhysics takes water [kg/m³]
FALLBACK_RADIUS = 0.1  # radius of the ball whose inertia a body with a mass, but neither inertia nor geometry, gets [m]
Vector = Float[np.ndarray, "3"]
Tensor = Float[np.ndarray, "3 3"]


@dataclass(frozen=True, eq=False)
class Inertial:
    """Mass, centre of mass and inertia of a body, in its frame."""

    mass: float  # [kg]
    centre: Vector  # centre of mass [m]
    tensor: Tensor  # inertia about it [kg·m²]
    # principal moments [kg·m²] and the rotation of their axes, if they are given in an order of their own
    axes: tuple[Vector, Rotation] | None = None

    def principal(self) -> tuple[Vector, Rotation]:
        """Return the principal moments [kg·m²] and the rotation of their axes."""
        return self.ascending() if self.axes is None else self.axes

    def ascending(self) -> tuple[Vector, Rotation]:
        moments, axes = np.linalg.eigh(self.tensor)
        axes[:, 2] *= np.sign(np.linalg.det(axes))
        return moments, Rotation.from_matrix(axes)

    def about(self, point: Vector) -> Tensor:
        """Return the inertia about another point [kg·m²]."""
        arm = point - self.centre
        return self.tensor + self.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))


@dataclass(frozen=True, eq=False)
class _Authored:
    """What a prim's MassAPI says, in SI, lengths along the prim's own axes; None or 0 where it says nothing."""

    mass: float = 0.0
    density: float = 0.0
    centre: Vector | None = None
    tensor: Tensor | None = None
    axes: tuple[Vector, Rotation] | None = None


def inertial_of(stage: Stage, body: Prim, geoms: Sequence[Gprim]) -> Inertial | None:
    """Return the mass and inertia of a body, or None if it has neither mass nor colliders."""
    authored = _authored(stage, body)
    if (exact := _with_zeros(stage, body, authored)) is not None:
        return exact
    colliders = [geom for geom in geoms if geom.is_collider and geom.shape.kind != "plane"]
    masses = [_authored(stage, geom.prim) if geom.path != geom.body else _Authored() for geom in colliders]
    if authored.mass and authored.centre is not None and authored.tensor is not None:
        return _repaired(stage, body, Inertial(authored.mass, authored.centre, authored.tensor, authored.axes))
    parts = [_collider(stage, geom, mass, authored.density) for geom, mass in zip(colliders, masses, strict=True)]
    whole = _sum([part for part in parts if part.mass > 0])
    if authored.mass and whole is not None:
        whole = Inertial(authored.mass, whole.centre, whole.tensor * (authored.mass / whole.mass))
    elif authored.mass and authored.tensor is None:
        whole = _fallback_inertial(stage, body, authored.mass, geoms)
    elif authored.mass:
        whole = Inertial(authored.mass, np.zeros(3), np.zeros((3, 3)))
    return None if whole is None else _repaired(stage, body, _overruled(whole, authored))


def _authored(stage: Stage, prim: Prim) -> _Authored:
    if not stage.has(prim, "PhysicsMassAPI"):
        return _Authored()
    mass, density = stage.number(prim, "physics:mass"), stage.number(prim, "physics:density")
    moments = np.array(stage.value(prim, "physics:diagonalInertia"), dtype=np.float64)
    for name, value in (("mass", mass), ("density", density), ("diagonalInertia", moments)):
        if not np.isfinite(value).all() or np.min(value) < 0:
            raise stage.error(prim, f"physics:{name} is {np.asarray(value).tolist()}; expected 0 or more")
    centre = np.array(stage.value(prim, "physics:centerOfMass"), dtype=np.float64)
    tensor, axes = _full_tensor(stage, prim), None
    if tensor is None and moments.any():
        quat = stage.value(prim, "physics:principalAxes")
        is_turned = quat.GetReal() or any(quat.GetImaginary())
        turn = rotation_of(stage, prim, "physics:principalAxes") if is_turned else Rotation.identity()
        axes = (moments * stage.kilograms_per_unit * stage.metres_per_unit**2, turn)
        tensor = turn.as_matrix() @ np.diag(axes[0]) @ turn.as_matrix().T
    return _Authored(
        mass * stage.kilograms_per_unit,
        density * stage.kilograms_per_unit / stage.metres_per_unit**3,
        stage.frame(prim)[1] * centre if np.isfinite(centre).all() else None,
        tensor,
        axes,
    )


def _with_zeros(stage: Stage, body: Prim, authored: _Authored) -> Inertial | None:
    """Return the mass and inertia of which some are zero, as `export` wrote them: mass, moments and axes (w x y z)."""
    values = np.array(read_custom(stage, body, "inertial") or (), dtype=np.float64)
    if not values.size or authored.tensor is not None or np.float32(authored.mass) != np.float32(values[0]):
        return None
    if values.size != 8 or not np.isfinite(values).all() or values[:4].min() < 0 or not values[4:].any():
        raise stage.error(body, f"tgdsl:inertial is {values.tolist()}; expected a mass, three moments and a quaternion")
    turn = Rotation.from_quat(values[4:], scalar_first=True)
    tensor = turn.as_matrix() @ np.diag(values[1:4]) @ turn.as_matrix().T
    return Inertial(authored.mass, np.zeros(3) if authored.centre is None else authored.centre, tensor, (values[1:4], turn))


def _full_tensor(stage: Stage, prim: Prim) -> Tensor | None:
    """Return `newton:inertia` (xx, yy, zz, xy, xz, yz) [kg·m²], which overrules the principal moments and axes."""
    values = np.array(stage.authored(prim, "newton:inertia") or (), dtype=np.float64)
    if not values.size:
        return None
    if values.size != 6 or not np.isfinite(values).all() or values[:3].min() < 0:
        raise stage.error(prim, f"newton:inertia is {values.tolist()}; expected six numbers, the first three 0 or more")
    xx, yy, zz, xy, xz, yz = values * stage.kilograms_per_unit * stage.metres_per_unit**2
    stage.note(prim, "physics:diagonalInertia", "physics:principalAxes")
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _overruled(computed: Inertial, authored: _Authored) -> Inertial:
    centre = computed.centre if authored.centre is None else authored.centre
    return Inertial(computed.mass, centre, computed.about(centre) if authored.tensor is None else authored.tensor)


def _collider(stage: Stage, geom: Gprim, authored: _Authored, body_density: float) -> Inertial:
    """Return what a collider contributes, in the body's frame."""
    density = authored.density or body_density or geom.density or DENSITY
    volume, centre, tensor = _properties(stage, geom)
    mass = authored.mass or volume * density
    computed = Inertial(mass, centre, tensor * (mass / volume if volume else 0.0))
    if authored.centre is None and authored.tensor is None:
        return computed
    place = stage.in_body(stage.frame(geom.prim)[0], geom.body)
    turn, point = place[:3, :3], place[:3, 3]
    return _overruled(
        computed,
        _Authored(
            centre=None if authored.centre is None else turn @ authored.centre + point,
            tensor=None if authored.tensor is None else turn @ authored.tensor @ turn.T,
        ),
    )


def _properties(stage: Stage, geom: Gprim) -> tuple[float, Vector, Tensor]:
    """Return volume [m³], centre of mass [m] and inertia about it at density one, in the body's frame."""
    if not geom.mass_model:
        return geom.shape.mass_properties(geom.is_hull)
    try:
        volume, centre, tensor = geom.shape.mujoco_mass_properties(geom.mass_model)
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise stage.error(geom.prim, f"MuJoCo has no {geom.mass_model} inertia for it: {reason}") from error
    thick = stage.number(geom.prim, "newton:shellThickness", -math.inf) * stage.metres_per_unit
    thick = thick if geom.mass_model == "shell" and thick > 0 else 1.0
    return volume * thick, centre, tensor * thick


def _sum(parts: list[Inertial]) -> Inertial | None:
    if not parts:
        return None
    mass = sum(part.mass for part in parts)
    centre = np.sum([part.mass * part.centre for part in parts], axis=0) / mass
    return Inertial(mass, centre, np.sum([part.about(centre) for part in parts], axis=0))


def _fallback_inertial(stage: Stage, body: Prim, mass: float, geoms: Sequence[Gprim]) -> Inertial:
    """Return the inertia of a body of which only the mass is known: that of its visuals as solids, or of a ball."""
    solids = [geom.shape.mass_properties(False) for geom in geoms if geom.shape.kind != "plane"]
    whole = _sum([Inertial(*solid) for solid in solids if solid[0] > 0])
    if whole is not None:
        stage.drop("bodies have a mass but neither inertia nor colliders; their visuals were taken as solid", body)
        return Inertial(mass, whole.centre, whole.tensor * (mass / whole.mass))
    stage.drop(f"bodies have a mass but neither inertia nor geometry; a ball of {FALLBACK_RADIUS} m radius was taken", body)
    return Inertial(mass, np.zeros(3), 0.4 * mass * FALLBACK_RADIUS**2 * np.eye(3))


def _repaired(stage: Stage, body: Prim, inertial: Inertial) -> Inertial:
    """Replace an inertia that breaks the triangle inequality by a ball's of about the same size; rounding is only corrected."""
    moments, axes = inertial.ascending()
    low, middle, high = np.sort(inertial.principal()[0])
    if low > 0 and low + middle >= high:
        return inertial
    if low > 0 and low + middle >= high * (1 - 1e-6):  # authored in float32: a disc may miss by a digit
        turn = axes.as_matrix()
        return Inertial(inertial.mass, inertial.centre, turn @ np.diag([low, middle, (low + middle) * (1 - 1e-12)]) @ turn.T)
    stage.drop("inertias that no body can have were mended", body)
    return Inertial(inertial.mass, inertial.centre, max(float(moments.mean()), LEAST_INERTIA) * np.eye(3))

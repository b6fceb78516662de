"""Gprims of a USD stage, colliders and visuals: shape, body and physics material."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tgdsl.formats.model import LEAST_INERTIA
from tgdsl.formats.usd.attributes import FRICTION, GEOM, GROUP, MESH, SITE, read_attributes, read_custom, text_of
from tgdsl.formats.usd.joints import rotation_of
from tgdsl.formats.usd.shapes import SCHEMAS, Shape, collision_shape, shape_of
from tgdsl.formats.usd.stage import Matrix, Prim, Stage

MASS_MODELS = ("legacy", "convex", "exact", "shell")  # of a mesh, in MuJoCo; `shell` of any shape
MASKS = ("tgdsl:contype", "tgdsl:conaffinity")
FRICTIONS = ("dynamicFriction", "staticFriction")  # coefficients of a physics material, the one that MuJoCo gets first


@dataclass(frozen=True, eq=False)
class Gprim:
    """A UsdGeom.Gprim as a collider or a visual."""

    path: str  # path of its prim
    prim: Prim  # its prim
    body: str | None  # path of its body; None is the world
    shape: Shape  # what it is, in the body's frame
    is_collider: bool  # whether it collides
    is_visible: bool  # whether it is drawn by default
    color: Float[np.ndarray, " 4"] | None  # red, green, blue, alpha, or None
    mesh: dict[str, str]  # attributes of its MJCF mesh, its name among them
    is_hull: bool = False  # whether a mesh was meant to be its convex hull
    # coefficients of sliding, torsional [m] and rolling [m] friction, each None if its material does not say
    friction: tuple[float | None, float | None, float | None] = (None, None, None)
    density: float = 0.0  # density of its material [kg/m³], or 0
    mass_model: str = ""  # how MuJoCo takes its mass and inertia, or empty: as UsdPhysics does
    mjcf_attributes: dict[str, str] = field(default_factory=dict)  # more attributes of the MJCF geom


@dataclass(frozen=True, eq=False)
class Site:
    """A frame on a body that MJCF calls a site."""

    prim: Prim  # its prim
    body: str | None  # path of its body; None is the world
    pose: Matrix  # its frame in the body's frame [m]
    mjcf_attributes: dict[str, str]  # more attributes of the MJCF site


def read_sites(stage: Stage) -> list[Site]:
    """Read all sites: prims with the custom attribute `site`, and gprims with MjcSiteAPI or NewtonSiteAPI."""
    sites = []
    for prim in stage.prims:
        if not _is_site(stage, prim):
            continue
        body, pose, attributes = stage.owners[str(prim.GetPath())], stage.frame(prim)[0], read_attributes(stage, prim, SITE)
        if prim.GetTypeName() in SCHEMAS:
            shape, color = shape_of(stage, prim, stage.pose(prim)), _color(stage, prim)
            drawn = {} if color is None else {"rgba": text_of(color.tolist())}
            if shape.kind in ("sphere", "capsule", "ellipsoid", "cylinder", "box"):
                pose, drawn = shape.pose, drawn | {"type": shape.kind, "size": text_of(shape.size)}
            attributes = drawn | attributes
        sites.append(Site(prim, body, stage.in_body(pose, body), attributes))
    return sites


def _is_site(stage: Stage, prim: Prim) -> bool:
    return bool(read_custom(stage, prim, "site")) or stage.has(prim, "NewtonSiteAPI")


def read_gprims(stage: Stage) -> list[Gprim]:
    """Read all colliders and all visible shapes."""
    geoms: list[Gprim] = []
    instancer = "//"  # prims below a point instancer are its prototypes, which exist only as instances
    for prim in stage.prims:
        if str(prim.GetPath()).startswith(instancer) or _is_site(stage, prim):
            continue
        is_collider = stage.has(prim, "PhysicsCollisionAPI") and bool(stage.value(prim, "physics:collisionEnabled"))
        is_shape = prim.GetTypeName() in SCHEMAS
        is_visible = _is_visible(stage, prim)
        if not is_shape:
            if is_collider:
                stage.drop("colliders were dropped that are no geometry that MuJoCo has", prim)
            elif is_visible and (prim.IsA(stage.pxr.UsdGeom.Gprim) or prim.IsA(stage.pxr.UsdGeom.PointInstancer)):
                stage.drop("visuals were dropped that are no geometry that MuJoCo has", prim)
            if prim.IsA(stage.pxr.UsdGeom.PointInstancer):
                instancer = f"{prim.GetPath()}/"
        elif is_collider or is_visible or stage.has(prim, "MjcImageableAPI"):
            geoms += _geoms(stage, prim, is_collider, is_visible)
    return geoms


def _geoms(stage: Stage, prim: Prim, is_collider: bool, is_visible: bool) -> list[Gprim]:
    pose, path = stage.pose(prim), str(prim.GetPath())
    body = stage.owners[path]
    if abs(np.linalg.det(pose[:3, :3])) == 0:
        raise stage.error(prim, "its transform is flat: a scale is zero")
    place = stage.in_body(pose, body)
    shape = shape_of(stage, prim, place)
    color = _color(stage, prim)
    mesh = read_attributes(stage, prim, MESH) if shape.kind == "mesh" else {}
    model = _mass_model(stage, prim)
    mesh |= {"name": name} if (name := read_custom(stage, prim, "mesh")) else {}
    visual = Gprim(path, prim, body, shape, False, is_visible, color, mesh)
    if not is_collider:
        if shape.vertices is not None and len(shape.vertices) < 4:
            stage.drop("visual meshes with less than four points were dropped", prim)
            return []
        stage.note(prim, *MASKS)  # of a visual, zero
        return [replace(visual, mjcf_attributes=read_attributes(stage, prim, GROUP))]
    attributes = read_attributes(stage, prim, GEOM)
    friction, density = _material(stage, prim, "solref" in attributes)
    is_mesh = prim.GetTypeName() == "Mesh"
    collided, is_hull = collision_shape(stage, prim, shape, place) if is_mesh else (shape, True)
    collider = replace(
        visual,
        shape=collided,
        is_collider=True,
        is_visible=is_visible and collided is shape,
        is_hull=is_hull,
        friction=friction,
        density=density,
        mass_model=model if collided is shape else "",
        mjcf_attributes=attributes,
    )
    return [collider, visual] if is_visible and collided is not shape else [collider]


def _mass_model(stage: Stage, prim: Prim) -> str:
    """Return how MuJoCo takes a geom's mass and inertia, or nothing if only UsdPhysics says so."""
    is_shell = stage.authored(prim, "newton:massModel") == "shell" or stage.authored(prim, "mjc:shellinertia")
    model = "shell" if is_shell else str(stage.authored(prim, "mjc:inertia") or "")
    if model and model not in MASS_MODELS:
        raise stage.error(prim, f"mjc:inertia is {model!r}; expected one of {', '.join(MASS_MODELS)}")
    return model


def _is_visible(stage: Stage, prim: Prim) -> bool:
    geometry = stage.pxr.UsdGeom
    if not prim.IsA(geometry.Imageable):
        return False
    imageable = geometry.Imageable(prim)
    is_drawn = imageable.ComputePurpose() in (geometry.Tokens.default_, geometry.Tokens.render)
    return is_drawn and imageable.ComputeVisibility() != geometry.Tokens.invisible


def _material(stage: Stage, prim: Prim, is_solref: bool) -> tuple[tuple[float | None, float | None, float | None], float]:
    """Return frictions and density [kg/m³] of the material that is bound for physics, or else for all purposes."""
    stage.note(prim, "material:binding", "material:binding:physics")
    material = stage.pxr.UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0].GetPrim()
    if not material or not stage.has(material, "PhysicsMaterialAPI"):
        return (None, None, None), 0.0
    if stage.number(material, "physics:restitution") > 0:
        stage.drop("restitution of materials was dropped: MuJoCo has none", material)
    authored = [stage.authored(material, f"physics:{name}") for name in FRICTIONS]
    sliding = next((float(value) for value in authored if value is not None), None)
    if is_solref:
        stage.note(material, "newton:contactStiffness", "newton:contactDamping")
    more = read_attributes(stage, material, FRICTION)
    torsional, rolling = (float(more[name]) if name in more else None for name in FRICTION)
    density = stage.number(material, "physics:density") * stage.kilograms_per_unit / stage.metres_per_unit**3
    return (sliding, torsional, rolling), density


def _color(stage: Stage, prim: Prim) -> Float[np.ndarray, " 4"] | None:
    """Return the display colour; of several, the first."""
    colors = stage.authored(prim, "primvars:displayColor")
    if not colors:
        return None
    opacity = stage.authored(prim, "primvars:displayOpacity")
    return np.array([*colors[0], opacity[0] if opacity else 1.0], dtype=np.float64)


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
    axes: tuple[Vector, Rotation] | None = None  # principal moments [kg·m²] and their axes, in the given order

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
    """Return a mass and inertia with zeros as `export` wrote them: mass, moments and axes (w x y z)."""
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
    # A shell without a thickness has its density in kg/m², as in MuJoCo.
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
    """Return the inertia of a body with only a known mass: of its visuals as solids, or of a ball."""
    solids = [geom.shape.mass_properties(False) for geom in geoms if geom.shape.kind != "plane"]
    whole = _sum([Inertial(*solid) for solid in solids if solid[0] > 0])
    if whole is not None:
        stage.drop("bodies have a mass but neither inertia nor colliders; their visuals count as solid", body)
        return Inertial(mass, whole.centre, whole.tensor * (mass / whole.mass))
    stage.drop(f"bodies have a mass but neither inertia nor geometry; they count as a ball of {FALLBACK_RADIUS} m radius", body)
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

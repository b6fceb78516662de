"""Gprims of a USD stage, colliders and visuals: shape, body and physics material."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from tgdsl.formats.usd.attributes import FRICTION, GEOM, GROUP, MESH, SITE, read_attributes, read_custom, text_of
from tgdsl.formats.usd.shapes import SCHEMAS, Shape, collision_shape, shape_of
from tgdsl.formats.usd.stage import Matrix, Prim, Stage

MASS_MODELS = ("legacy", "convex", "exact", "shell")
"""Ways in which MuJoCo takes the mass of a mesh; `shell` is there for all shapes."""
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
            pose, drawn = _drawn_site(stage, prim, pose)
            attributes = drawn | attributes
        sites.append(Site(prim, body, stage.in_body(pose, body), attributes))
    return sites


def _is_site(stage: Stage, prim: Prim) -> bool:
    return bool(read_custom(stage, prim, "site")) or stage.has(prim, "NewtonSiteAPI")


def _drawn_site(stage: Stage, prim: Prim, pose: Matrix) -> tuple[Matrix, dict[str, str]]:
    """Return the frame [m] of a site that is a gprim, and how it is drawn."""
    shape, color = shape_of(stage, prim, stage.pose(prim)), _color(stage, prim)
    result = {} if color is None else {"rgba": text_of(color.tolist())}
    if shape.kind in ("sphere", "capsule", "ellipsoid", "cylinder", "box"):
        return shape.pose, result | {"type": shape.kind, "size": text_of(shape.size)}
    return pose, result


def read_gprims(stage: Stage) -> list[Gprim]:
    """Read all colliders and all that is visible."""
    geoms: list[Gprim] = []
    instancer = "//"  # what is below a point instancer is only there as its instances
    for prim in stage.prims:
        if str(prim.GetPath()).startswith(instancer):
            continue
        if _is_site(stage, prim):
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

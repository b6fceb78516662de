"""MuJoCo's geoms as USD's shapes, with colours, colliders and the friction of their surfaces."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tgdsl.errors import RobotError
from tgdsl.formats.model import SHAPE_NAMES
from tgdsl.formats.usd.attributes import GEOM, MESH, SITE, Table, default_model, set_custom, set_customs, set_number
from tgdsl.formats.usd.export.stage_writer import StageWriter, set_pose
from tgdsl.formats.usd.stage import usd_modules

MESH_GEOM = int(mujoco.mjtGeom.mjGEOM_MESH)
MASKS = {name: GEOM[name] for name in ("contype", "conaffinity")}  # custom attributes of visuals too
AS_SHELL = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # how the importer takes meshes without the custom attribute `inertia`
PLAIN_RGBA = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's default colour of a geom: if a material is there too, the material's shows


def add_geoms(writer: StageWriter, body: int) -> None:
    """Write the geoms of a body below its prim."""
    model = writer.model
    first = int(model.body_geomadr[body])
    for geom in range(first, first + int(model.body_geomnum[body])):
        shape, scale = _define(writer, geom)
        prim = shape.GetPrim()
        writer.geoms[geom] = str(prim.GetPath())
        set_pose(prim, *_pose(writer, geom), scale)
        set_custom(prim, "name", model.geom(geom).name)
        _colour(writer, geom, shape)
        is_colliding = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
        _set_customs(writer, prim, GEOM if is_colliding else MASKS, geom)
        if is_colliding:
            _add_collider(writer, geom, prim)


def _set_customs(writer: StageWriter, prim: Any, table: Table, index: int) -> None:
    default = default_model()
    set_customs(prim, table, lambda name: getattr(writer.model, name)[index], lambda name: getattr(default, name)[0])


def _pose(writer: StageWriter, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a geom's pose in its body's frame; of a mesh, that of the frame which its file is in."""
    model, mesh = writer.model, int(writer.model.geom_dataid[geom])
    pos, quat = model.geom_pos[geom], model.geom_quat[geom]
    if model.geom_type[geom] != MESH_GEOM:
        return pos, quat
    turn = Rotation.from_quat(quat, scalar_first=True) * Rotation.from_quat(model.mesh_quat[mesh], scalar_first=True).inv()
    quat = turn.as_quat(canonical=True, scalar_first=True)
    return pos - turn.apply(model.mesh_pos[mesh]), quat


def _define(writer: StageWriter, geom: int) -> tuple[Any, np.ndarray | None]:
    """Define a geom's prim without its pose; return its schema, and the scale that it wants."""
    model, shapes = writer.model, usd_modules().UsdGeom
    kind, size = SHAPE_NAMES.get(int(model.geom_type[geom]), "unknown"), model.geom_size[geom]
    name = model.geom(geom).name
    mesh = model.mesh(model.geom_dataid[geom]).name if kind == "mesh" else ""
    schemas = {"box": "Cube", "sphere": "Sphere", "ellipsoid": "Sphere", "capsule": "Capsule", "cylinder": "Cylinder"}
    schema = (schemas | {"plane": "Plane", "mesh": "Mesh"}).get(kind)
    body = int(model.geom_bodyid[geom])
    if schema is None:
        shown = f'geom "{name}"' if name else f"unnamed {kind} geom {geom}"
        raise RobotError(f"{writer.file}: {shown} of body {writer.body_name(body)} is of type {kind}, which USD does not have")
    shape = getattr(shapes, schema).Define(writer.stage, writer.path(writer.bodies[body], name or mesh or kind))
    scale = size if kind in ("box", "ellipsoid") else None
    if kind == "box":
        shape.CreateSizeAttr(2.0)
    elif kind == "ellipsoid":
        shape.CreateRadiusAttr(1.0)
    elif kind == "mesh":
        _add_triangles(writer, geom, shape)
    elif kind == "plane":
        shape.CreateAxisAttr("Z")
        for create, half in ((shape.CreateWidthAttr, size[0]), (shape.CreateLengthAttr, size[1])):
            if half > 0:  # MuJoCo draws a half size of 0 without end, and collides every plane so, as UsdPhysics does
                create(2.0 * float(half))
    else:
        shape.CreateRadiusAttr(float(size[0]))
    if kind in ("capsule", "cylinder"):
        shape.CreateAxisAttr("Z")
        shape.CreateHeightAttr(2.0 * float(size[1]))
    shape.CreateExtentAttr(shapes.Boundable.ComputeExtentFromPlugins(shape, usd_modules().Usd.TimeCode.Default()))
    return shape, scale


def _add_triangles(writer: StageWriter, geom: int, shape: Any) -> None:
    """Write a mesh's triangles as its file has them, and what MuJoCo makes of them."""
    model, mesh, u = writer.model, int(writer.model.geom_dataid[geom]), usd_modules()
    shape.CreatePointsAttr(u.Vt.Vec3fArray.FromNumpy(file_vertices(model, mesh)))
    first, count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    shape.CreateFaceVertexIndicesAttr(u.Vt.IntArray.FromNumpy(model.mesh_face[first : first + count].astype(np.int32).ravel()))
    shape.CreateFaceVertexCountsAttr(u.Vt.IntArray.FromNumpy(np.full(count, 3, dtype=np.int32)))
    shape.CreateSubdivisionSchemeAttr("none")
    set_custom(shape.GetPrim(), "mesh", model.mesh(mesh).name)
    asset, default = writer.spec.mesh(model.mesh(mesh).name), mujoco.MjSpec().add_mesh(inertia=AS_SHELL)
    set_customs(shape.GetPrim(), MESH, lambda name: getattr(asset, name), lambda name: getattr(default, name))


def file_vertices(model: mujoco.MjModel, mesh: int) -> Float[np.ndarray, "vertex 3"]:
    """Return a mesh's vertices in the frame of its file [m], in float32 and in MuJoCo's order."""
    first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    moved = model.mesh_vert[first : first + count].astype(np.float64)
    result = Rotation.from_quat(model.mesh_quat[mesh], scalar_first=True).apply(moved) + model.mesh_pos[mesh]
    bit = np.finfo(np.float32).eps * max(np.abs(result).max(), np.abs(moved).max())
    for decimals in range(8):
        if np.abs(np.round(result, decimals) - result).max() <= bit:
            result = np.round(result, decimals)
            break
    return np.ascontiguousarray(result + 0.0, dtype=np.float32)


def _colour(writer: StageWriter, geom: int, shape: Any) -> None:
    model = writer.model
    rgba, material = model.geom_rgba[geom], int(model.geom_matid[geom])
    if material >= 0 and np.array_equal(rgba, np.array(PLAIN_RGBA, dtype=rgba.dtype)):
        rgba = model.mat_rgba[material]
    *colour, opacity = rgba.tolist()
    shape.CreateDisplayColorAttr([usd_modules().Gf.Vec3f(*colour)])
    if opacity != 1.0:
        shape.CreateDisplayOpacityAttr([opacity])


def _add_collider(writer: StageWriter, geom: int, prim: Any) -> None:
    u = usd_modules()
    u.UsdPhysics.CollisionAPI.Apply(prim)
    if prim.IsA(u.UsdGeom.Mesh):
        u.UsdPhysics.MeshCollisionAPI.Apply(prim).CreateApproximationAttr("convexHull")  # as MuJoCo collides it
    friction = float(writer.model.geom_friction[geom, 0])
    u.UsdShade.MaterialBindingAPI.Apply(prim).Bind(_material(writer, friction), materialPurpose="physics")


def _material(writer: StageWriter, friction: float) -> Any:
    """Return the physics material of a sliding friction; geoms of the same friction share it."""
    u = usd_modules()
    if friction not in writer.frictions:
        material = u.UsdShade.Material.Define(writer.stage, writer.path(writer.materials, f"friction_{friction!r}"))
        surface = u.UsdPhysics.MaterialAPI.Apply(material.GetPrim())
        set_number(surface.CreateStaticFrictionAttr(), friction)
        set_number(surface.CreateDynamicFrictionAttr(), friction)
        writer.frictions[friction] = material
    return writer.frictions[friction]


def add_sites(writer: StageWriter, body: int) -> None:
    """Write the sites of a body below its prim, as frames."""
    model = writer.model
    for site in np.flatnonzero(model.site_bodyid == body).tolist():
        name = model.site(site).name
        prim = usd_modules().UsdGeom.Xform.Define(writer.stage, writer.path(writer.bodies[body], name or "site")).GetPrim()
        writer.sites[site] = str(prim.GetPath())
        set_pose(prim, model.site_pos[site], model.site_quat[site])
        set_custom(prim, "site", True)
        set_custom(prim, "name", name)
        _set_customs(writer, prim, SITE, site)

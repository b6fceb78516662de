"""Robots out: a compiled MJCF or URDF model as a UsdPhysics stage, in SI units but where USD wants degrees.

Bodies are siblings below the default prim, at their world poses. Custom attributes named `tgdsl:`, in SI units and radians,
hold values without a USD schema, for tgdsl to read back:

- the names of MuJoCo (`name`, `actuator`, `mesh`; a floating body's joint in `freejoint`), a geom's `group`, and which frame
  is a `site`;
- a joint's own `damping`, which its drive's includes; its actuator's `ctrlrange`; the `gear`, which drive and range include;
  a joint's `actuatorfrcrange` and its actuator's `forcerange` (the drive has the smaller);
  the actuator's place in the `order`, if actuators do not come in the joints' order or are not all drives;
- a joint's spring, a ball joint's range, a body's `gravcomp`, and its `inertial` if its mass or some moment is zero;
- contact parameters and the solver's settings, and the exact values of what USD rounds to float32: see `attributes.py`.

Actuators that USD has no drive for, tendons and keyframes are prims of MuJoCo's schemas (MjcActuator, MjcTendon, MjcKeyframe);
equality constraints are joints and couplings, as far as there are schemas for them: see `equalities.py`.
Textures stay behind.
"""

from __future__ import annotations

import warnings
from itertools import combinations
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from tgdsl.errors import FileError, RobotError, listed
from tgdsl.files.write import atomic_path
from tgdsl.formats.model import SHAPE_NAMES, Model
from tgdsl.formats.usd import attributes as attr
from tgdsl.formats.usd.actuators import write_actuators, write_keyframes, write_tendons
from tgdsl.formats.usd.equalities import write_equalities
from tgdsl.formats.usd.stage import usd_modules
from tgdsl.formats.usd.write_joints import add_drives, add_joint

ELLIPSOID, PLANE, MESH_GEOM = (int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")) for kind in ("ELLIPSOID", "PLANE", "MESH"))
MASKS = {name: attr.GEOM[name] for name in ("contype", "conaffinity")}  # custom attributes of visuals too
PLAIN_RGBA = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's default colour of a geom: if a material is there too, the material's shows
SCHEMAS = {
    "box": "Cube",
    "sphere": "Sphere",
    "ellipsoid": "Sphere",
    "capsule": "Capsule",
    "cylinder": "Cylinder",
    "plane": "Plane",
    "mesh": "Mesh",
}


def write_usd(model: Model, out: Path) -> None:
    """Write a robot or scene as a UsdPhysics stage; the same input gives the same bytes.

    Warns of each thing of the model that USD does not hold, after the file is written.

    Raises:
        RobotError: If USD cannot express the model, or the file cannot be written.
    """
    writer = attr.StageWriter(model.file, model.spec, model.compiled, usd_modules().Usd.Stage.CreateInMemory())
    _add_scene(writer)
    writer.scope, writer.materials = (writer.path(writer.root, name) for name in ("joints", "materials"))
    _add_bodies(writer)
    _add_joints(writer)
    _add_filters(writer)
    try:
        with atomic_path(out) as temporary:
            if not writer.stage.GetRootLayer().Export(str(temporary)):
                raise OSError(0, "USD did not say why")
    except FileError as error:
        raise RobotError(f"{out}: cannot be written: {error.reason}") from error
    for message in (*writer.unsupported, *_unsupported_elements(writer)):
        warnings.warn(message, stacklevel=3)


def _add_scene(writer: attr.StageWriter) -> None:
    """Write units, gravity and the default prim."""
    u, model, stage = usd_modules(), writer.model, writer.stage
    u.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    u.UsdGeom.SetStageUpAxis(stage, u.UsdGeom.Tokens.z)
    u.UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    name = model.names[: model.names.index(b"\0")].decode()
    writer.root = writer.path("", name)
    root = u.UsdGeom.Xform.Define(stage, writer.root).GetPrim()
    attr.set_custom(root, "name", name)
    stage.SetDefaultPrim(root)
    if np.any(model.jnt_type != attr.FREE):
        u.UsdPhysics.ArticulationRootAPI.Apply(root)
    is_weightless = bool(model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    gravity = np.zeros(3) if is_weightless else model.opt.gravity
    strength = float(np.linalg.norm(gravity))
    scene = u.UsdPhysics.Scene.Define(stage, writer.path("", "physicsScene"))
    attr.set_number(scene.CreateGravityMagnitudeAttr(), strength)
    attr.set_number(scene.CreateGravityDirectionAttr(), gravity / (strength or 1.0))
    # A scene of a stage that this one is layered into may have a schema with another default.
    attr.set_custom(scene.GetPrim(), "timestep", float(model.opt.timestep))
    attr.set_customs(scene.GetPrim(), attr.OPTION, model.opt, attr.default_model().opt)
    for key in attr.FLAGS:
        bits = int(getattr(model.opt, f"{key}flags"))
        if names := [name for name, bit in attr.flag_names(key).items() if bits & bit and name not in attr.KNOWN_FLAGS]:
            attr.set_custom(scene.GetPrim(), key, names)


def _add_bodies(writer: attr.StageWriter) -> None:
    """Write every body at its world pose at `qpos0`, with its mass, geoms and sites."""
    u, model = usd_modules(), writer.model
    state = mujoco.MjData(model)
    mujoco.mj_kinematics(model, state)
    if np.any(model.geom_contype | model.geom_conaffinity):
        u.UsdGeom.Scope.Define(writer.stage, writer.materials)
    for body in range(model.nbody):
        path = writer.path(writer.root, writer.body_name(body))
        if body == 0 and not model.body_geomnum[0] and not np.any(model.site_bodyid == 0):
            continue
        writer.bodies[body] = path
        prim = u.UsdGeom.Xform.Define(writer.stage, path).GetPrim()
        if body:
            attr.set_custom(prim, "name", model.body(body).name)
            if model.body_gravcomp[body]:
                attr.set_custom(prim, "gravcomp", float(model.body_gravcomp[body]))
            _set_pose(prim, state.xpos[body], state.xquat[body])
            _add_mass(writer, body, prim)
        for geom in np.flatnonzero(model.geom_bodyid == body).tolist():
            _add_geom(writer, geom)
        for site in np.flatnonzero(model.site_bodyid == body).tolist():
            name = model.site(site).name
            prim = u.UsdGeom.Xform.Define(writer.stage, writer.path(path, name or "site")).GetPrim()
            writer.sites[site] = str(prim.GetPath())
            _set_pose(prim, model.site_pos[site], model.site_quat[site])
            attr.set_custom(prim, "site", True)
            attr.set_custom(prim, "name", name)
            attr.set_customs(prim, attr.SITE, model, attr.default_model(), site)


def _set_pose(prim: Any, pos: np.ndarray, quat: np.ndarray, scale: np.ndarray | None = None) -> None:
    """Give a prim its position [m], rotation (w x y z) and scale in its parent's frame, in double precision."""
    u = usd_modules()
    xform, double = u.UsdGeom.Xformable(prim), u.UsdGeom.XformOp.PrecisionDouble
    xform.AddTranslateOp(double).Set(u.Gf.Vec3d(*attr.rounded(pos).tolist()))
    xform.AddOrientOp(double).Set(u.Gf.Quatd(*attr.rounded(quat).tolist()))
    if scale is not None:
        xform.AddScaleOp(double).Set(u.Gf.Vec3d(*scale.tolist()))


def _add_mass(writer: attr.StageWriter, body: int, prim: Any) -> None:
    u, model = usd_modules(), writer.model
    rigid = u.UsdPhysics.RigidBodyAPI.Apply(prim)
    if model.body_mocapid[body] >= 0:
        rigid.CreateKinematicEnabledAttr(True)
    mass = u.UsdPhysics.MassAPI.Apply(prim)
    attr.set_number(mass.CreateMassAttr(), model.body_mass[body])
    attr.set_number(mass.CreateCenterOfMassAttr(), model.body_ipos[body])
    if not model.body_inertia[body].all():
        # Of a body that has none, USD wants neither the moments nor their axes, and makes both, or its mass, of its colliders.
        values = [model.body_mass[body], *model.body_inertia[body], *model.body_iquat[body]]
        attr.set_custom(prim, "inertial", [float(value) for value in values])
        return
    attr.set_number(mass.CreateDiagonalInertiaAttr(), model.body_inertia[body])
    attr.set_number(mass.CreatePrincipalAxesAttr(), model.body_iquat[body])


def _add_geom(writer: attr.StageWriter, geom: int) -> None:
    model, u = writer.model, usd_modules()
    shape, scale = _define(writer, geom)
    prim = shape.GetPrim()
    writer.geoms[geom] = str(prim.GetPath())
    pos, quat = model.geom_pos[geom], model.geom_quat[geom]
    if model.geom_type[geom] == MESH_GEOM:  # the frame that its file is in
        mesh = int(model.geom_dataid[geom])
        turn = Rotation.from_quat(quat, scalar_first=True) * Rotation.from_quat(model.mesh_quat[mesh], scalar_first=True).inv()
        pos, quat = pos - turn.apply(model.mesh_pos[mesh]), turn.as_quat(canonical=True, scalar_first=True)
    _set_pose(prim, pos, quat, scale)
    attr.set_custom(prim, "name", model.geom(geom).name)
    attr.set_custom(prim, "group", int(model.geom_group[geom]))
    rgba, material = model.geom_rgba[geom], int(model.geom_matid[geom])
    if material >= 0 and np.array_equal(rgba, np.array(PLAIN_RGBA, dtype=rgba.dtype)):
        rgba = model.mat_rgba[material]
    *colour, opacity = rgba.tolist()
    shape.CreateDisplayColorAttr([u.Gf.Vec3f(*colour)])
    if opacity != 1.0:
        shape.CreateDisplayOpacityAttr([opacity])
    is_colliding = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
    attr.set_customs(prim, attr.GEOM if is_colliding else MASKS, model, attr.default_model(), geom)
    if is_colliding:
        u.UsdPhysics.CollisionAPI.Apply(prim)
        if prim.IsA(u.UsdGeom.Mesh):
            u.UsdPhysics.MeshCollisionAPI.Apply(prim).CreateApproximationAttr("convexHull")  # as MuJoCo collides it
        surface = _material(writer, float(model.geom_friction[geom, 0]))
        u.UsdShade.MaterialBindingAPI.Apply(prim).Bind(surface, materialPurpose="physics")


def _define(writer: attr.StageWriter, geom: int) -> tuple[Any, np.ndarray | None]:
    """Define a geom's prim without its pose; return its schema, and the scale that it wants."""
    model, shapes = writer.model, usd_modules().UsdGeom
    kind, size = SHAPE_NAMES.get(int(model.geom_type[geom]), "unknown"), model.geom_size[geom]
    name, body = model.geom(geom).name, int(model.geom_bodyid[geom])
    mesh = model.mesh(model.geom_dataid[geom]).name if kind == "mesh" else ""
    if kind not in SCHEMAS:
        label = f'geom "{name}"' if name else f"unnamed {kind} geom {geom}"
        raise RobotError(f"{writer.file}: {label} of body {writer.body_name(body)} is of type {kind}, which USD does not have")
    shape = getattr(shapes, SCHEMAS[kind]).Define(writer.stage, writer.path(writer.bodies[body], name or mesh or kind))
    if kind == "box":
        shape.CreateSizeAttr(2.0)
    elif kind == "mesh":
        _add_triangles(writer, geom, shape)
    elif kind == "plane":
        shape.CreateAxisAttr("Z")
        for create, half in ((shape.CreateWidthAttr, size[0]), (shape.CreateLengthAttr, size[1])):
            if half > 0:  # MuJoCo draws a half size of 0 without end, and collides every plane so, as UsdPhysics does
                create(2.0 * float(half))
    else:
        shape.CreateRadiusAttr(1.0 if kind == "ellipsoid" else float(size[0]))
    if kind in ("capsule", "cylinder"):
        shape.CreateAxisAttr("Z")
        shape.CreateHeightAttr(2.0 * float(size[1]))
    shape.CreateExtentAttr(shapes.Boundable.ComputeExtentFromPlugins(shape, usd_modules().Usd.TimeCode.Default()))
    return shape, size if kind in ("box", "ellipsoid") else None


def _add_triangles(writer: attr.StageWriter, geom: int, shape: Any) -> None:
    """Write a mesh's triangles as its file has them, and what MuJoCo makes of them."""
    model, mesh, u = writer.model, int(writer.model.geom_dataid[geom]), usd_modules()
    shape.CreatePointsAttr(u.Vt.Vec3fArray.FromNumpy(attr.file_vertices(model, mesh)))
    first, count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    shape.CreateFaceVertexIndicesAttr(u.Vt.IntArray.FromNumpy(model.mesh_face[first : first + count].astype(np.int32).ravel()))
    shape.CreateFaceVertexCountsAttr(u.Vt.IntArray.FromNumpy(np.full(count, 3, dtype=np.int32)))
    shape.CreateSubdivisionSchemeAttr("none")
    name = model.mesh(mesh).name
    attr.set_custom(shape.GetPrim(), "mesh", name)
    default = mujoco.MjSpec().add_mesh(inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)  # as the importer takes meshes
    attr.set_customs(shape.GetPrim(), attr.MESH, writer.spec.mesh(name), default)


def _material(writer: attr.StageWriter, friction: float) -> Any:
    """Return the physics material of a sliding friction; geoms of the same friction share it."""
    u = usd_modules()
    if friction not in writer.frictions:
        material = u.UsdShade.Material.Define(writer.stage, writer.path(writer.materials, f"friction_{friction!r}"))
        surface = u.UsdPhysics.MaterialAPI.Apply(material.GetPrim())
        attr.set_number(surface.CreateStaticFrictionAttr(), friction)
        attr.set_number(surface.CreateDynamicFrictionAttr(), friction)
        writer.frictions[friction] = material
    return writer.frictions[friction]


def _add_joints(writer: attr.StageWriter) -> None:
    model = writer.model
    excluded = _excluded(model)
    usd_modules().UsdGeom.Scope.Define(writer.stage, writer.scope)
    for body in range(1, model.nbody):
        parent = int(model.body_parentid[body])
        add_joint(writer, body, parent > 0 and (parent, body) not in excluded and not _never_collide(model, parent, body))
    write_keyframes(writer)
    write_tendons(writer)
    write_equalities(writer)
    write_actuators(writer, add_drives(writer))


def _excluded(model: mujoco.MjModel) -> set[tuple[int, int]]:
    return {(signature >> 16, signature & 0xFFFF) for signature in model.exclude_signature.tolist()}


def _never_collide(model: mujoco.MjModel, one: int, two: int) -> bool:
    """Return whether MuJoCo never collides two bodies: welded into one, or parent and child, neither fixed to the world."""
    one, two = int(model.body_weldid[one]), int(model.body_weldid[two])
    if one == two or not one or not two or model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
        return one == two
    return any(int(model.body_weldid[model.body_parentid[child]]) == parent for child, parent in ((one, two), (two, one)))


def _add_filters(writer: attr.StageWriter) -> None:
    """Write the pairs of bodies that do not collide and that USD would not know of.

    MuJoCo's own filter sees bodies that are welded together as one, USD's joints only the two that they join.
    """
    model, u, stage = writer.model, usd_modules(), writer.stage
    pairs = _excluded(model)
    colliding = sorted({int(body) for body in model.geom_bodyid[(model.geom_contype | model.geom_conaffinity) != 0]} - {0})
    pairs |= {(a, b) for a, b in combinations(colliding, 2) if model.body_parentid[b] != a and _never_collide(model, a, b)}
    targets: dict[int, list[str]] = {}
    for one, two in sorted(pairs):
        if one:
            targets.setdefault(one, []).append(writer.bodies[two])
        elif one in writer.bodies:  # the world is no rigid body: each of its colliders is named
            children = stage.GetPrimAtPath(writer.bodies[one]).GetChildren()
            if walls := [str(child.GetPath()) for child in children if child.HasAPI(u.UsdPhysics.CollisionAPI)]:
                targets.setdefault(two, []).extend(walls)
    for body, paths in sorted(targets.items()):
        filtered = u.UsdPhysics.FilteredPairsAPI.Apply(stage.GetPrimAtPath(writer.bodies[body]))
        filtered.CreateFilteredPairsRel().SetTargets(paths)


def _unsupported_elements(writer: attr.StageWriter) -> list[str]:
    """Return one message for each kind of thing that the model has and USD does not."""
    model = writer.model
    polynomials = (model.jnt_stiffnesspoly, model.dof_dampingpoly, model.tendon_stiffnesspoly, model.tendon_dampingpoly)
    counts = {
        "contact pairs": model.npair,
        "sensors": model.nsensor,
        "cameras": model.ncam,
        "lights": model.nlight,
        "flexes": model.nflex,
        "skins": model.nskin,
        "polynomial springs and dampers": sum(map(np.count_nonzero, polynomials)),
    }
    messages = [f"{writer.file}: USD holds no {kind}: {count} left out" for kind, count in counts.items() if count]
    colliding = (model.geom_contype | model.geom_conaffinity) != 0
    unfit = {
        "no ellipsoids, and leaves out or rounds": (model.geom_type == ELLIPSOID) & colliding,
        "no planes on bodies, and leaves out": (model.geom_type == PLANE) & colliding & (model.geom_bodyid > 0),
    }
    for lack, geoms in unfit.items():
        names = [model.geom(geom).name or f"unnamed geom {geom}" for geom in np.flatnonzero(geoms).tolist()]
        messages += [f"{writer.file}: USD's physics has {lack}: {listed(names)}"] if names else []
    light = [body for body in range(1, model.nbody) if not model.body_mass[body] and model.body_weldid[body]]
    if light:
        names = listed([writer.body_name(body) for body in light])
        messages.append(f"{writer.file}: USD takes a mass of 0 for one that is not given: {names}")
    return messages

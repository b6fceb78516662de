"""Robots out: a compiled MJCF or URDF model as a UsdPhysics stage, in SI units but where USD wants degrees.

Bodies are siblings below the default prim, at their world poses. What USD has no schema for and tgdsl reads back is kept in
custom attributes named `tgdsl:`, in SI units and radians:

- the names of MuJoCo (`name`, `actuator`, `mesh`; a floating body's joint in `freejoint`), and which frame is a `site`;
- a joint's own `damping`, which its drive's includes; its actuator's `ctrlrange`; the `gear`, which drive and range include;
  a joint's `actuatorfrcrange` and its actuator's `forcerange`, of which the drive has the smaller;
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

from tgdsl.errors import FileError, RobotError, listed
from tgdsl.files.write import atomic_path
from tgdsl.formats.model import Model
from tgdsl.formats.usd.actuators import write_actuators, write_keyframes, write_tendons
from tgdsl.formats.usd.attributes import (
    FLAGS,
    KNOWN_FLAGS,
    OPTION,
    default_model,
    flag_names,
    set_custom,
    set_customs,
    set_number,
)
from tgdsl.formats.usd.equalities import write_equalities
from tgdsl.formats.usd.export.geoms import add_geoms, add_sites
from tgdsl.formats.usd.export.joints import add_drives, add_joint
from tgdsl.formats.usd.export.stage_writer import FREE, StageWriter, set_pose
from tgdsl.formats.usd.stage import usd_modules

ELLIPSOID, PLANE = int(mujoco.mjtGeom.mjGEOM_ELLIPSOID), int(mujoco.mjtGeom.mjGEOM_PLANE)


def write_usd(model: Model, out: Path) -> None:
    """Write a robot or scene as a UsdPhysics stage; the same input gives the same bytes.

    Warns of each thing of the model that USD does not hold, after the file is written.

    Args:
        model: The robot or scene.
        out: The stage to write: `.usda` is text, `.usdc` and `.usd` are binary.

    Raises:
        RobotError: If USD cannot express the model, or the file cannot be written.
    """
    writer = StageWriter(model.file, model.spec, model.compiled, usd_modules().Usd.Stage.CreateInMemory())
    _add_scene(writer)
    writer.scope, writer.materials = (writer.path(writer.root, name) for name in ("joints", "materials"))
    _add_bodies(writer)
    _add_joints(writer)
    _add_filters(writer)
    _write(writer, out)
    for message in (*writer.unsupported, *_unsupported_elements(writer)):
        warnings.warn(message, stacklevel=3)


def _add_scene(writer: StageWriter) -> None:
    """Write units, gravity and the default prim."""
    u, model, stage = usd_modules(), writer.model, writer.stage
    u.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    u.UsdGeom.SetStageUpAxis(stage, u.UsdGeom.Tokens.z)
    u.UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    name = model.names[: model.names.index(b"\0")].decode()
    writer.root = writer.path("", name)
    root = u.UsdGeom.Xform.Define(stage, writer.root).GetPrim()
    set_custom(root, "name", name)
    stage.SetDefaultPrim(root)
    if np.any(model.jnt_type != FREE):
        u.UsdPhysics.ArticulationRootAPI.Apply(root)
    is_weightless = bool(model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    gravity = np.zeros(3) if is_weightless else model.opt.gravity
    strength = float(np.linalg.norm(gravity))
    scene = u.UsdPhysics.Scene.Define(stage, writer.path("", "physicsScene"))
    set_number(scene.CreateGravityMagnitudeAttr(), strength)
    set_number(scene.CreateGravityDirectionAttr(), gravity / (strength or 1.0))
    # A scene of a stage that this one is layered into may have a schema with another default.
    set_custom(scene.GetPrim(), "timestep", float(model.opt.timestep))
    default = default_model().opt
    set_customs(scene.GetPrim(), OPTION, lambda name: getattr(model.opt, name), lambda name: getattr(default, name))
    for key in FLAGS:
        bits = int(getattr(model.opt, f"{key}flags"))
        if names := [name for name, bit in flag_names(key).items() if bits & bit and name not in KNOWN_FLAGS]:
            set_custom(scene.GetPrim(), key, names)


def _add_bodies(writer: StageWriter) -> None:
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
            set_custom(prim, "name", model.body(body).name)
            if model.body_gravcomp[body]:
                set_custom(prim, "gravcomp", float(model.body_gravcomp[body]))
            set_pose(prim, state.xpos[body], state.xquat[body])
            _add_mass(writer, body, prim)
        add_geoms(writer, body)
        add_sites(writer, body)


def _add_mass(writer: StageWriter, body: int, prim: Any) -> None:
    u, model = usd_modules(), writer.model
    rigid = u.UsdPhysics.RigidBodyAPI.Apply(prim)
    if model.body_mocapid[body] >= 0:
        rigid.CreateKinematicEnabledAttr(True)
    mass = u.UsdPhysics.MassAPI.Apply(prim)
    set_number(mass.CreateMassAttr(), model.body_mass[body])
    set_number(mass.CreateCenterOfMassAttr(), model.body_ipos[body])
    if not model.body_inertia[body].all():
        # Of a body that has none, USD wants neither the moments nor their axes, and makes both, or its mass, of its colliders.
        values = [model.body_mass[body], *model.body_inertia[body], *model.body_iquat[body]]
        set_custom(prim, "inertial", [float(value) for value in values])
        return
    set_number(mass.CreateDiagonalInertiaAttr(), model.body_inertia[body])
    set_number(mass.CreatePrincipalAxesAttr(), model.body_iquat[body])


def _add_joints(writer: StageWriter) -> None:
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
    """Return whether MuJoCo never collides two bodies: welded into one, or parent and child of which neither is fixed."""
    one, two = int(model.body_weldid[one]), int(model.body_weldid[two])
    if one == two or not one or not two or model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
        return one == two
    return any(int(model.body_weldid[model.body_parentid[child]]) == parent for child, parent in ((one, two), (two, one)))


def _add_filters(writer: StageWriter) -> None:
    """Write the pairs of bodies that do not collide and that USD would not know of."""
    model, u, stage = writer.model, usd_modules(), writer.stage
    pairs = _excluded(model)
    masks = model.geom_contype | model.geom_conaffinity
    colliding = sorted({int(body) for body in model.geom_bodyid[masks != 0]} - {0})
    pairs |= {(a, b) for a, b in combinations(colliding, 2) if model.body_parentid[b] != a and _never_collide(model, a, b)}
    targets: dict[int, list[str]] = {}
    for one, two in sorted(pairs):
        if one:
            targets.setdefault(one, []).append(writer.bodies[two])
        elif one in writer.bodies:  # the world is no rigid body: each of its colliders is named
            others = stage.GetPrimAtPath(writer.bodies[one]).GetChildren()
            walls = [str(other.GetPath()) for other in others if other.HasAPI(u.UsdPhysics.CollisionAPI)]
            if walls:
                targets.setdefault(two, []).extend(walls)
    for body, others in sorted(targets.items()):
        filtered = u.UsdPhysics.FilteredPairsAPI.Apply(stage.GetPrimAtPath(writer.bodies[body]))
        filtered.CreateFilteredPairsRel().SetTargets(others)


def _unsupported_elements(writer: StageWriter) -> list[str]:
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


def _write(writer: StageWriter, out: Path) -> None:
    """Write the stage to a file that is whole whenever it is there."""
    try:
        with atomic_path(out) as temporary:
            if not writer.stage.GetRootLayer().Export(str(temporary)):
                raise OSError(0, "USD did not say why")
    except FileError as error:
        raise RobotError(f"{out}: cannot be written: {error.reason}") from error

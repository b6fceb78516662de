"""Equality constraints, each as what USD and the schemas of MuJoCo and Newton have for it.

- `connect` and `weld`: a spherical or fixed joint outside of the articulation, with MjcEqualityConnectAPI or
  MjcEqualityWeldAPI; it joins the bodies, or the sites, that the constraint names.
- A joint that follows another: NewtonMimicAPI and MjcEqualityJointAPI on the follower, in USD's positions, which are MuJoCo's:
  MJCF counts both positions from `qpos0`.
- What has no schema is a Scope that only tgdsl reads, MJCF's values in custom attributes: constraints of tendons, of a joint
  without a leader, and all but the first of a joint that follows several.

`tgdsl:equality` is a constraint's place in MuJoCo's order, `tgdsl:equality_name` its name. Those of flexes are left out.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float
from numpy.polynomial import Polynomial

from tgdsl.formats.usd.custom_attributes import default_model
from tgdsl.formats.usd.export.stage_writer import StageWriter, set_custom, set_number
from tgdsl.formats.usd.stage import NAMESPACE, usd_modules

CONNECT, WELD, JOINT, TENDON = (int(getattr(mujoco.mjtEq, f"mjEQ_{kind}")) for kind in ("CONNECT", "WELD", "JOINT", "TENDON"))
SITE = int(mujoco.mjtObj.mjOBJ_SITE)
LEAST_DEGREES = 2
"""Coefficients of the polynomial that Newton's schema holds; the others are MuJoCo's."""


def add_equalities(writer: StageWriter, scope: str, joints: dict[int, Any], tendons: dict[int, str]) -> None:
    """Write all equality constraints; say which are left out.

    Args:
        writer: Where to write them; all bodies, sites, joints and tendons are there.
        scope: Path of the scope that holds the joints.
        joints: The schema of each joint that can move, by MuJoCo's index.
        tendons: Path of each tendon's prim, by MuJoCo's index.
    """
    model, followers = writer.model, set[int]()
    for equality in range(model.neq):
        kind, first, second = (int(array[equality]) for array in (model.eq_type, model.eq_obj1id, model.eq_obj2id))
        name = model.equality(equality).name
        if kind in (CONNECT, WELD):
            prim = _add_closing_joint(writer, equality, scope)
        elif kind == JOINT and second >= 0 and first not in followers:
            prim = _add_mimic(writer, equality, joints)
            followers.add(first)
        elif kind in (JOINT, TENDON):
            paths = tendons if kind == TENDON else {index: str(own.GetPath()) for index, own in joints.items()}
            prim = _add_polynomial(writer, equality, scope, paths)
        else:
            what = f'equality constraint "{name}"' if name else f"unnamed equality constraint {equality}"
            writer.unsupported.append(f"{writer.file}: {what} is of a flex, which USD does not have: left out")
            continue
        set_custom(prim, "equality", equality)
        set_custom(prim, "equality_name", name)
        for attribute in ("solref", "solimp"):
            value = getattr(model, f"eq_{attribute}")[equality]
            if not np.array_equal(value, getattr(default_model(), f"jnt_{attribute}")[0]):
                types = usd_modules().Sdf.ValueTypeNames
                prim.CreateAttribute(f"mjc:{attribute}", types.DoubleArray, custom=False).Set(value.tolist())


def _add_closing_joint(writer: StageWriter, equality: int, scope: str) -> Any:
    """Write a `connect` or `weld`; its frames are where MuJoCo holds both ends together."""
    model, physics = writer.model, usd_modules().UsdPhysics
    is_weld = model.eq_type[equality] == WELD
    schema, kind = (physics.FixedJoint, "Weld") if is_weld else (physics.SphericalJoint, "Connect")
    made = schema.Define(writer.stage, writer.path(scope, model.equality(equality).name or kind.lower()))
    prim, ends = made.GetPrim(), (int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality]))
    prim.AddAppliedSchema(f"MjcEquality{kind}API")
    is_of_sites = model.eq_objtype[equality] == SITE
    for end, create in zip(ends, (made.CreateBody0Rel, made.CreateBody1Rel), strict=True):
        if is_of_sites or end:  # a joint without one of its bodies holds the other in the world
            create().SetTargets([(writer.sites if is_of_sites else writer.bodies)[end]])
    data = np.zeros(11) if is_of_sites else model.eq_data[equality]
    # MuJoCo keeps a connect's points on body 1 and 2, but a weld's on body 2 and 1, and then the rotation of 2 in 1.
    points = (data[3:6], data[0:3]) if is_weld else (data[0:3], data[3:6])
    turn = data[6:10] if is_weld and data[6:10].any() else np.array([1.0, 0.0, 0.0, 0.0])
    for number, (point, quat) in enumerate(zip(points, (turn, np.array([1.0, 0.0, 0.0, 0.0])), strict=True)):
        set_number(getattr(made, f"CreateLocalPos{number}Attr")(), point)
        set_number(getattr(made, f"CreateLocalRot{number}Attr")(), quat)
    made.CreateExcludeFromArticulationAttr(True)
    made.CreateCollisionEnabledAttr(True)
    made.CreateJointEnabledAttr(bool(model.eq_active0[equality]))
    if is_weld and model.eq_data[equality, 10] != 1.0:
        set_number(_number(prim, "mjc:torqueScale", "Float"), model.eq_data[equality, 10])
    return prim


def _add_mimic(writer: StageWriter, equality: int, joints: dict[int, Any]) -> Any:
    """Write a joint that follows another on the follower's prim."""
    model = writer.model
    follower, leader = int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])
    prim, leading = joints[follower].GetPrim(), joints[leader].GetPrim()
    for schema in ("NewtonMimicAPI", "MjcEqualityJointAPI"):
        prim.AddAppliedSchema(schema)
    prim.CreateRelationship("newton:mimicJoint", custom=False).SetTargets([leading.GetPath()])
    starts = (float(model.qpos0[model.jnt_qposadr[joint]]) for joint in (follower, leader))
    coefficients = shifted(model.eq_data[equality, :5], *starts)
    is_hinge = model.jnt_type[follower] == mujoco.mjtJoint.mjJNT_HINGE
    for power, coefficient in enumerate(coefficients.tolist()):
        if power < LEAST_DEGREES:
            unit = np.degrees(1.0) if is_hinge and power == 0 else 1.0
            set_number(_number(prim, f"newton:mimicCoef{power}", "Float"), coefficient * unit)
        elif coefficient:
            _number(prim, f"mjc:coef{power}", "Double").Set(coefficient)
    if not model.eq_active0[equality]:
        prim.CreateAttribute("newton:mimicEnabled", usd_modules().Sdf.ValueTypeNames.Bool, custom=False).Set(False)
    return prim


def shifted(coefficients: Float[np.ndarray, " 5"], follower: float, leader: float) -> Float[np.ndarray, " 5"]:
    """Return the polynomial p(x - leader) + follower, for one p(x) of displacements: of positions.

    Args:
        coefficients: Of p, from the constant on.
        follower: Where the follower's displacement is zero [rad or m].
        leader: The same of the leader.
    """
    result = np.zeros(5)
    moved = Polynomial(coefficients)(Polynomial([-leader, 1.0])).coef if leader else coefficients
    result[: len(moved)] = moved
    result[0] += follower
    return result


def _add_polynomial(writer: StageWriter, equality: int, scope: str, paths: dict[int, str]) -> Any:
    """Write what no schema has: MJCF's values, and what they are of."""
    model, u = writer.model, usd_modules()
    path = writer.path(scope, model.equality(equality).name or "equality")
    prim = u.UsdGeom.Scope.Define(writer.stage, path).GetPrim()
    for end in (1, 2):
        index = int(getattr(model, f"eq_obj{end}id")[equality])
        if index >= 0:
            prim.CreateRelationship(f"{NAMESPACE}end{end}", custom=True).SetTargets([paths[index]])
    set_custom(prim, "polycoef", model.eq_data[equality, :5].tolist())
    if not model.eq_active0[equality]:
        set_custom(prim, "active", False)
    return prim


def _number(prim: Any, name: str, kind: str) -> Any:
    return prim.CreateAttribute(name, getattr(usd_modules().Sdf.ValueTypeNames, kind), custom=False)

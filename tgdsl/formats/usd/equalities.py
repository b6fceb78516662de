"""Equality constraints, read and written by the schemas of USD, MuJoCo and Newton.

- `connect` and `weld`: a spherical or fixed joint outside of the articulation, with MjcEqualityConnectAPI or
  MjcEqualityWeldAPI; it joins the bodies, or the sites, that the constraint names.
- A joint that follows another: NewtonMimicAPI and MjcEqualityJointAPI on the follower, in USD's positions, which are MuJoCo's:
  MJCF counts both positions from `qpos0`.
- Constraints without a schema are Scopes that only tgdsl reads, with MJCF's values in custom attributes: constraints of
  tendons, of a joint without a leader, and of a joint with several leaders after its first.

`tgdsl:equality` is a constraint's place in MuJoCo's order, `tgdsl:equality_name` its name. Constraints of flexes are skipped.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float
from numpy.polynomial import Polynomial
from scipy.spatial.transform import Rotation

from tgdsl.errors import listed
from tgdsl.formats.usd import attributes as attr
from tgdsl.formats.usd.joints import Joint
from tgdsl.formats.usd.stage import NAMESPACE, Matrix, Names, Prim, Stage, usd_modules

USUAL = (0.0, 1.0, 0.0, 0.0, 0.0)  # coefficients of a joint that follows another one to one
ORDER = "order"  # attribute of an element that is there until all are put in order
SITE_TOLERANCE = 1e-9  # largest difference of a joint frame from the site that it is on [m and 1]
CONNECT_EQ, WELD_EQ, JOINT_EQ, TENDON_EQ = (
    int(getattr(mujoco.mjtEq, f"mjEQ_{kind}")) for kind in ("CONNECT", "WELD", "JOINT", "TENDON")
)
NEWTON_COEFFICIENTS = 2  # coefficients of the polynomial that Newton's schema holds; the others are MuJoCo's


def shifted(coefficients: Float[np.ndarray, " 5"], follower: float, leader: float) -> Float[np.ndarray, " 5"]:
    """Return the polynomial p(x - leader) + follower, for one p(x) of displacements: of positions."""
    result = np.zeros(5)
    moved = Polynomial(coefficients)(Polynomial([-leader, 1.0])).coef if leader else coefficients
    result[: len(moved)] = moved
    result[0] += follower
    return result


def read_couplings(stage: Stage, equality: ET.Element, joints: Iterable[Joint], names: Mapping[str, str]) -> None:
    """Add the constraint of each joint that follows another."""
    joints = list(joints)
    references = {joint.path: joint.reference if attr.read_custom(stage, joint.prim, "ref") else 0.0 for joint in joints}
    for joint in joints:
        prim = joint.prim
        if any("Mimic" in schema and not schema.startswith("Newton") for schema in stage.schemas(prim)):
            stage.drop("couplings between joints (mimic) were dropped", prim)
        if not stage.has(prim, "NewtonMimicAPI"):
            continue
        authored = attr.read_attributes(stage, prim, attr.MIMIC, is_angular=joint.kind == "hinge")
        leaders = []
        for name in ("mjc:target", "newton:mimicJoint"):
            targets = stage.targets(prim, name)
            if len(targets) > 1:
                raise stage.error(prim, f"{name} has {len(targets)} targets, {listed(targets)}; expected one, which it follows")
            leaders += targets
        if joint.path not in names or not leaders or leaders[0] not in names:
            stage.drop("couplings were dropped whose leader or follower is no revolute or prismatic joint", prim)
            continue
        if len(set(leaders)) > 1:
            stage.drop("newton:mimicJoint was dropped, which contradicts mjc:target", prim)
        attributes = {"joint1": names[joint.path], "joint2": names[leaders[0]]}
        positions = np.array([float(authored.get(str(i), usual)) for i, usual in enumerate(USUAL)])
        displacements = shifted(positions, -references[joint.path], -references[leaders[0]])
        attributes["polycoef"] = attr.text_of(displacements.tolist())
        if stage.authored(prim, "newton:mimicEnabled") is False:
            attributes["active"] = "false"
        attributes |= attr.read_attributes(stage, prim, attr.EQUALITY)
        _add(stage, equality, "joint", prim, names[joint.path], attributes)


def read_polynomials(stage: Stage, equality: ET.Element, names: Names) -> None:
    """Add the constraints that only tgdsl's attributes describe."""
    ends = {"joint": names.scalars, "tendon": names.tendons}
    for prim in stage.prims:
        if prim.GetTypeName() != "Scope" or (coefficients := attr.read_custom(stage, prim, "polycoef")) is None:
            continue
        paths = [path for end in (1, 2) for path in stage.targets(prim, f"{NAMESPACE}end{end}")]
        tag = next((tag for tag, names_by_path in ends.items() if paths and all(path in names_by_path for path in paths)), None)
        if tag is None:
            stage.drop("equality constraints were dropped whose ends are no joints or tendons of the model", prim)
            continue
        attributes = {f"{tag}{number}": ends[tag][path] for number, path in enumerate(paths, start=1)}
        attributes["polycoef"] = attr.text_of(list(coefficients))
        if attr.read_custom(stage, prim, "active") is False:
            attributes["active"] = "false"
        _add(stage, equality, tag, prim, prim.GetName(), attributes | attr.read_attributes(stage, prim, attr.EQUALITY))


def read_exact_constraint(stage: Stage, equality: ET.Element, joint: Joint, names: Names, sites: Mapping[str, Matrix]) -> bool:
    """Add a `connect` or `weld` between sites that the joint names, or one between bodies that `export` wrote."""
    is_weld = joint.constraint == "MjcEqualityWeldAPI"
    first, second = joint.frames
    is_on_sites = all(
        target in sites and np.abs(sites[target] - frame).max() <= SITE_TOLERANCE
        for target, frame in zip(joint.targets, joint.frames, strict=True)
    )
    if is_on_sites:
        attributes = {"site1": names.sites[joint.targets[0]], "site2": names.sites[joint.targets[1]]}
    elif attr.read_custom(stage, joint.prim, "equality") is None:
        return False
    else:
        one, two = ("world" if body is None else names.bodies[body] for body in joint.bodies)
        attributes = {"body1": one, "body2": two, "anchor": attr.text_of((second if is_weld else first)[:3, 3].tolist())}
        if is_weld:
            turn = Rotation.from_matrix(first[:3, :3] @ second[:3, :3].T).as_quat(canonical=True, scalar_first=True)
            attributes["relpose"] = attr.text_of([*first[:3, 3].tolist(), *turn.tolist()])
    attributes |= constraint_attributes(stage, joint)
    _add(stage, equality, "weld" if is_weld else "connect", joint.prim, names.joints[joint.path], attributes)
    return True


def constraint_attributes(stage: Stage, joint: Joint) -> dict[str, str]:
    table = attr.WELD if joint.constraint == "MjcEqualityWeldAPI" else attr.EQUALITY
    return ({} if joint.is_active else {"active": "false"}) | attr.read_attributes(stage, joint.prim, table)


def _add(stage: Stage, equality: ET.Element, tag: str, prim: Prim, name: str, attributes: Mapping[str, str]) -> None:
    """Add a constraint under its original name, or one derived from `name`."""
    taken = {element.get("name") for element in equality}
    unique = str(attr.read_custom(stage, prim, "equality_name") or name)
    while unique in taken:
        unique += "_"
    place = attr.read_custom(stage, prim, "equality")
    order = {} if place is None else {ORDER: str(int(place))}
    ET.SubElement(equality, tag, {"name": unique, **attributes, **order})


def write_equalities(writer: attr.StageWriter) -> None:
    """Write all equality constraints; say which are left out. All bodies, sites, joints and tendons are there."""
    model, followers = writer.model, set[int]()
    for equality in range(model.neq):
        kind, first, second = (int(array[equality]) for array in (model.eq_type, model.eq_obj1id, model.eq_obj2id))
        name = model.equality(equality).name
        if kind in (CONNECT_EQ, WELD_EQ):
            prim = _write_closing_joint(writer, equality, kind == WELD_EQ)
        elif kind == JOINT_EQ and second >= 0 and first not in followers:
            prim = _write_mimic(writer, equality)
            followers.add(first)
        elif kind in (JOINT_EQ, TENDON_EQ):
            joints = {index: str(joint.GetPath()) for index, joint in writer.joints.items()}
            prim = _write_polynomial(writer, equality, writer.tendons if kind == TENDON_EQ else joints)
        else:
            constraint = f'equality constraint "{name}"' if name else f"unnamed equality constraint {equality}"
            writer.unsupported.append(f"{writer.file}: {constraint} is of a flex, which USD does not have: left out")
            continue
        attr.set_custom(prim, "equality", equality)
        attr.set_custom(prim, "equality_name", name)
        for attribute in attr.EQUALITY:
            value = getattr(model, f"eq_{attribute}")[equality]
            if not np.array_equal(value, getattr(attr.default_model(), f"jnt_{attribute}")[0]):
                attr.author(prim, f"mjc:{attribute}", value.tolist())


def _write_closing_joint(writer: attr.StageWriter, equality: int, is_weld: bool) -> Any:
    """Write a `connect` or `weld`; its frames are where MuJoCo holds both ends together."""
    model, physics = writer.model, usd_modules().UsdPhysics
    schema, kind = (physics.FixedJoint, "Weld") if is_weld else (physics.SphericalJoint, "Connect")
    joint = schema.Define(writer.stage, writer.path(writer.scope, model.equality(equality).name or kind.lower()))
    prim, ends = joint.GetPrim(), (int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality]))
    prim.AddAppliedSchema(f"MjcEquality{kind}API")
    is_of_sites = model.eq_objtype[equality] == mujoco.mjtObj.mjOBJ_SITE
    for end, create in zip(ends, (joint.CreateBody0Rel, joint.CreateBody1Rel), strict=True):
        if is_of_sites or end:  # a joint without one of its bodies holds the other in the world
            create().SetTargets([(writer.sites if is_of_sites else writer.bodies)[end]])
    data = np.zeros(11) if is_of_sites else model.eq_data[equality]
    # MuJoCo keeps a connect's points on body 1 and 2, but a weld's on body 2 and 1, and then the rotation of 2 in 1.
    points = (data[3:6], data[0:3]) if is_weld else (data[0:3], data[3:6])
    turn = data[6:10] if is_weld and data[6:10].any() else np.array([1.0, 0.0, 0.0, 0.0])
    for number, (point, quat) in enumerate(zip(points, (turn, np.array([1.0, 0.0, 0.0, 0.0])), strict=True)):
        attr.set_number(getattr(joint, f"CreateLocalPos{number}Attr")(), point)
        attr.set_number(getattr(joint, f"CreateLocalRot{number}Attr")(), quat)
    joint.CreateExcludeFromArticulationAttr(True)
    joint.CreateCollisionEnabledAttr(True)
    joint.CreateJointEnabledAttr(bool(model.eq_active0[equality]))
    if is_weld and model.eq_data[equality, 10] != 1.0:
        attr.set_number(_float(prim, "mjc:torqueScale"), model.eq_data[equality, 10])
    return prim


def _write_mimic(writer: attr.StageWriter, equality: int) -> Any:
    """Write a joint that follows another on the follower's prim."""
    model = writer.model
    follower, leader = int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality])
    prim, leading = writer.joints[follower].GetPrim(), writer.joints[leader].GetPrim()
    for schema in ("NewtonMimicAPI", "MjcEqualityJointAPI"):
        prim.AddAppliedSchema(schema)
    prim.CreateRelationship("newton:mimicJoint", custom=False).SetTargets([leading.GetPath()])
    starts = (float(model.qpos0[model.jnt_qposadr[joint]]) for joint in (follower, leader))
    is_hinge = model.jnt_type[follower] == mujoco.mjtJoint.mjJNT_HINGE
    for power, coefficient in enumerate(shifted(model.eq_data[equality, :5], *starts).tolist()):
        if power < NEWTON_COEFFICIENTS:
            unit = np.degrees(1.0) if is_hinge and power == 0 else 1.0
            attr.set_number(_float(prim, f"newton:mimicCoef{power}"), coefficient * unit)
        elif coefficient:
            attr.author(prim, f"mjc:coef{power}", coefficient)
    if not model.eq_active0[equality]:
        attr.author(prim, "newton:mimicEnabled", False)
    return prim


def _write_polynomial(writer: attr.StageWriter, equality: int, paths: Mapping[int, str]) -> Any:
    """Write what no schema has: MJCF's values, and what they are of."""
    model = writer.model
    path = writer.path(writer.scope, model.equality(equality).name or "equality")
    prim = usd_modules().UsdGeom.Scope.Define(writer.stage, path).GetPrim()
    for end in (1, 2):
        index = int(getattr(model, f"eq_obj{end}id")[equality])
        if index >= 0:
            prim.CreateRelationship(f"{NAMESPACE}end{end}", custom=True).SetTargets([paths[index]])
    attr.set_custom(prim, "polycoef", model.eq_data[equality, :5].tolist())
    if not model.eq_active0[equality]:
        attr.set_custom(prim, "active", False)
    return prim


def _float(prim: Any, name: str) -> Any:
    return prim.CreateAttribute(name, usd_modules().Sdf.ValueTypeNames.Float, custom=False)

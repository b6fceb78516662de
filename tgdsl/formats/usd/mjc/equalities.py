"""Equality constraints: joints that follow another (NewtonMimicAPI, MjcEqualityJointAPI), and those that `export` wrote.

How these are written, and the attributes `tgdsl:equality` and `equality_name`, see `export/equalities.py`.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Float
from numpy.polynomial import Polynomial
from scipy.spatial.transform import Rotation

from tgdsl.errors import listed
from tgdsl.formats.usd.custom_attributes import read_custom, text_of
from tgdsl.formats.usd.joints import Joint
from tgdsl.formats.usd.mjc.attributes import EQUALITY, WELD, Source, SourceTable, mjc, read_attributes
from tgdsl.formats.usd.stage import NAMESPACE, Prim, Stage

COEFFICIENTS: SourceTable = {
    "0": mjc("coef0", Source("newton:mimicCoef0", "position")),
    "1": mjc("coef1", Source("newton:mimicCoef1")),
    **{str(power): mjc(f"coef{power}") for power in (2, 3, 4)},
}
"""Of the polynomial of the leader's position. MJCF counts all of them in radians, whatever its compiler's angle."""
USUAL = (0.0, 1.0, 0.0, 0.0, 0.0)
ORDER = "order"
"""Attribute of an element that is there until all are put in order."""
SITE_TOLERANCE = 1e-9
"""Largest difference of a joint frame from the site that it is on [m and 1]."""


def add_couplings(stage: Stage, equality: ET.Element, joints: Iterable[Joint], names: Mapping[str, str]) -> None:
    """Add the constraint of each joint that follows another.

    Args:
        stage: The stage.
        equality: Where constraints go.
        joints: All joints.
        names: Names of the hinges and slides of the tree by path: only these can lead or follow.

    Raises:
        RobotError: If a joint follows several.
    """
    joints = list(joints)
    references = {joint.path: joint.reference if read_custom(stage, joint.prim, "ref") else 0.0 for joint in joints}
    for joint in joints:
        prim = joint.prim
        if any("Mimic" in schema and not schema.startswith("Newton") for schema in stage.schemas(prim)):
            stage.drop("couplings between joints (mimic) were dropped", prim)
        if not stage.has(prim, "NewtonMimicAPI"):
            continue
        found = read_attributes(stage, prim, COEFFICIENTS, is_angular=joint.kind == "hinge")
        leaders = []
        for name in ("mjc:target", "newton:mimicJoint"):
            targets = [str(path) for path in stage.targets(prim, name)]
            if len(targets) > 1:
                raise stage.error(prim, f"{name} has {len(targets)} targets, {listed(targets)}; expected one, which it follows")
            leaders += targets
        if joint.path not in names or not leaders or leaders[0] not in names:
            stage.drop("couplings were dropped of which the leader or the follower is no revolute or prismatic joint", prim)
            continue
        if len(set(leaders)) > 1:
            stage.drop("newton:mimicJoint was dropped, which contradicts mjc:target", prim)
        attributes = {"joint1": names[joint.path], "joint2": names[leaders[0]]}
        positions = np.array([float(found.get(str(i), usual)) for i, usual in enumerate(USUAL)])
        attributes["polycoef"] = text_of(_of_displacements(positions, references[joint.path], references[leaders[0]]).tolist())
        if stage.authored(prim, "newton:mimicEnabled") is False:
            attributes["active"] = "false"
        attributes |= read_attributes(stage, prim, EQUALITY)
        _add(stage, equality, "joint", prim, names[joint.path], attributes)


def _of_displacements(coefficients: Float[np.ndarray, " 5"], follower: float, leader: float) -> Float[np.ndarray, " 5"]:
    """Return a polynomial of positions as one of displacements from the positions at `qpos0`: MJCF's.

    Args:
        coefficients: From the constant on.
        follower: Position of the follower at `qpos0` [rad or m].
        leader: The same of the leader.
    """
    result = np.zeros(5)
    moved = Polynomial(coefficients)(Polynomial([leader, 1.0])).coef if leader else coefficients
    result[: len(moved)] = moved
    result[0] -= follower
    return result


def add_polynomials(stage: Stage, equality: ET.Element, names: Mapping[str, Mapping[str, str]]) -> None:
    """Add the constraints that only tgdsl's attributes describe.

    Args:
        stage: The stage.
        equality: Where constraints go.
        names: By element (`joint`, `tendon`), the names of those that a constraint can have, by path.
    """
    for prim in stage.prims:
        if prim.GetTypeName() != "Scope" or (coefficients := read_custom(stage, prim, "polycoef")) is None:
            continue
        paths = [str(path) for end in (1, 2) for path in stage.targets(prim, f"{NAMESPACE}end{end}")]
        tag = next((tag for tag, own in names.items() if paths and all(path in own for path in paths)), None)
        if tag is None:
            stage.drop("equality constraints were dropped whose ends are no joints or tendons of the model", prim)
            continue
        attributes = {f"{tag}{number}": names[tag][path] for number, path in enumerate(paths, start=1)}
        attributes["polycoef"] = text_of(list(coefficients))
        if read_custom(stage, prim, "active") is False:
            attributes["active"] = "false"
        _add(stage, equality, tag, prim, prim.GetName(), attributes | read_attributes(stage, prim, EQUALITY))


def add_exact_constraint(
    stage: Stage,
    equality: ET.Element,
    joint: Joint,
    bodies: Mapping[str, str],
    sites: Mapping[str, tuple[str, Float[np.ndarray, "4 4"]]],
    name: str,
) -> bool:
    """Add a `connect` or `weld` between sites that the joint names, or one between bodies that `export` wrote.

    Args:
        stage: The stage.
        equality: Where constraints go.
        joint: A joint that is an equality constraint of MuJoCo.
        bodies: Names of the bodies, by path.
        sites: Names of the sites and their poses in their bodies [m], by path.
        name: The joint's name.

    Returns:
        Whether it is one of these.
    """
    is_weld = joint.constraint == "MjcEqualityWeldAPI"
    ends = [sites.get(target) for target in joint.targets]
    first, second = joint.frames
    on_sites = [own[0] for own, frame in zip(ends, joint.frames, strict=True) if own and _is_same(own[1], frame)]
    if len(on_sites) == 2:
        attributes = {"site1": on_sites[0], "site2": on_sites[1]}
    elif read_custom(stage, joint.prim, "equality") is None:
        return False
    else:
        one, two = ("world" if body is None else bodies[body] for body in joint.bodies)
        attributes = {"body1": one, "body2": two, "anchor": text_of((second if is_weld else first)[:3, 3].tolist())}
        if is_weld:
            turn = Rotation.from_matrix(first[:3, :3] @ second[:3, :3].T).as_quat(canonical=True, scalar_first=True)
            attributes["relpose"] = text_of([*first[:3, 3].tolist(), *turn.tolist()])
    attributes |= {} if joint.is_active else {"active": "false"}
    attributes |= read_attributes(stage, joint.prim, WELD if is_weld else EQUALITY)
    _add(stage, equality, "weld" if is_weld else "connect", joint.prim, name, attributes)
    return True


def _is_same(one: Float[np.ndarray, "4 4"], two: Float[np.ndarray, "4 4"]) -> bool:
    return bool(np.abs(one - two).max() <= SITE_TOLERANCE)


def _add(stage: Stage, equality: ET.Element, tag: str, prim: Prim, name: str, attributes: Mapping[str, str]) -> None:
    """Add a constraint under the name that it had, or one like the name given."""
    taken = {element.get("name") for element in equality}
    own = str(read_custom(stage, prim, "equality_name") or name)
    while own in taken:
        own += "_"
    place = read_custom(stage, prim, "equality")
    order = {} if place is None else {ORDER: str(int(place))}
    ET.SubElement(equality, tag, {"name": own, **attributes, **order})


def put_in_order(equality: ET.Element) -> None:
    """Sort constraints as `export` found them; the others come after."""
    equality[:] = sorted(equality, key=lambda element: float(element.attrib.pop(ORDER, math.inf)))

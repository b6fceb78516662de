"""Joints that follow another joint: NewtonMimicAPI and MjcEqualityJointAPI, as MJCF's equality constraint between joints."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping

from tgdsl.formats.usd.custom_attributes import text_of
from tgdsl.formats.usd.joints import Joint
from tgdsl.formats.usd.mjc.attributes import EQUALITY, Source, SourceTable, mjc, read_attributes
from tgdsl.formats.usd.stage import Stage

COEFFICIENTS: SourceTable = {
    "0": mjc("coef0", Source("newton:mimicCoef0", "position")),
    "1": mjc("coef1", Source("newton:mimicCoef1")),
    **{str(power): mjc(f"coef{power}") for power in (2, 3, 4)},
}
"""Of the polynomial of the leader's position. MJCF counts all of them in radians, whatever its compiler's angle."""
USUAL = (0.0, 1.0, 0.0, 0.0, 0.0)


def add_couplings(stage: Stage, equality: ET.Element, joints: Iterable[Joint], names: Mapping[str, str]) -> None:
    """Add the constraint of each joint that follows another.

    Args:
        stage: The stage.
        equality: Where constraints go.
        joints: All joints.
        names: Names of the hinges and slides of the tree by path: only these can lead or follow.
    """
    taken = {element.get("name") for element in equality}
    for joint in joints:
        prim = joint.prim
        if any("Mimic" in schema and not schema.startswith("Newton") for schema in stage.schemas(prim)):
            stage.drop("couplings between joints (mimic) were dropped", prim)
        if not stage.has(prim, "NewtonMimicAPI"):
            continue
        found = read_attributes(stage, prim, COEFFICIENTS, is_angular=joint.kind == "hinge")
        leaders = [str(path) for name in ("mjc:target", "newton:mimicJoint") for path in stage.targets(prim, name)]
        if joint.path not in names or not leaders or leaders[0] not in names:
            stage.drop("couplings were dropped of which the leader or the follower is no revolute or prismatic joint", prim)
            continue
        if len(set(leaders)) > 1:
            stage.drop("newton:mimicJoint was dropped, which contradicts mjc:target", prim)
        name = names[joint.path]
        while name in taken:
            name += "_"
        taken.add(name)
        attributes = {"name": name, "joint1": names[joint.path], "joint2": names[leaders[0]]}
        attributes["polycoef"] = text_of([float(found.get(str(i), usual)) for i, usual in enumerate(USUAL)])
        if stage.authored(prim, "newton:mimicEnabled") is False:
            attributes["active"] = "false"
        ET.SubElement(equality, "joint", attributes | read_attributes(stage, prim, EQUALITY))

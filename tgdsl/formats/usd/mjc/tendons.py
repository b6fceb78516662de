"""Tendons of a USD stage (MjcTendon) as MJCF's `fixed` and `spatial`."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from typing import Any

from tgdsl.formats.usd.mjc.actuators import Named
from tgdsl.formats.usd.mjc.attributes import SourceTable, mjc, read_attributes, with_limits
from tgdsl.formats.usd.stage import Prim, Stage, unique_names

TENDON: SourceTable = {
    **{name: mjc(name) for name in ("armature", "damping", "frictionloss", "stiffness", "springlength", "margin", "group")},
    **{f"sol{what}{of}": mjc(f"sol{what}{of}") for what in ("ref", "imp") for of in ("limit", "friction")},
    "limited": mjc("limited"),
    "range": mjc("range", is_range=True),
    "actuatorfrclimited": mjc("actuatorfrclimited"),
    "actuatorfrcrange": mjc("actuatorfrcrange", is_range=True),
}
DRAWN: SourceTable = {"rgba": mjc("rgba"), "width": mjc("width")}
"""Of a spatial tendon; a fixed one is not drawn."""


def add_tendons(stage: Stage, tendon: ET.Element, named: Named) -> dict[str, str]:
    """Add all tendons to their element; return their names by path.

    Raises:
        RobotError: If the arrays that describe a path do not belong together.
    """
    prims = [prim for prim in stage.prims if prim.GetTypeName() == "MjcTendon"]
    names = unique_names(stage, prims)
    result = {}
    for prim in prims:
        element = _tendon(stage, prim, named)
        if element is not None:
            result[str(prim.GetPath())] = names[str(prim.GetPath())]
            element.set("name", names[str(prim.GetPath())])
            tendon.append(element)
    return result


def _tendon(stage: Stage, prim: Prim, named: Named) -> ET.Element | None:
    is_fixed = str(stage.value(prim, "mjc:type")) == "fixed"
    attributes = with_limits(stage, read_attributes(stage, prim, TENDON), ("", "actuatorfrc"))
    drawn = read_attributes(stage, prim, DRAWN)
    attributes |= {} if is_fixed else drawn
    targets = [str(path) for path in stage.targets(prim, "mjc:path")]
    order = _array(stage, prim, "path:indices") or list(range(len(targets)))
    if not order or max(order) >= len(targets) or min(order) < 0:
        raise stage.error(prim, f"mjc:path:indices is {order}; mjc:path has {len(targets)} targets")
    element = ET.Element("fixed" if is_fixed else "spatial", attributes)
    add = _add_joints if is_fixed else _add_points
    if add(stage, prim, named, element, [targets[index] for index in order]):
        return element
    stage.drop("tendons were dropped that pass over what is no joint, site or geom of the model", prim)
    return None


def _array(stage: Stage, prim: Prim, name: str) -> list[Any]:
    return list(stage.authored(prim, f"mjc:{name}") or ())


def _add_joints(stage: Stage, prim: Prim, named: Named, element: ET.Element, path: list[str]) -> bool:
    """Add the joints of a fixed tendon; return whether all are there."""
    coefficients = _array(stage, prim, "path:coef") or [1.0] * len(path)
    if len(coefficients) != len(path):
        raise stage.error(prim, f"mjc:path:coef has {len(coefficients)} numbers; the path has {len(path)} joints")
    for target, coefficient in zip(path, coefficients, strict=True):
        ET.SubElement(element, "joint", joint=named.joints.get(target, ""), coef=repr(float(coefficient)))
    return all(target in named.joints for target in path)


def _add_points(stage: Stage, prim: Prim, named: Named, element: ET.Element, path: list[str]) -> bool:
    """Add the sites, geoms and pulleys of a spatial tendon; return whether all are there, side sites included."""
    segments, divisors = _array(stage, prim, "path:segments") or [0] * len(path), _array(stage, prim, "path:divisors")
    beside = _array(stage, prim, "sideSites:indices") or [-1] * len(path)
    sides = [str(side) for side in stage.targets(prim, "mjc:sideSites")]
    for name, values in (("path:segments", segments), ("sideSites:indices", beside)):
        if len(values) != len(path):
            raise stage.error(prim, f"mjc:{name} has {len(values)} numbers; the path has {len(path)} points")
    if max(segments) >= max(len(divisors), 1) or max(beside) >= len(sides):
        raise stage.error(prim, "mjc:path:divisors or mjc:sideSites has fewer entries than the path names")
    divisors, before = divisors or [1.0], None
    for target, segment, side in zip(path, segments, beside, strict=True):
        if segment != before and (before is not None or divisors[segment] != 1.0):
            ET.SubElement(element, "pulley", divisor=repr(float(divisors[segment])))
        before = segment
        if target in named.sites:
            ET.SubElement(element, "site", site=named.sites[target])
        elif target in named.geoms:
            wrapped = ET.SubElement(element, "geom", geom=named.geoms[target])
            if side >= 0 and sides[side] not in named.sites:
                return False
            if side >= 0:
                wrapped.set("sidesite", named.sites[sides[side]])
        else:
            return False
    return True

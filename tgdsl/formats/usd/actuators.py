"""Actuators that are prims, tendons and keyframes, read and written: MjcActuator, MjcTendon, MjcKeyframe, NewtonActuator.

Names and types of attributes follow MjcPhysics (mujoco-usd-converter 0.8); attributes that it lacks begin with `tgdsl:`.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from tgdsl.formats.usd import attributes as attr
from tgdsl.formats.usd.joints import Drive, Joint
from tgdsl.formats.usd.stage import Names, Prim, Stage, unique_names, usd_modules

MJC_ACTUATOR, NEWTON_ACTUATOR = "MjcActuator", "NewtonActuator"
NO_TARGET = "actuators were dropped whose target is no joint, site, tendon or body of the model"
TOO_MANY = "targets of actuators after the first one were dropped"
SAME_GAIN = 1e-5  # relative difference up to which a drive, which is in float32, and an actuator are the same servo
TRN = {name.removeprefix("mjTRN_"): int(value) for name, value in mujoco.mjtTrn.__members__.items()}
WRAP = {name.removeprefix("mjWRAP_"): int(value) for name, value in mujoco.mjtWrap.__members__.items()}


@dataclass(frozen=True)
class Actuator:
    """An actuator of MJCF."""

    attributes: dict[str, str]  # of the element
    joint: str  # path of the joint that it acts on, or empty
    order: float  # place among the actuators with an order; the others follow
    control: float = 0.0  # at the keyframe `authored`
    kind: str = "general"  # which element it is


def read_actuators(stage: Stage, names: Names) -> list[Actuator]:
    """Read all actuator prims, MuJoCo's first, in stage order."""
    prims = [prim for prim in stage.prims if prim.GetTypeName() in (MJC_ACTUATOR, NEWTON_ACTUATOR)]
    prim_names = unique_names(stage, prims)
    results: list[Actuator] = []
    for prim in sorted(prims, key=lambda prim: prim.GetTypeName() != MJC_ACTUATOR):
        is_newton = prim.GetTypeName() == NEWTON_ACTUATOR
        actuator = (_newton_actuator if is_newton else _mjc_actuator)(stage, prim, names, prim_names[str(prim.GetPath())])
        if actuator and is_newton and actuator.joint in [other.joint for other in results]:
            stage.drop("NewtonActuators were dropped whose joint has an MjcActuator", prim)
        elif actuator:
            results.append(actuator)
    return results


def _mjc_actuator(stage: Stage, prim: Prim, names: Names, name: str) -> Actuator | None:
    targets, slider, reference = (stage.targets(prim, f"mjc:{kind}") for kind in ("target", "sliderSite", "refSite"))
    is_in_parent, order = bool(stage.authored(prim, "mjc:jointInParent")), attr.read_custom(stage, prim, "order")
    attributes = attr.with_limits(stage, attr.read_attributes(stage, prim, attr.ACTUATOR), attr.LIMITS)
    target = targets[0] if targets else ""
    kinds = {
        "jointinparent" if is_in_parent else "joint": names.moving,
        "cranksite" if slider else "site": names.sites,
        "tendon": names.tendons,
        "body": names.bodies,
    }
    ends = {kind: paths[target] for kind, paths in kinds.items() if target in paths}
    if not ends or any(path not in names.sites for path in (*slider, *reference)):
        stage.drop(NO_TARGET, prim)
        return None
    ends |= {"slidersite": names.sites[slider[0]]} if slider else {}
    ends |= {"refsite": names.sites[reference[0]]} if reference else {}
    if max(map(len, (targets, slider, reference))) > 1:
        stage.drop(TOO_MANY, prim)
    if not slider and float(attributes.pop("cranklength", 0.0)):
        stage.drop("mjc:crankLength was dropped of actuators without mjc:sliderSite", prim)
    joint = target if target in names.moving else ""
    return Actuator({"name": name} | ends | attributes, joint, math.inf if order is None else float(order))


def _newton_actuator(stage: Stage, prim: Prim, names: Names, name: str) -> Actuator | None:
    """Return effort = constant + kp (target - q) - kd v as an actuator; without kp the control is the target velocity."""
    targets = stage.targets(prim, "newton:targets")
    if not targets or targets[0] not in names.moving:
        stage.drop(NO_TARGET, prim)
        return None
    if len(targets) > 1:
        stage.drop(TOO_MANY, prim)
    is_angular = stage.usd.GetPrimAtPath(targets[0]).GetTypeName() != "PhysicsPrismaticJoint"
    values = {key: float(value) for key, value in attr.read_attributes(stage, prim, attr.SERVO, is_angular).items()}
    kp, kd, constant = (values.get(key, 0.0) for key in ("kp", "kd", "constant"))
    if not (stage.has(prim, "NewtonPDControlAPI") or stage.has(prim, "NewtonPIDControlAPI")) or not (kp or kd):
        stage.drop("NewtonActuators were dropped that are no PD control with gains", prim)
        return None
    attributes = {"name": name, "joint": names.moving[targets[0]], "biastype": "affine", "gainprm": repr(kp or kd)}
    attributes["biasprm"] = attr.text_of([constant, 0.0 - kp, 0.0 - kd])
    if "most" in values:
        attributes["forcerange"] = attr.text_of([-values["most"], values["most"]])
    return Actuator(attributes, targets[0], math.inf)


def servos_of(stage: Stage, joints: Iterable[Joint], prims: Sequence[Actuator], names: Names) -> list[Actuator]:
    """Return the drives of joints as actuators, except where an actuator prim defines one."""
    results, of_joint = list[Actuator](), {actuator.joint: actuator for actuator in prims if actuator.joint}
    taken = {actuator.attributes["name"] for actuator in prims}
    for joint in joints:
        drive, other = joint.drive, of_joint.get(joint.path)
        if drive and (other is None or not math.isinf(drive.order)):
            results.append(_servo(joint, drive, names.joints[joint.path], taken))
        elif drive and other and not _is_same_servo(drive, other):
            stage.drop("drives were dropped, which contradict the actuator prims of their joints", joint.prim)
    return results


def _is_same_servo(drive: Drive, actuator: Actuator) -> bool:
    gain, gear = (float(actuator.attributes.get(name, "1").split()[0]) for name in ("gainprm", "gear"))
    bias = [float(value) for value in actuator.attributes.get("biasprm", "").split()] + [0.0] * 3
    gains = np.array([gain, -bias[1], -bias[2]]) * gear**2
    drive_gains = np.array([drive.stiffness or drive.damping, drive.stiffness, drive.damping])
    return bool(np.allclose(gains, drive_gains, rtol=SAME_GAIN))


def _servo(joint: Joint, drive: Drive, name: str, taken: set[str]) -> Actuator:
    """Return the actuator that is a joint's drive; its control at the keyframe is the drive's target."""
    unique = drive.actuator or name
    while unique in taken:
        unique += "_drive"
    taken.add(unique)
    attributes, gear = {"name": unique, "joint": name}, drive.gear
    if gear != 1.0:
        attributes["gear"] = attr.text_of([gear])
    if drive.control is not None:
        attributes["ctrlrange"] = attr.text_of(sorted(end * gear for end in drive.control))
    if not math.isinf(drive.max_force):
        limit = drive.max_force / abs(gear)
        attributes["forcerange"] = attr.text_of([-limit, limit])
    stiffness, damping = drive.stiffness / gear**2, drive.damping / gear**2
    kp, kv = attr.text_of([stiffness]), attr.text_of([damping])
    if not stiffness:
        return Actuator(attributes | {"kv": kv}, joint.path, drive.order, drive.target_velocity * gear, "velocity")
    if not drive.target_velocity:
        return Actuator(attributes | {"kp": kp, "kv": kv}, joint.path, drive.order, drive.target * gear, "position")
    # A spring whose damper pulls towards a speed: a position actuator with a constant force.
    bias = attr.text_of([damping * drive.target_velocity * gear, -stiffness, -damping])
    attributes |= {"gainprm": kp, "biastype": "affine", "biasprm": bias}
    return Actuator(attributes, joint.path, drive.order, drive.target * gear)


def write_actuators(writer: attr.StageWriter, actuators: list[int]) -> None:
    """Write actuators, by MuJoCo's indices, as prims; say which are left out."""
    model = writer.model
    for actuator in actuators:
        name, kind = model.actuator(actuator).name, int(model.actuator_trntype[actuator])
        ends = _ends(writer, actuator, kind)
        if ends is None or model.actuator_plugin[actuator] >= 0:
            label = f'actuator "{name}"' if name else f"unnamed actuator {actuator}"
            reason = "a plugin" if ends else "on what USD has no prim for (a free joint)"
            writer.unsupported.append(f"{writer.file}: {label} is {reason}: left out")
            continue
        prim = writer.define("MjcActuator", name or "actuator", name)
        attr.set_custom(prim, "order", actuator)
        for relationship, target in ends.items():
            prim.CreateRelationship(f"mjc:{relationship}", custom=False).SetTargets([target])
        attr.set_sources(prim, attr.ACTUATOR, model, actuator)
        if kind == TRN["SLIDERCRANK"]:
            attr.author(prim, "mjc:crankLength", float(model.actuator_cranklength[actuator]))
        if kind == TRN["JOINTINPARENT"]:
            attr.author(prim, "mjc:jointInParent", True)
        if model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_USER:
            attr.author(prim, "mjc:actDim", int(model.actuator_actnum[actuator]))
        if samples := int(model.actuator_history[actuator, 0]):
            attr.set_custom(prim, "nsample", samples)


def _ends(writer: attr.StageWriter, actuator: int, kind: int) -> dict[str, str] | None:
    """Return what an actuator acts on, by the relationships' names; None if there is no prim for it."""
    model, (first, second) = writer.model, writer.model.actuator_trnid[actuator].tolist()
    if kind in (TRN["JOINT"], TRN["JOINTINPARENT"]):
        is_there = first in writer.joints and model.jnt_type[first] != attr.FREE
        return {"target": str(writer.joints[first].GetPath())} if is_there else None
    if kind == TRN["SITE"]:
        reference = {"refSite": writer.sites[second]} if second >= 0 else {}
        return {"target": writer.sites[first], **reference}
    if kind == TRN["SLIDERCRANK"]:
        return {"target": writer.sites[first], "sliderSite": writer.sites[second]}
    paths = {TRN["TENDON"]: writer.tendons, TRN["BODY"]: writer.bodies}.get(kind, {})
    return {"target": paths[first]} if first in paths else None


def read_tendons(stage: Stage, tendon: ET.Element, names: Names) -> None:
    """Add all tendons to their element, and their names to the others."""
    prims = [prim for prim in stage.prims if prim.GetTypeName() == "MjcTendon"]
    prim_names = unique_names(stage, prims)
    for prim in prims:
        element = _tendon(stage, prim, names)
        if element is None:
            stage.drop("tendons were dropped whose path names no joint, site or geom of the model", prim)
            continue
        names.tendons[str(prim.GetPath())] = prim_names[str(prim.GetPath())]
        element.set("name", prim_names[str(prim.GetPath())])
        tendon.append(element)


def _tendon(stage: Stage, prim: Prim, names: Names) -> ET.Element | None:
    is_fixed = str(stage.value(prim, "mjc:type")) == "fixed"
    attributes = attr.with_limits(stage, attr.read_attributes(stage, prim, attr.TENDON), ("", "actuatorfrc"))
    drawn = attr.read_attributes(stage, prim, attr.DRAWN)  # a fixed one is not drawn
    attributes |= {} if is_fixed else drawn
    targets = stage.targets(prim, "mjc:path")
    order = _array(stage, prim, "path:indices") or list(range(len(targets)))
    if not order or max(order) >= len(targets) or min(order) < 0:
        raise stage.error(prim, f"mjc:path:indices is {order}; mjc:path has {len(targets)} targets")
    path = [targets[index] for index in order]
    if not is_fixed:
        return _spatial(stage, prim, names, ET.Element("spatial", attributes), path)
    coefficients = _array(stage, prim, "path:coef") or [1.0] * len(path)
    if len(coefficients) != len(path):
        raise stage.error(prim, f"mjc:path:coef has {len(coefficients)} numbers; the path has {len(path)} joints")
    element = ET.Element("fixed", attributes)
    for target, coefficient in zip(path, coefficients, strict=True):
        ET.SubElement(element, "joint", joint=names.scalars.get(target, ""), coef=repr(float(coefficient)))
    return element if all(target in names.scalars for target in path) else None


def _array(stage: Stage, prim: Prim, name: str) -> list[Any]:
    return list(stage.authored(prim, f"mjc:{name}") or ())


def _spatial(stage: Stage, prim: Prim, names: Names, element: ET.Element, path: list[str]) -> ET.Element | None:
    """Add the sites, geoms and pulleys of a spatial tendon; return it if all are there, side sites included."""
    segments, divisors = _array(stage, prim, "path:segments") or [0] * len(path), _array(stage, prim, "path:divisors")
    beside = _array(stage, prim, "sideSites:indices") or [-1] * len(path)
    sides = stage.targets(prim, "mjc:sideSites")
    for name, values in (("path:segments", segments), ("sideSites:indices", beside)):
        if len(values) != len(path):
            raise stage.error(prim, f"mjc:{name} has {len(values)} numbers; the path has {len(path)} points")
    if max(segments) >= max(len(divisors), 1) or max(beside) >= len(sides):
        raise stage.error(prim, "mjc:path:divisors or mjc:sideSites has fewer entries than the path names")
    divisors, previous = divisors or [1.0], None
    for target, segment, side in zip(path, segments, beside, strict=True):
        if segment != previous and (previous is not None or divisors[segment] != 1.0):
            ET.SubElement(element, "pulley", divisor=repr(float(divisors[segment])))
        previous = segment
        if target in names.sites:
            ET.SubElement(element, "site", site=names.sites[target])
            continue
        if target not in names.geoms or (side >= 0 and sides[side] not in names.sites):
            return None
        wrapped = ET.SubElement(element, "geom", geom=names.geoms[target])
        if side >= 0:
            wrapped.set("sidesite", names.sites[sides[side]])
    return element


def write_tendons(writer: attr.StageWriter) -> None:
    """Write all tendons."""
    model, gf = writer.model, usd_modules().Gf
    for tendon in range(model.ntendon):
        name = model.tendon(tendon).name
        prim = writer.define("MjcTendon", name or "tendon", name)
        writer.tendons[tendon] = str(prim.GetPath())
        attr.set_sources(prim, {**attr.TENDON, **attr.DRAWN}, model, tendon)
        attr.author(prim, "mjc:rgba", gf.Vec4f(*model.tendon_rgba[tendon].tolist()), "Color4f")
        _write_path(writer, tendon, prim)


def _write_path(writer: attr.StageWriter, tendon: int, prim: Any) -> None:
    """Write what a tendon passes over: targets once each, then their order, segments between pulleys, and side sites."""
    model = writer.model
    start = int(model.tendon_adr[tendon])
    is_fixed = bool(model.wrap_type[start] == WRAP["JOINT"])
    targets, sides, indices, beside, segments, divisors, coefficients = [], [], [], [], [], [1.0], []
    for row in range(start, start + int(model.tendon_num[tendon])):
        kind, index, value = int(model.wrap_type[row]), int(model.wrap_objid[row]), float(model.wrap_prm[row])
        if kind == WRAP["PULLEY"]:
            divisors = [value] if row == start else [*divisors, value]
            continue
        if is_fixed:
            path = str(writer.joints[index].GetPath())
            coefficients.append(value)
        else:
            path = writer.sites[index] if kind == WRAP["SITE"] else writer.geoms[index]
        targets += [] if path in targets else [path]
        indices.append(targets.index(path))
        segments.append(len(divisors) - 1)
        side = writer.sites[int(value)] if kind in (WRAP["SPHERE"], WRAP["CYLINDER"]) and value >= 0 else ""
        sides += [side] if side and side not in sides else []
        beside.append(sides.index(side) if side else -1)
    prim.CreateRelationship("mjc:path", custom=False).SetTargets(targets)
    attr.author(prim, "mjc:type", "fixed" if is_fixed else "spatial")
    attr.author(prim, "mjc:path:indices", indices)
    if is_fixed:
        attr.author(prim, "mjc:path:coef", coefficients)
        return
    attr.author(prim, "mjc:path:segments", segments)
    attr.author(prim, "mjc:path:divisors", divisors)
    if sides:
        prim.CreateRelationship("mjc:sideSites", custom=False).SetTargets(sides)
        attr.author(prim, "mjc:sideSites:indices", beside)


def read_keyframes(stage: Stage, root: ET.Element, keyframe: ET.Element) -> None:
    """Add all keyframes whose vectors fit the model; they are assumed to use MuJoCo's order of joints and actuators."""
    prims = [prim for prim in stage.prims if prim.GetTypeName() == "MjcKeyframe"]
    if not prims:
        return
    model = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    sizes = {"qpos": model.nq, "qvel": model.nv, "act": model.na, "ctrl": model.nu}
    sizes |= {"mpos": 3 * model.nmocap, "mquat": 4 * model.nmocap, "time": 1}
    names = unique_names(stage, prims)
    for key in [key for key in keyframe if key.get("name") in names.values()]:
        keyframe.remove(key)  # the stage's keyframe overrules the one derived from its poses
    for prim in prims:
        attributes = {name: value for name, value in attr.read_attributes(stage, prim, attr.KEY).items() if value}
        wrong = [name for name, value in attributes.items() if len(value.split()) != sizes[name]]
        if wrong:
            stage.drop(f"keyframes were dropped whose {', '.join(wrong)} is not of the model's size", prim)
            continue
        ET.SubElement(keyframe, "key", {"name": names[str(prim.GetPath())]} | attributes)


def write_keyframes(writer: attr.StageWriter) -> None:
    for key in range(writer.model.nkey):
        name = writer.model.key(key).name
        attr.set_sources(writer.define("MjcKeyframe", name or "keyframe", name), attr.KEY, writer.model, key)

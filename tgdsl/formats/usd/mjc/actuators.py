"""Actuators of a USD stage that are prims: MjcActuator, whose attributes are MJCF's, and NewtonActuator with a PD control."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from tgdsl.formats.usd.custom_attributes import read_custom, text_of
from tgdsl.formats.usd.mjc.attributes import Source, SourceTable, mjc, read_attributes, with_limits
from tgdsl.formats.usd.stage import Prim, Stage, unique_names

MJC_ACTUATOR, NEWTON_ACTUATOR = "MjcActuator", "NewtonActuator"
"""Types of the prims."""
LIMITS = ("act", "ctrl", "force")
TOO_MANY = "targets of actuators after the first one were dropped"
OWN = ("delay", "nsample", "armature", "damping")
"""Attributes that MjcPhysics does not have."""
ACTUATOR: SourceTable = {
    **{name.lower(): mjc(name) for name in ("actDim", "actEarly", "biasPrm", "biasType", "crankLength", "dynPrm", "dynType")},
    **{name.lower(): mjc(name) for name in ("gainPrm", "gainType", "gear", "group", "inheritRange")},
    **{f"{name}limited": mjc(f"{name}Limited") for name in LIMITS},
    **{f"{name}range": mjc(f"{name}Range", is_range=True) for name in (*LIMITS, "length")},
    **dict.fromkeys(OWN, ()),
}
SERVO: SourceTable = {
    "kp": (Source("newton:kp", "inertia"),),
    "kd": (Source("newton:kd", "inertia"),),
    "constant": (Source("newton:constEffort", "effort"),),
    "most": (Source("newton:maxEffort", "effort", neutral=math.inf),),
}
"""Of a NewtonActuator, whose gains are per radian: kg·m² or kg of the stage, over s² or s, as an inertia is."""


@dataclass(frozen=True)
class Named:
    """Names in MJCF of what an actuator or tendon may act on, by the paths of the prims."""

    joints: Mapping[str, str]
    bodies: Mapping[str, str]
    sites: Mapping[str, str]
    geoms: Mapping[str, str]
    tendons: Mapping[str, str]


@dataclass(frozen=True)
class Actuator:
    """An actuator of MJCF.

    Attributes:
        attributes: Of the element.
        joint: Path of the joint that it acts on, or empty.
        order: Place among those that say so; the others come after them.
        control: At the keyframe `authored`.
        kind: Which element it is.
    """

    attributes: dict[str, str]
    joint: str
    order: float
    control: float = 0.0
    kind: str = "general"


def read_actuators(stage: Stage, named: Named) -> list[Actuator]:
    """Read all actuators that are prims, in stage order.

    Args:
        stage: The stage.
        named: What they may act on; joints that are not in the tree are not there.
    """
    prims = [prim for prim in stage.prims if prim.GetTypeName() in (MJC_ACTUATOR, NEWTON_ACTUATOR)]
    names = unique_names(stage, prims)
    results: list[Actuator] = []
    for prim in sorted(prims, key=lambda prim: prim.GetTypeName() != MJC_ACTUATOR):
        read = _mjc_actuator if prim.GetTypeName() == MJC_ACTUATOR else _newton_actuator
        actuator = read(stage, prim, named, names[str(prim.GetPath())])
        if actuator is None:
            continue
        if read is _newton_actuator and actuator.joint in [other.joint for other in results]:
            stage.drop("NewtonActuators were dropped whose joint has an MjcActuator", prim)
            continue
        results.append(actuator)
    return results


def _mjc_actuator(stage: Stage, prim: Prim, named: Named, name: str) -> Actuator | None:
    targets, slider, reference = (
        [str(path) for path in stage.targets(prim, f"mjc:{kind}")] for kind in ("target", "sliderSite", "refSite")
    )
    is_in_parent, order = bool(stage.authored(prim, "mjc:jointInParent")), read_custom(stage, prim, "order")
    attributes = with_limits(stage, read_attributes(stage, prim, ACTUATOR), LIMITS)
    target = targets[0] if targets else ""
    kinds = {
        "jointinparent" if is_in_parent else "joint": named.joints,
        "cranksite" if slider else "site": named.sites,
        "tendon": named.tendons,
        "body": named.bodies,
    }
    ends = {kind: names[target] for kind, names in kinds.items() if target in names}
    if not ends or any(path not in named.sites for path in (*slider, *reference)):
        stage.drop("actuators were dropped whose target is no joint, site, tendon or body of the model", prim)
        return None
    ends |= {"slidersite": named.sites[slider[0]]} if slider else {}
    ends |= {"refsite": named.sites[reference[0]]} if reference else {}
    if max(map(len, (targets, slider, reference))) > 1:
        stage.drop(TOO_MANY, prim)
    if not slider and float(attributes.pop("cranklength", 0.0)):
        stage.drop("mjc:crankLength was dropped of actuators without mjc:sliderSite", prim)
    joint = target if target in named.joints else ""
    return Actuator({"name": name} | ends | attributes, joint, math.inf if order is None else float(order))


def _newton_actuator(stage: Stage, prim: Prim, named: Named, name: str) -> Actuator | None:
    """Return effort = constant + kp (target - q) - kd v as an actuator; without kp the control is the target velocity."""
    targets = [str(path) for path in stage.targets(prim, "newton:targets")]
    if not targets or targets[0] not in named.joints:
        stage.drop("actuators were dropped whose target is no joint, site, tendon or body of the model", prim)
        return None
    if len(targets) > 1:
        stage.drop(TOO_MANY, prim)
    is_angular = stage.usd.GetPrimAtPath(targets[0]).GetTypeName() != "PhysicsPrismaticJoint"
    values = {key: float(value) for key, value in read_attributes(stage, prim, SERVO, is_angular).items()}
    kp, kd, constant = (values.get(key, 0.0) for key in ("kp", "kd", "constant"))
    if not (stage.has(prim, "NewtonPDControlAPI") or stage.has(prim, "NewtonPIDControlAPI")) or not (kp or kd):
        stage.drop("NewtonActuators were dropped that are no PD control with gains", prim)
        return None
    attributes = {"name": name, "joint": named.joints[targets[0]], "biastype": "affine", "gainprm": repr(kp or kd)}
    attributes["biasprm"] = text_of([constant, 0.0 - kp, 0.0 - kd])
    if "most" in values:
        attributes["forcerange"] = text_of([-values["most"], values["most"]])
    return Actuator(attributes, targets[0], math.inf)

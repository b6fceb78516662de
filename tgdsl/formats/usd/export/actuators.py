"""Actuators that USD has no drive for, tendons and keyframes, as prims of the schema MjcPhysics.

Names and types of attributes are those of MjcPhysics (mujoco-usd-converter 0.8); what it does not have is `tgdsl:`.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from tgdsl.formats.usd.export.joints import FREE
from tgdsl.formats.usd.export.stage_writer import StageWriter, set_custom
from tgdsl.formats.usd.stage import usd_modules

TRN = {name.removeprefix("mjTRN_"): int(value) for name, value in mujoco.mjtTrn.__members__.items()}
ENUMS = {"dynType": mujoco.mjtDyn, "gainType": mujoco.mjtGain, "biasType": mujoco.mjtBias}
WRAP = {name.removeprefix("mjWRAP_"): int(value) for name, value in mujoco.mjtWrap.__members__.items()}
TENDON = {
    **{name: name for name in ("armature", "damping", "frictionloss", "stiffness", "margin")},
    "springlength": "lengthspring",
    "group": "group",
    "width": "width",
    "solreflimit": "solref_lim",
    "solimplimit": "solimp_lim",
    "solreffriction": "solref_fri",
    "solimpfriction": "solimp_fri",
}
"""MjcTendon's attributes by the arrays `tendon_` of MuJoCo's model."""
KEY = ("qpos", "qvel", "act", "ctrl", "mpos", "mquat")


def add_actuators(
    writer: StageWriter, actuators: list[int], scope: str, joints: dict[int, Any], tendons: dict[int, str]
) -> None:
    """Write actuators as prims; say which are left out.

    Args:
        writer: Where to write them.
        actuators: MuJoCo's indices.
        scope: Path of the scope that holds them.
        joints: The schema of each joint that can move, by MuJoCo's index.
        tendons: Path of each tendon's prim, by MuJoCo's index.
    """
    model = writer.model
    for actuator in actuators:
        name = model.actuator(actuator).name
        ends = _ends(writer, actuator, joints, tendons)
        if ends is None or model.actuator_plugin[actuator] >= 0:
            shown = f'actuator "{name}"' if name else f"unnamed actuator {actuator}"
            what = "a plugin" if ends else "on what USD has no prim for (a free joint)"
            writer.unsupported.append(f"{writer.file}: {shown} is {what}: left out")
            continue
        prim = writer.stage.DefinePrim(writer.path(scope, name or "actuator"), "MjcActuator")
        set_custom(prim, "name", name)
        set_custom(prim, "order", actuator)
        for relationship, target in ends.items():
            prim.CreateRelationship(f"mjc:{relationship}", custom=False).SetTargets([target])
        _parameters(model, actuator, prim)


def _ends(writer: StageWriter, actuator: int, joints: dict[int, Any], tendons: dict[int, str]) -> dict[str, str] | None:
    """Return what an actuator acts on, by the relationships' names; None if there is no prim for it."""
    model = writer.model
    kind, (first, second) = int(model.actuator_trntype[actuator]), model.actuator_trnid[actuator].tolist()
    if kind in (TRN["JOINT"], TRN["JOINTINPARENT"]):
        is_there = first in joints and model.jnt_type[first] != FREE
        return {"target": str(joints[first].GetPath())} if is_there else None
    if kind == TRN["SITE"]:
        reference = {"refSite": writer.sites[second]} if second >= 0 else {}
        return {"target": writer.sites[first], **reference}
    if kind == TRN["SLIDERCRANK"]:
        return {"target": writer.sites[first], "sliderSite": writer.sites[second]}
    paths = {TRN["TENDON"]: tendons, TRN["BODY"]: writer.bodies}.get(kind, {})
    return {"target": paths[first]} if first in paths else None


def _parameters(model: mujoco.MjModel, actuator: int, prim: Any) -> None:
    for name, enum in ENUMS.items():
        value = int(getattr(model, f"actuator_{name.lower()}")[actuator])
        _set(prim, name, enum(value).name.rpartition("_")[2].lower())
    for name in ("dynPrm", "gainPrm", "biasPrm", "gear"):
        _set(prim, name, getattr(model, f"actuator_{name.lower()}")[actuator].tolist())
    for name in ("act", "ctrl", "force"):
        is_limited = bool(getattr(model, f"actuator_{name}limited")[actuator])
        _set(prim, f"{name}Limited", "true" if is_limited else "false")
        if is_limited:
            _set_range(prim, f"{name}Range", getattr(model, f"actuator_{name}range")[actuator])
    if model.actuator_lengthrange[actuator].any():
        _set_range(prim, "lengthRange", model.actuator_lengthrange[actuator])
    if model.actuator_trntype[actuator] == TRN["SLIDERCRANK"]:
        _set(prim, "crankLength", float(model.actuator_cranklength[actuator]))
    if model.actuator_trntype[actuator] == TRN["JOINTINPARENT"]:
        _set(prim, "jointInParent", True)
    if model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_USER:
        _set(prim, "actDim", int(model.actuator_actnum[actuator]))
    _set(prim, "actEarly", bool(model.actuator_actearly[actuator]))
    _set(prim, "group", int(model.actuator_group[actuator]))
    for name in ("delay", "armature", "damping"):
        if value := float(getattr(model, f"actuator_{name}")[actuator]):
            set_custom(prim, name, value)
    if samples := int(model.actuator_history[actuator, 0]):
        set_custom(prim, "nsample", samples)


def add_tendons(writer: StageWriter, scope: str, joints: dict[int, Any]) -> dict[int, str]:
    """Write all tendons; return the paths of their prims by MuJoCo's index.

    Args:
        writer: Where to write them.
        scope: Path of the scope that holds them.
        joints: The schema of each joint that can move, by MuJoCo's index.
    """
    model, result = writer.model, {}
    for tendon in range(model.ntendon):
        name = model.tendon(tendon).name
        prim = writer.stage.DefinePrim(writer.path(scope, name or "tendon"), "MjcTendon")
        result[tendon] = str(prim.GetPath())
        set_custom(prim, "name", name)
        for attribute, array in TENDON.items():
            value = getattr(model, f"tendon_{array}")[tendon].tolist()
            _set(prim, attribute, value)
        prim.CreateAttribute("mjc:rgba", usd_modules().Sdf.ValueTypeNames.Color4f, custom=False).Set(
            usd_modules().Gf.Vec4f(*model.tendon_rgba[tendon].tolist())
        )
        for limited, values in (("limited", "range"), ("actfrclimited", "actfrcrange")):
            is_limited = bool(getattr(model, f"tendon_{limited}")[tendon])
            own = {"actfrclimited": "actuatorfrclimited"}.get(limited, limited)
            _set(prim, own, "true" if is_limited else "false")
            if is_limited:
                _set_range(prim, own.replace("limited", "range"), getattr(model, f"tendon_{values}")[tendon])
        _path(writer, tendon, prim, joints)
    return result


def _path(writer: StageWriter, tendon: int, prim: Any, joints: dict[int, Any]) -> None:
    """Write what a tendon passes over: targets once each, then their order, segments between pulleys, and side sites."""
    model = writer.model
    start = int(model.tendon_adr[tendon])
    rows = range(start, start + int(model.tendon_num[tendon]))
    is_fixed = bool(model.wrap_type[start] == WRAP["JOINT"])
    targets, sides, indices, beside, segments, divisors, coefficients = [], [], [], [], [], [1.0], []
    for row in rows:
        kind, index, value = int(model.wrap_type[row]), int(model.wrap_objid[row]), float(model.wrap_prm[row])
        if kind == WRAP["PULLEY"]:
            divisors = [value] if row == start else [*divisors, value]
            continue
        if is_fixed:
            path = str(joints[index].GetPath())
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
    _set(prim, "type", "fixed" if is_fixed else "spatial")
    _set(prim, "path:indices", np.array(indices))
    if is_fixed:
        _set(prim, "path:coef", coefficients)
        return
    _set(prim, "path:segments", np.array(segments))
    _set(prim, "path:divisors", divisors)
    if sides:
        prim.CreateRelationship("mjc:sideSites", custom=False).SetTargets(sides)
        _set(prim, "sideSites:indices", np.array(beside))


def add_keyframes(writer: StageWriter, scope: str) -> None:
    """Write all keyframes, their vectors in MuJoCo's order."""
    model = writer.model
    for key in range(model.nkey):
        name = model.key(key).name
        prim = writer.stage.DefinePrim(writer.path(scope, name or "keyframe"), "MjcKeyframe")
        set_custom(prim, "name", name)
        if model.key_time[key]:
            set_custom(prim, "time", float(model.key_time[key]))
        for attribute in KEY:
            if values := getattr(model, f"key_{attribute}")[key].ravel().tolist():
                _set(prim, attribute, values)


def _set_range(prim: Any, name: str, values: np.ndarray) -> None:
    for end, value in zip(("min", "max"), values.tolist(), strict=True):
        _set(prim, f"{name}:{end}", value)


def _set(prim: Any, name: str, value: str | bool | int | float | list[float] | np.ndarray) -> None:
    """Set an attribute `mjc:`; an array is of integers."""
    types = usd_modules().Sdf.ValueTypeNames
    kinds = {str: types.Token, bool: types.Bool, int: types.Int, float: types.Double, list: types.DoubleArray}
    kinds[np.ndarray] = types.IntArray
    prim.CreateAttribute(f"mjc:{name}", kinds[type(value)], custom=False).Set(
        usd_modules().Vt.IntArray(value.tolist()) if isinstance(value, np.ndarray) else value
    )

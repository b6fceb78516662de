"""Keyframes of a USD stage (MjcKeyframe) as MJCF's."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import mujoco

from tgdsl.formats.usd.mjc.attributes import SourceTable, mjc, read_attributes
from tgdsl.formats.usd.stage import Stage, unique_names

KEY: SourceTable = {"time": (), **{name: mjc(name) for name in ("qpos", "qvel", "act", "ctrl", "mpos", "mquat")}}


def add_keyframes(stage: Stage, root: ET.Element, keyframe: ET.Element) -> None:
    """Add all keyframes whose vectors fit the model; MuJoCo's order of joints and actuators is taken to be theirs.

    Args:
        stage: The stage.
        root: The whole model, without any keyframe that does not fit.
        keyframe: Where keyframes go.
    """
    prims = [prim for prim in stage.prims if prim.GetTypeName() == "MjcKeyframe"]
    if not prims:
        return
    model = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    sizes = {"qpos": model.nq, "qvel": model.nv, "act": model.na, "ctrl": model.nu}
    sizes |= {"mpos": 3 * model.nmocap, "mquat": 4 * model.nmocap, "time": 1}
    names = unique_names(stage, prims)
    for key in [key for key in keyframe if key.get("name") in names.values()]:
        keyframe.remove(key)  # the stage's own overrules what was made of its poses
    for prim in prims:
        attributes = read_attributes(stage, prim, KEY)
        attributes = {name: value for name, value in attributes.items() if value}
        wrong = [name for name, value in attributes.items() if len(value.split()) != sizes[name]]
        if wrong:
            stage.drop(f"keyframes were dropped whose {', '.join(wrong)} is not of the model's size", prim)
            continue
        ET.SubElement(keyframe, "key", {"name": names[str(prim.GetPath())]} | attributes)

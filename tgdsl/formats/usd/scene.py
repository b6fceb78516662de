"""The physics scene of a USD stage: gravity, time step and the solver's settings, as MJCF's `option` and `compiler`.

Without a time step, MuJoCo's own is used; but where the scene names NewtonSceneAPI itself, that schema's 1000 steps a second:
writers leave out what is the schema's default.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

import numpy as np

from tgdsl.formats.usd.attributes import (
    COMPILER,
    FLAG,
    FLAGS,
    OPTION,
    read_attributes,
    read_custom,
    text_of,
)
from tgdsl.formats.usd.stage import Prim, Stage

GRAVITY = 9.81  # what a stage's scene means by earth gravity [m/s²]
NEWTON_TIMESTEP = 0.001  # NewtonSceneAPI's default [s]


def add_scene(stage: Stage, option: ET.Element, compiler: ET.Element) -> dict[str, str]:
    """Set gravity and the solver's settings as the first scene has them; return its flags."""
    for scene in stage.scenes[1:]:
        stage.drop("physics scenes after the first one were dropped", scene)
    if not stage.scenes:
        return {}
    scene = stage.scenes[0]
    option.attrib |= {"gravity": _gravity(stage, scene), **read_attributes(stage, scene, OPTION)}
    if "timestep" not in option.attrib and "NewtonSceneAPI" in scene.GetPrimTypeInfo().GetAppliedAPISchemas():
        option.set("timestep", text_of(NEWTON_TIMESTEP))
    compiler.attrib |= read_attributes(stage, scene, COMPILER)
    _note_compiler(stage, scene)
    return _flags(stage, scene)


def _flags(stage: Stage, scene: Prim) -> dict[str, str]:
    flags = {str(name): key for key in FLAGS for name in read_custom(stage, scene, key) or ()}
    for name, value in read_attributes(stage, scene, FLAG).items():
        said = "enable" if value == "true" else "disable"
        if flags.setdefault(name, said) != said:
            stage.drop(f"mjc:flag:{name} was dropped, which contradicts tgdsl:{flags[name]}", scene)
    return flags


def _note_compiler(stage: Stage, scene: Prim) -> None:
    """Take note of settings of MuJoCo's compiler that the reader of the stage has done, or cannot do."""
    if stage.authored(scene, "mjc:compiler:inertiaFromGeom") == "true":
        stage.drop("mjc:compiler:inertiaFromGeom is true; masses are those that bodies and colliders state", scene)
    ends = [stage.authored(scene, f"mjc:compiler:inertiaGroupRange:{end}") for end in ("min", "max")]
    if (ends[0] or 0) > 0 or (ends[1] is not None and ends[1] < 5):
        stage.drop("mjc:compiler:inertiaGroupRange was dropped: all colliders have a mass, in whatever group", scene)
    stage.note(scene, "mjc:compiler:angle", "mjc:compiler:autoLimits")  # read where they matter


def _gravity(stage: Stage, scene: Prim) -> str:
    """Return gravity [m/s²]."""
    direction = np.array(stage.value(scene, "physics:gravityDirection"), dtype=np.float64)
    size = stage.number(scene, "physics:gravityMagnitude", -math.inf)
    size = GRAVITY if size < 0 else size * stage.metres_per_unit
    if not np.isfinite(direction).all() or not math.isfinite(size):
        raise stage.error(scene, "gravity is not finite")
    if not direction.any():
        return text_of([0.0, 0.0, -size])
    world = stage.world_from_stage[:3, :3] @ direction / stage.metres_per_unit / np.linalg.norm(direction) * size
    return text_of((world + 0.0).tolist())

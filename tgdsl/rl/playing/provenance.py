"""What a policy was learned with, as its card has it, and how that differs from what there is now."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import mujoco
import numpy as np
from pydantic import ValidationError

from tgdsl.rl.load import LoadedTask
from tgdsl.rl.sensed import sensors_document
from tgdsl.rl.spec import TaskSpec

ELSEWHERE = {"tgdsl", "robot", "scene", "resolution", "observations"}
"""What of a sensors' document is compared by joints, taxels and scene, and what the task's document says."""
SCENE = {
    "gravity": ("opt.gravity",),
    "bodies": ("body_mass", "body_inertia", "body_ipos", "body_pos", "body_quat"),
    "geoms": ("geom_type", "geom_size", "geom_pos", "geom_quat", "geom_contype", "geom_conaffinity", "geom_friction"),
    "joints": (
        "jnt_type",
        "jnt_pos",
        "jnt_axis",
        "jnt_range",
        "jnt_stiffness",
        "dof_damping",
        "dof_armature",
        "dof_frictionloss",
    ),
    "actuators": ("actuator_gainprm", "actuator_biasprm", "actuator_ctrlrange", "actuator_forcerange"),
}
"""Arrays of MuJoCo's model by what they are of."""
LEAST = 1e-12  # what counts as 0, in the array's unit: rounding differs between machines


def provenance(loaded: LoadedTask, model: mujoco.MjModel) -> dict[str, Any]:
    """Return what a card says of sensors and scene, as plain values."""
    spec = sensors_document(loaded).spec
    return {
        "sensors": spec.model_dump(mode="json", exclude=ELSEWHERE),
        "scene": {part: _digest(model, names) for part, names in SCENE.items()},
    }


def changes_around(card: Mapping[str, Any], loaded: LoadedTask, model: mujoco.MjModel) -> list[str]:
    """Return what of sensors and scene is otherwise than where a policy was learned, a line each; nothing of older cards."""
    if "sensors" not in card:
        return []
    now, scene = provenance(loaded, model), card["scene"]
    lines = differences(card["sensors"], _known(card["sensors"], now["sensors"]))
    results = [f"{loaded.spec.document}: {line}" for line in lines]
    return results + [f"the scene's {part}" for part, digest in now["scene"].items() if scene.get(part, digest) != digest]


def _known(before: Any, now: Any) -> Any:
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return now
    return {name: _known(before[name], value) for name, value in now.items() if name in before}


def _digest(model: mujoco.MjModel, names: tuple[str, ...]) -> str:
    """Return a hash of arrays to five digits, within which machines and versions of MuJoCo agree."""
    result = hashlib.sha256()
    for name in names:
        array: Any = model
        for part in name.split("."):
            array = getattr(array, part)
        values = np.asarray(array, dtype=np.float64)
        rounded = np.where(np.abs(values) < LEAST, 0.0, values) + 0.0
        result.update(f"{name} {values.shape} {' '.join(f'{value:.4e}' for value in rounded.flat)}\n".encode())
    return result.hexdigest()[:16]


def differences(before: Any, now: Any, path: str = "") -> list[str]:
    """Return how two plain values differ, a line each: `rewards.spin: 2.0, now 3.0`."""
    if isinstance(before, dict) and isinstance(now, dict):
        names = dict.fromkeys((*before, *now))
        return [line for name in names for line in differences(before.get(name), now.get(name), f"{path}.{name}".lstrip("."))]
    return [] if is_close(before, now) else [f"{path}: {json.dumps(before)}, now {json.dumps(now)}"]


def is_close(one: Any, other: Any) -> bool:
    """Return whether plain values are equal, numbers but for rounding: 0.7 cm are not quite 7 mm."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(is_close(value, other[name]) for name, value in one.items())
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(is_close, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=1e-9)
    return one == other


def spec_differences(
    before: Mapping[str, Any], now: Mapping[str, Any], model: type[TaskSpec], leave_out: tuple[str, ...] = ()
) -> list[str]:
    """Return how two documents differ."""
    with suppress(ValidationError):  # of a version with other names: its values stand as they are
        before = model.model_validate(before).model_dump(mode="json")
    left, other = ({name: value for name, value in spec.items() if name not in leave_out} for spec in (before, now))
    return differences(left, other)

"""What a policy was learned with, besides its task's document: the sensors' document and the scene, as its card has them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from tgdsl.rl.load import LoadedTask
from tgdsl.rl.playing.differences import differences
from tgdsl.rl.sensed import sensors_document

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
LEAST = 1e-12
"""What counts as 0, in the array's unit: rounding differs between machines."""


def provenance(loaded: LoadedTask, model: mujoco.MjModel) -> dict[str, Any]:
    """Return what a card says of sensors and scene, as plain values.

    Args:
        loaded: The task's document.
        model: MuJoCo's model of its scene.
    """
    spec = sensors_document(loaded).spec
    return {
        "sensors": spec.model_dump(mode="json", exclude=ELSEWHERE),
        "scene": {part: _digest(model, names) for part, names in SCENE.items()},
    }


def changes_around(card: Mapping[str, Any], loaded: LoadedTask, model: mujoco.MjModel) -> list[str]:
    """Return what of sensors and scene is otherwise than where a policy was learned, a line each; nothing of older cards.

    Args:
        card: The policy's card.
        loaded: The task's document.
        model: MuJoCo's model of its scene.
    """
    if "sensors" not in card:
        return []
    now, scene = provenance(loaded, model), card["scene"]
    lines = differences(card["sensors"], _known(card["sensors"], now["sensors"]))
    results = [f"{loaded.spec.document}: {line}" for line in lines]
    return results + [f"the scene's {part}" for part, digest in now["scene"].items() if scene.get(part, digest) != digest]


def _known(before: Any, now: Any) -> Any:
    """Return what there was before: neither sensors that are new, nor fields that its version of tgdsl did not know."""
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

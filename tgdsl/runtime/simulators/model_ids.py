"""Where the named elements of a model stand: bodies, sites, geoms, joints, actuators, keyframes, sensors."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Int

from tgdsl.errors import SimulationError, did_you_mean
from tgdsl.runtime.by_name import Geoms, index_of

_ELEMENTS = {
    "body": ("nbody", "body", "bodies"),
    "site": ("nsite", "site", "sites"),
    "geom": ("ngeom", "geom", "geoms"),
    "joint": ("njnt", "joint", "joints"),
    "actuator": ("nu", "actuator", "actuators"),
    "key": ("nkey", "keyframe", "keyframes"),
    "sensor": ("nsensor", "sensor", "sensors"),
}
"""By MuJoCo's accessor: where the model counts them, and what one and several are called."""


def element_id(model: mujoco.MjModel, kind: str, name: str) -> int:
    """Return the index of an element by name, or by the end of its name after a slash if just one ends so.

    `kind` is MuJoCo's accessor: "body", "site", "geom", "joint", "actuator", "key" or "sensor".

    Raises:
        SimulationError: If there is none of that name, or several names end in it.
    """
    element = getattr(model, kind)
    try:
        return int(element(name).id)
    except KeyError:
        count, one, several = _ELEMENTS[kind]
        return index_of(name, [element(i).name for i in range(getattr(model, count))], one, several)


def keyframe_id(model: mujoco.MjModel, name: str | None) -> int:
    """Return the index of a keyframe; without a name −1, the model's own initial state."""
    return -1 if name is None else element_id(model, "key", name)


def model_geoms(model: mujoco.MjModel) -> Geoms:
    """Return the names of a model's geoms, and of their bodies."""
    bodies = [model.body(i).name or f"#{i}" for i in range(model.nbody)]
    parents = tuple((bodies[i], bodies[model.body_parentid[i]]) for i in range(1, model.nbody))
    return Geoms(tuple(bodies[i] for i in model.geom_bodyid), tuple(model.geom(i).name for i in range(model.ngeom)), parents)


def geoms_of(model: mujoco.MjModel, body: int, with_below: bool) -> Int[np.ndarray, " geom"]:
    """Return the indices of the geoms of a body, and of all bodies below it if wanted."""
    bodies = [body]
    for i in range(body + 1, model.nbody if with_below else 0):
        bodies += [i] if model.body_parentid[i] in bodies else []
    return np.flatnonzero(np.isin(model.geom_bodyid, bodies))


class Joint(NamedTuple):
    """Where one joint stands.

    Attributes:
        qpos: Its part of `qpos`: of a free joint 7 numbers, position [m] and quaternion w, x, y, z; of a ball 4, else 1.
        qvel: Its part of `qvel`: of a free joint 6 numbers, velocity [m/s] in the world and angular velocity [rad/s] in the
            body's frame; of a ball 3, else 1.
    """

    qpos: slice
    qvel: slice


class Joints(dict[str, Joint]):
    """Joints by name, in the model's order. One without a name goes by its body's, if the body has no other."""

    def __init__(self, model: mujoco.MjModel):
        super().__init__()
        named = {model.joint(i).name for i in range(model.njnt)}
        for i in range(model.njnt):
            joint, body = model.joint(i), model.body(model.jnt_bodyid[i])
            is_sole = int(body.jntnum[0]) == 1 and body.name not in named
            if name := joint.name or (body.name if is_sole else ""):
                qpos, qvel = int(joint.qposadr[0]), int(joint.dofadr[0])
                self[name] = Joint(slice(qpos, qpos + len(joint.qpos0)), slice(qvel, qvel + len(joint.jntid)))

    def __missing__(self, name: str) -> Joint:
        raise SimulationError(f'the scene has no joint "{name}"; {did_you_mean(name, self, "joints")}')

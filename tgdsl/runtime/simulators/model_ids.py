"""Where in a model stands what a module wants: bodies, sites, geoms, keyframes."""

from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Int

from tgdsl.errors import SimulationError, did_you_mean
from tgdsl.plan.inputs import ContactPart


def body_id(model: mujoco.MjModel, name: str) -> int:
    """Return the index of a body.

    Raises:
        SimulationError: If there is none of that name.
    """
    try:
        return int(model.body(name).id)
    except KeyError as error:
        known = [model.body(i).name for i in range(model.nbody)]
        raise SimulationError(f'the scene has no body "{name}"; {did_you_mean(name, known, "bodies")}') from error


def site_id(model: mujoco.MjModel, name: str) -> int:
    """Return the index of a site.

    Raises:
        SimulationError: If there is none of that name.
    """
    try:
        return int(model.site(name).id)
    except KeyError as error:
        known = [model.site(i).name for i in range(model.nsite)]
        raise SimulationError(f'the scene has no site "{name}"; {did_you_mean(name, known, "sites")}') from error


def part_geoms(model: mujoco.MjModel, part: ContactPart) -> Int[np.ndarray, " geom"]:
    """Return the indices of the geoms of a part of an object or link.

    Raises:
        SimulationError: If there is no body or geom of that name.
    """
    if part.kind == "geom":
        try:
            return np.array([model.geom(part.name).id])
        except KeyError as error:
            known = [model.geom(i).name for i in range(model.ngeom)]
            raise SimulationError(f'the scene has no geom "{part.name}"; {did_you_mean(part.name, known, "geoms")}') from error
    return geoms_of(model, body_id(model, part.name), part.kind == "subtree")


def geoms_of(model: mujoco.MjModel, body: int, with_below: bool) -> Int[np.ndarray, " geom"]:
    """Return the indices of the geoms of a body, and of all bodies below it if wanted."""
    bodies = [body]
    for i in range(body + 1, model.nbody if with_below else 0):
        bodies += [i] if model.body_parentid[i] in bodies else []
    return np.flatnonzero(np.isin(model.geom_bodyid, bodies))


def keyframe_id(model: mujoco.MjModel, name: str | None) -> int:
    """Return the index of a keyframe; without a name −1, the model's own initial state.

    Raises:
        SimulationError: If there is none of that name.
    """
    if name is None:
        return -1
    try:
        return int(model.key(name).id)
    except KeyError as error:
        known = [model.key(i).name for i in range(model.nkey)]
        raise SimulationError(f'the scene has no keyframe "{name}"; {did_you_mean(name, known, "keyframes")}') from error

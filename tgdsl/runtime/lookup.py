"""Where in a model stands what a module wants: bodies, geoms, keyframes; and environments by index or mask."""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from tgdsl.errors import SimulationError, did_you_mean, listed
from tgdsl.plan import ContactPart
from tgdsl.runtime.source import EnvIds


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


def part_geoms(model: mujoco.MjModel, part: ContactPart) -> Int[np.ndarray, " geom"]:
    """Return the indices of the geoms of an object's part.

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


def keyframe_id(model: mujoco.MjModel, name: str) -> int:
    """Return the index of a keyframe.

    Raises:
        SimulationError: If there is none of that name.
    """
    try:
        return int(model.key(name).id)
    except KeyError as error:
        known = [model.key(i).name for i in range(model.nkey)]
        raise SimulationError(f'the scene has no keyframe "{name}"; {did_you_mean(name, known, "keyframes")}') from error


def is_env_mask(env_ids: EnvIds, num_envs: int) -> bool:
    """Return whether environments are named by a mask; a tensor's numbers are not looked at."""
    found = env_ids if isinstance(env_ids, Tensor) else torch.as_tensor(env_ids)
    return found.dtype == torch.bool and found.shape == (num_envs,)


def env_indices(env_ids: EnvIds | None, num_envs: int) -> Int[np.ndarray, " n"]:
    """Return environments as indices, in the order in which they are named.

    Args:
        env_ids: Indices, or a boolean mask over environments; None: all.
        num_envs: Number of environments.

    Raises:
        SimulationError: If there are no such environments.
    """
    if env_ids is None:
        return np.arange(num_envs)
    found = np.asarray(torch.as_tensor(env_ids).cpu())
    if found.dtype == bool and found.shape == (num_envs,):
        return np.flatnonzero(found)
    is_index = found.dtype.kind in "iu" and found.ndim == 1 and ((found >= 0) & (found < num_envs)).all()
    if found.size and not is_index:
        what = f"indices from 0 to {num_envs - 1}, or a mask of {num_envs}"
        raise SimulationError(f"env_ids: found {listed([str(value) for value in found.ravel()])}, expected {what}")
    return found.reshape(-1).astype(np.int64)


def env_mask(env_ids: EnvIds | None, num_envs: int, device: torch.device) -> Bool[Tensor, " env"]:
    """Return environments as a mask on a device. A mask that is there already is taken as it is, and nothing waits for the GPU.

    Args:
        env_ids: Indices, or a boolean mask over environments; None: all.
        num_envs: Number of environments.
        device: Where the mask is wanted.

    Raises:
        SimulationError: If there are no such environments.
    """
    if env_ids is None:
        return torch.ones(num_envs, dtype=torch.bool, device=device)
    if isinstance(env_ids, Tensor) and is_env_mask(env_ids, num_envs):
        return env_ids.to(device)
    mask = np.zeros(num_envs, dtype=bool)
    mask[env_indices(env_ids, num_envs)] = True
    return torch.from_numpy(mask).to(device)

"""Where in a model stands what a module wants: bodies, contact sensors, keyframes; and environments by index or mask."""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from tgdsl.errors import SimulationError, did_you_mean, listed
from tgdsl.plan import Pair, contact_sensor_names
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


def contact_sensor(model: mujoco.MjModel, pair: Pair, which: int) -> range:
    """Return where a pair's contact sensor (0: slots, 1: net force) stands in `sensordata`.

    Raises:
        SimulationError: If the model lacks it.
    """
    name = contact_sensor_names(pair)[which]
    try:
        sensor = model.sensor(name)
    except KeyError as error:
        what = f'the scene has no contact sensor "{name}", which the module wants'
        raise SimulationError(f"{what}; add them with tgdsl.instrument(spec, touch.inputs) before compiling") from error
    return range(int(sensor.adr[0]), int(sensor.adr[0] + sensor.dim[0]))


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

"""Some of the environments, by index or mask.

Shapes: `env` environments.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from tgdsl.errors import StateError, listed

EnvIds = Tensor | Sequence[int]


def env_mask(env_ids: EnvIds | None, num_envs: int, device: torch.device) -> Bool[Tensor, " env"]:
    """Return environments as a mask on a device.

    A mask that is there already is taken as it is. Indices on a GPU are taken without a look at them, which would have the host
    wait: those beyond the last environment are then an error of the device.

    Args:
        env_ids: Indices, or a boolean mask over environments; None: all.
        num_envs: Number of environments.
        device: Where the mask is wanted.

    Raises:
        StateError: If there are no such environments.
    """
    if env_ids is None:
        return torch.ones(num_envs, dtype=torch.bool, device=device)
    found = torch.as_tensor(env_ids)
    if found.dtype == torch.bool and found.shape == (num_envs,):
        return found.to(device)
    found = found if found.numel() else found.long()  # an empty list has no integers to tell its dtype by
    is_index = found.ndim <= 1 and not (found.is_floating_point() or found.is_complex() or found.dtype == torch.bool)
    on_host = found.device.type == "cpu"
    if not is_index or (on_host and bool(((found < 0) | (found >= num_envs)).any())):
        given = (
            listed([str(value) for value in found.flatten().tolist()]) if on_host else f"{tuple(found.shape)} of {found.dtype}"
        )
        raise StateError(f"env_ids: found {given}, expected indices from 0 to {num_envs - 1}, or a mask of {num_envs}")
    return torch.zeros(num_envs, dtype=torch.bool, device=device).index_fill_(0, found.reshape(-1).long().to(device), True)

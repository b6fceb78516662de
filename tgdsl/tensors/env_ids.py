"""Environments as users name them, by index or by a mask over all of them; and masked writes to tensors (env, …)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from tgdsl.errors import SimulationError, TgdslError, listed
from tgdsl.tensors.torch_internals import is_followed

EnvIds = Tensor | np.ndarray | Sequence[int]  # environments: indices, or a boolean mask over all of them
FEW = 0.5  # with more of the environments than this share, something is done for all of them


def check_env_ids(env_ids: EnvIds | None, error: type[TgdslError]) -> None:
    """Raise an error if environments, whose number is not known, are named neither by indices from 0 nor by a mask."""
    if env_ids is None:
        return
    ids = _ids_tensor(env_ids, None, error)
    is_some = ids.ndim == 1 and (ids.dtype == torch.bool or _are_indices(ids))
    if ids.numel() and not (is_some and (ids.is_cuda or bool((ids >= 0).all()))):
        raise error(f"env_ids: found {listed([str(value) for value in ids.flatten().tolist()])}, {_expected_ids(None)}")


def env_indices(env_ids: EnvIds | None, num_envs: int, error: type[TgdslError] = SimulationError) -> Int[np.ndarray, " n"]:
    """Return environments (default: all) as indices, in the order in which they are named.

    Raises:
        TgdslError: Of the type `error`, if there are no such environments.
    """
    if env_ids is None:
        return np.arange(num_envs)
    ids = np.asarray(_ids_tensor(env_ids, num_envs, error).cpu())
    if ids.dtype == bool and ids.shape == (num_envs,):
        return np.flatnonzero(ids)
    # Numbers of 8 bits are a mask that is not boolean rather than indices.
    is_index = ids.dtype.kind in "iu" and ids.dtype.itemsize > 1 and ids.ndim == 1 and ((ids >= 0) & (ids < num_envs)).all()
    if ids.size and not is_index:
        is_mask = ids.dtype == bool
        seen = f"a mask of {' x '.join(map(str, ids.shape))}" if is_mask else listed([str(value) for value in ids.ravel()])
        raise error(f"env_ids: found {seen}, {_expected_ids(num_envs)}")
    return ids.reshape(-1).astype(np.int64)


def is_env_mask(env_ids: EnvIds, num_envs: int) -> bool:
    """Return whether environments are named by a mask; a tensor's numbers are not looked at.

    Raises:
        SimulationError: If they are neither numbers nor a mask.
    """
    result = _ids_tensor(env_ids, num_envs, SimulationError)
    return result.dtype == torch.bool and result.shape == (num_envs,)


def _ids_tensor(env_ids: EnvIds, num_envs: int | None, error: type[TgdslError]) -> Tensor:
    try:
        return torch.as_tensor(env_ids)
    except (TypeError, ValueError, RuntimeError) as wrong:
        raise error(f"env_ids: found {env_ids!r}, {_expected_ids(num_envs)}") from wrong


def _are_indices(ids: Tensor) -> bool:
    """Return whether numbers can be indices; of 8 bits they are rather a mask that is not boolean."""
    return not ids.is_floating_point() and not ids.is_complex() and ids.element_size() > 1


def _expected_ids(num_envs: int | None) -> str:
    if num_envs is None:
        return "expected indices of environments from 0, or a mask of them"
    return f"expected indices from 0 to {num_envs - 1}, or a mask of {num_envs}"


def env_mask(
    env_ids: EnvIds | None,
    num_envs: int,
    device: torch.device,
    error: type[TgdslError] = SimulationError,
    waits: bool = True,
) -> Bool[Tensor, " env"]:
    """Return environments (default: all) as a mask on a device. A mask on the device is returned without a copy.

    Indices on a GPU are checked on the host, which `waits` for them, or by the kernel, which asserts that they exist.
    """
    if env_ids is None:
        return torch.ones(num_envs, dtype=torch.bool, device=device)
    if isinstance(env_ids, Tensor):
        if env_ids.dtype == torch.bool and env_ids.shape == (num_envs,):
            return env_ids.to(device)
        is_index = env_ids.dtype in (torch.int64, torch.int32) and env_ids.ndim == 1
        if not waits and is_index and env_ids.device.type != "cpu":
            mask = torch.zeros(num_envs, dtype=torch.bool, device=env_ids.device)
            mask[env_ids.long()] = True
            return mask.to(device)
    result = np.zeros(num_envs, dtype=bool)
    result[env_indices(env_ids, num_envs, error)] = True
    return torch.from_numpy(result).to(device)


def broadcast_over(mask: Bool[Tensor, " env"], values: Tensor) -> Bool[Tensor, "env ..."]:
    """Return a mask over environments with as many axes as `values` (env, …); all axes after the first have length 1.

    With `torch.where` or `masked_fill_` it then chooses whole environments.
    """
    return mask.view(-1, *[1] * (values.ndim - 1))


def few_ids(mask: Bool[Tensor, " env"]) -> Int[Tensor, " n"] | None:
    """Return the environments of a mask, if they are so few that indexing them is faster than computing all.

    None on a GPU or under compilation, where the values must not be read: see `may_be_nonempty`.
    """
    if mask.is_cuda or torch.compiler.is_compiling():
        return None
    ids = np.flatnonzero(mask.numpy())  # for few environments in half of torch's time
    return torch.from_numpy(ids) if len(ids) <= FEW * len(mask) else None


def put_rows(target: Tensor, chosen: Bool[Tensor, " env"], new: Tensor | float) -> None:
    """Write one number, or values that broadcast, into chosen environments of a tensor (env, …), by one kernel."""
    put(target, broadcast_over(chosen, target), new)


def put(target: Tensor, where: Bool[Tensor, "*mask"], new: Tensor | float) -> None:
    """Write new values where a mask holds that broadcasts to the target: see `put_rows`."""
    if not isinstance(new, Tensor):
        target.masked_fill_(where, new)
    elif torch.compiler.is_compiling():
        target.copy_(torch.where(where, new, target))
    else:
        torch.where(where, new, target, out=target)


def is_cheap_to_read(values: Tensor) -> bool:
    """Return whether Python may branch on values: not on a GPU, where derivatives are wanted, or operations are followed."""
    return not (torch.is_grad_enabled() or is_out_of_sight(values))


def may_be_nonempty(mask: Bool[Tensor, "*n"]) -> bool:
    """Return whether a mask holds anywhere, or its values must not be read: on a GPU, and where operations are followed.

    If this is False, the masked operation can be skipped; the result must be the same bytes.
    """
    return is_out_of_sight(mask) or bool(mask.any())


def is_out_of_sight(values: Tensor) -> bool:
    """Return whether Python must not read values: on a GPU, where it would wait, and where operations are followed."""
    return values.is_cuda or torch.compiler.is_compiling() or is_followed()

"""Dtypes and devices as users name them."""

from __future__ import annotations

import torch

from tgdsl.errors import TgdslError


def dtype_of(dtype: torch.dtype | str) -> torch.dtype:
    """Return a dtype by its name.

    Args:
        dtype: A dtype, or its name, "float32" or "torch.float32".

    Raises:
        TgdslError: If there is none of that name.
    """
    found = getattr(torch, dtype.removeprefix("torch."), None) if isinstance(dtype, str) else dtype
    if not isinstance(found, torch.dtype):
        raise TgdslError(f"dtype is {dtype!r}, expected torch.float32 or torch.float64")
    return found


def device_of(device: torch.device | str) -> torch.device:
    """Return a device by its name, after a look whether it is there.

    Raises:
        TgdslError: If it is not.
    """
    try:
        return torch.empty(0, device=device).device
    except (RuntimeError, AssertionError, TypeError) as error:
        what = str(error).partition("\n")[0]
        raise TgdslError(f'there is no device "{device}": {what}') from error

"""Dtypes and devices as users name them."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from tgdsl.errors import TgdslError


def check_dtype(dtype: torch.dtype) -> None:
    """Refuse a dtype that no module can have: a narrower float knows places on a hand to 0.1 mm, too coarse for a depth."""
    if dtype not in (torch.float32, torch.float64):
        hint = "readings can be cast afterwards, a module computes depths that a narrower float cannot hold"
        raise TgdslError(f"a module cannot be of {dtype}, expected torch.float32 or torch.float64; {hint}")


def dtype_of(dtype: torch.dtype | str) -> torch.dtype:
    """Return a dtype by its name, "float32" or "torch.float32"."""
    result = getattr(torch, dtype.removeprefix("torch."), None) if isinstance(dtype, str) else dtype
    if not isinstance(result, torch.dtype):
        raise TgdslError(f"dtype is {dtype!r}, expected torch.float32 or torch.float64")
    check_dtype(result)
    return result


def device_of(device: torch.device | str) -> torch.device:
    """Return a device by its name, after a look whether it is there."""
    try:
        return torch.empty(0, device=device).device
    except (RuntimeError, AssertionError, TypeError) as error:
        raise TgdslError(f'there is no device "{device}"{why_there_is_none(device, error)}') from error


def why_there_is_none(device: object, error: Exception, known: Sequence[str] = ("cpu", "cuda")) -> str:
    """Return the message for a device that torch lacks: the available types, or torch's own words."""
    if str(device).partition(":")[0] in known:
        return f": {str(error).partition(chr(10))[0]}" + ('; expected "cpu"' if "cpu" in known else "")
    if str(device).startswith("gpu") and "cuda" in known:
        return '; did you mean "cuda"?'
    return "; expected " + " or ".join(f'"{name}"' for name in known)

"""Devices that physics can run on."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from tgdsl.errors import SimulationError
from tgdsl.tensors.devices import why_there_is_none


def checked_device(device: str, supported: Sequence[str]) -> torch.device:
    """Return a device with its index, by torch's name for it: "cpu", "cuda" or "cuda:1"."""
    try:
        result = torch.empty(0, device=device).device
    except (RuntimeError, AssertionError) as error:
        hint = why_there_is_none(device, error, supported)
        raise SimulationError(f'there is no device "{device}" to run physics on{hint}') from error
    if result.type not in supported:
        expected = " or ".join(f'"{name}"' for name in supported)
        raise SimulationError(f'physics on "{device}" is not supported, expected {expected}')
    return result

"""The machine that physics runs on: its devices, and the memory that is free before a simulation allocates any."""

from __future__ import annotations

import os
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


def refuse_beyond_memory(what: str, num_bytes: int) -> None:
    """Raise an error if something needs more memory than this computer has."""
    there = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if num_bytes > there:
        raise SimulationError(f"{what} need about {num_bytes / 1e9:.3g} GB, and this computer has {there / 1e9:.3g} GB")

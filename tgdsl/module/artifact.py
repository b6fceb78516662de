"""Compiled artefacts: one `.safetensors` file with the Plan's arrays, and the Plan itself as sorted JSON in its metadata."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import torch

from tgdsl.errors import TgdslError
from tgdsl.module.module import TactileModule
from tgdsl.module.taxels import Taxels, check_taxels, load_plan, save_plan
from tgdsl.sensors import Kind
from tgdsl.sensors.known import known_kinds, quantities_of
from tgdsl.tensors.devices import device_of, dtype_of


def save(touch: TactileModule, path: str | PathLike[str]) -> int:
    """Write a module as an artefact (.safetensors) for `tgdsl.load`, without its state (see `state_dict`).

    The same document gives the same bytes. The file appears whole or not at all. Returns its size [bytes].

    Raises:
        FileError: If the file cannot be written.
        TgdslError: If `touch` is no module, or the path has another ending.
    """
    if not isinstance(touch, TactileModule):
        raise TgdslError(f"tgdsl.save writes a module that tgdsl.compile returned, found {type(touch).__name__}")
    if Path(path).suffix.lower() in (".pt", ".pth", ".yaml", ".yml", ".xml"):
        raise TgdslError(f"{path}: an artefact is a safetensors file, expected a name such as {Path(path).stem}.safetensors")
    return save_plan(touch.plan, path)


def load(
    path: str | PathLike[str],
    *,
    kinds: Sequence[Kind] = (),
    dtype: torch.dtype | str = torch.float32,
    device: torch.device | str = "cpu",
    taxels: Taxels | None = None,
) -> TactileModule:
    """Return the module of an artefact. It needs neither MuJoCo nor the files from which it was compiled.

    Args:
        path: The artefact.
        kinds: Your own sensor kinds, if the artefact uses any that no installed package provides.
        dtype: Dtype of the readings, float32 or float64, as for `compile`, or its name.
        device: Device of the module.
        taxels: The expected taxels, such as a policy's: see `tgdsl.check_taxels`.

    Raises:
        ArtifactError: If the file is not an artefact, is damaged or is of another version.
        TaxelError: If it has other taxels than expected, or in another order: the message says how they differ.
        TgdslError: If it uses a kind that is neither installed nor given, or there is no such dtype or device.
    """
    dtype, device = dtype_of(dtype), device_of(device)
    all_kinds = known_kinds(kinds)
    plan = load_plan(path, quantities_of(all_kinds))
    touch = TactileModule(plan, all_kinds, dtype)
    if taxels is not None:
        check_taxels(touch, taxels, str(path))
    return touch.to(device)

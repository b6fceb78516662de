"""Compiled artefacts: one `.safetensors` file with the Plan's arrays, and the Plan itself as sorted JSON in its metadata."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as serialized

from tgdsl.errors import ArtifactError, TgdslError
from tgdsl.files.write import atomic_write
from tgdsl.module.module import TactileModule
from tgdsl.plan import ranges
from tgdsl.plan.plan import Plan
from tgdsl.quantities.base import Quantity
from tgdsl.quantities.known import QUANTITIES
from tgdsl.scene.asset_paths import check_scene
from tgdsl.sensors import Kind
from tgdsl.sensors.known import kinds_by_sensor, known_kinds, quantities_of
from tgdsl.tensors.devices import device_of, dtype_of

METADATA_KEY = "tgdsl"


def save(touch: TactileModule, path: str | PathLike[str]) -> int:
    """Write what a module was built from; `tgdsl.load` makes the module again. Its state is not part of it: see `state_dict`.

    The same document gives the same bytes. The file appears whole or not at all.

    Returns:
        Bytes written.

    Raises:
        FileError: If the file cannot be written.
        TgdslError: If it is no module.
    """
    if not isinstance(touch, TactileModule):
        raise TgdslError(f"tgdsl.save writes a module that tgdsl.compile returned, found {type(touch).__name__}")
    return save_plan(touch.plan, path)


def load(
    path: str | PathLike[str],
    *,
    kinds: Sequence[Kind] = (),
    dtype: torch.dtype | str = torch.float32,
    device: torch.device | str = "cpu",
) -> TactileModule:
    """Return the module of an artefact. Neither MuJoCo nor any file that it was compiled from is needed.

    Args:
        path: The artefact.
        kinds: Sensor kinds of your own, if it was compiled with any that no installed package brings.
        dtype: Dtype of the readings, float32 or float64, as for `compile`; its name will do.
        device: Where the module lives.

    Raises:
        ArtifactError: If the file is not an artefact, is damaged, is of another version, or holds indices of what is not there.
        TgdslError: If it uses a kind that is neither installed nor given, or there is no such dtype or device.
    """
    dtype, device = dtype_of(dtype), device_of(device)
    known = known_kinds(kinds)
    plan = load_plan(path, quantities_of(known))
    by_sensor = kinds_by_sensor(known, {sensor.name: sensor.kind for sensor in plan.sensors})
    try:
        for sensor in plan.sensors:
            counts = by_sensor[sensor.name].indices(sensor.constants, len(sensor.taxels))
            ranges.check_constants(f"sensors/{sensor.name}", sensor.constants, counts)
    except ArtifactError as error:
        raise ArtifactError(f"{path}: {error}") from error
    return TactileModule(plan, known, dtype).to(device)


def save_plan(plan: Plan, path: str | PathLike[str]) -> int:
    """Write a plan, as `save` does; return the bytes written."""
    content = serialized({name: np.asarray(value) for name, value in plan.arrays.items()}, {METADATA_KEY: plan.to_json()})
    atomic_write(Path(path), content)
    return len(content)


def load_plan(path: str | PathLike[str], quantities: Sequence[Quantity] = QUANTITIES) -> Plan:
    """Read a plan. Only the artefact itself is opened: no file that it names.

    Args:
        path: The artefact.
        quantities: The quantities that it may ask for.

    Raises:
        ArtifactError: If the file is not an artefact, is damaged, is of another version, or names files in places where those
            of an artefact cannot be.
    """
    try:
        with safe_open(str(path), framework="numpy") as file:
            metadata = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in sorted(file.keys())}
    except (SafetensorError, OSError) as error:
        raise ArtifactError(f"{path}: cannot read this artefact: {error}") from error
    if METADATA_KEY not in metadata:
        raise ArtifactError(f"{path}: this safetensors file was not written by tgdsl")
    for array in arrays.values():
        array.flags.writeable = False
    try:
        plan = Plan.from_json(metadata[METADATA_KEY], arrays, quantities)
        check_scene(plan.scene)
        return plan
    except ArtifactError as error:
        raise ArtifactError(f"{path}: {error}") from error

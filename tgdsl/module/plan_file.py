"""The file of an artefact: a Plan's arrays, and the Plan itself as sorted JSON in its metadata."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as serialized

from tgdsl.errors import ArtifactError
from tgdsl.files.write import atomic_write
from tgdsl.plan.plan import Plan
from tgdsl.quantities.base import Quantity
from tgdsl.quantities.known import QUANTITIES
from tgdsl.scene.asset_paths import check_scene

METADATA_KEY = "tgdsl"


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
        if isinstance(error, SafetensorError) and Path(path).suffix in (".yaml", ".yml"):
            raise ArtifactError(f"{path}: this is a document, not an artefact; tgdsl.compile reads documents") from error
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

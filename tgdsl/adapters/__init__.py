"""Touch in other simulators: a file for each, which imports its simulator."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from typing import Any

from tgdsl.errors import SimulationError
from tgdsl.module.artifact import load
from tgdsl.module.module import TactileModule
from tgdsl.tuning.compile import compile

Document = str | PathLike[str] | Mapping[str, Any]


def module_of(document: Document, host: str, scene: Any = None) -> TactileModule:
    """Compile a document, for an existing scene if one is given, or load an artefact (`.safetensors`)."""
    is_artifact = not isinstance(document, Mapping) and str(document).endswith(".safetensors")
    if is_artifact and scene is not None:
        raise SimulationError(f"{document}: an artefact is compiled for its scene already; expected a document with `scene_fn`")
    touch = load(document) if is_artifact else compile(document, scene=scene)  # pyright: ignore[reportArgumentType]
    if touch.inputs.substeps > 1:
        problem = f"this module is advanced at {touch.inputs.substeps} physics steps a call"
        raise SimulationError(f"{problem}, and {host} reads it once a control step")
    return touch

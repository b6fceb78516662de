"""The whole way from a document to a module: what `accuracy` leaves open is chosen by measured error first."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import torch

from tgdsl.compiler import pipeline
from tgdsl.compiler.pipeline import Document
from tgdsl.console.progress import Progress
from tgdsl.errors import TgdslError
from tgdsl.formats.built import built_scene
from tgdsl.module.module import TactileModule
from tgdsl.plan.plan import Plan
from tgdsl.sensors import Kind
from tgdsl.sensors.known import known_kinds
from tgdsl.tensors.devices import device_of, dtype_of
from tgdsl.tuning.choose import choose


def compile_plan(
    document: Document,
    overrides: Mapping[str, Any] | None = None,
    kinds: Sequence[Kind] = (),
    progress: Progress | None = None,
    sensors: Collection[str] | None = None,
) -> Plan:
    """Return the Plan of a document, as `compile` has it.

    Raises:
        SpecError: All mistakes in the document and its layout, with file, line and column.
        RobotError: If a robot or scene file cannot be read, or has something unsupported.
    """
    choice = choose(document, overrides, kinds, progress, sensors)
    return pipeline.compile_document(document, overrides, kinds, progress, sensors, choice).plan


def compile(
    document: Document,
    *,
    resolution: str | None = None,
    sensors: Collection[str] | None = None,
    overrides: Mapping[str, Any] | None = None,
    kinds: Sequence[Kind] = (),
    dtype: torch.dtype | str = torch.float32,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
    scene: Any = None,
) -> TactileModule:
    """Compile a document to a module.

    Args:
        document: A YAML file, or the same as a mapping (file names in it are then relative to the working folder).
        resolution: Resolution that replaces the document's.
        sensors: Names of the sensors to compile; default: all of the document.
        overrides: YAML text, or plain values, by dotted path, such as `{"sensors.touch.normal_stiffness": 400.0}`.
        kinds: Your own sensor kinds, in addition to tgdsl's and installed packages': see `sensors.known`.
        dtype: Dtype of readings and computation, float32 or float64, or its name. Narrower floats would round positions by as
            much as penetration depths; cast the readings instead, `readings["s"].to(torch.bfloat16)`.
        device: Device of the module.
        progress: Called with a line when a long job begins, such as "object mug: distances". A new mesh takes seconds, and a
            sensor with an `accuracy` takes a run of the scene.
        scene: A scene that replaces the document's: an `mujoco.MjSpec`, an `mujoco.MjModel` or a `pxr.Usd.Stage`. The document
            then uses the scene's names and needs no model; models that it names must be in the scene. A scene with contact
            pairs, height fields or flexes must be an `MjSpec`, since an `MjModel` lacks their sources.

    Returns:
        The module, not yet compiled by torch: call its `compile()` for fused kernels.

    Raises:
        SpecError: All mistakes in the document and its layout, with file, line and column; an `accuracy` out of reach.
        RobotError: If a robot or scene cannot be read, or has something unsupported.
        TgdslError: If the dtype is neither float32 nor float64, the device does not exist, an entry of `kinds` is no `Kind`, or
            `overrides` is no mapping.
    """
    dtype, device = dtype_of(dtype), device_of(device)
    if not isinstance(overrides, Mapping | None):
        raise TgdslError(f"overrides are a mapping from dotted paths to values, found {type(overrides).__name__}")
    all_overrides = {**(overrides or {}), **({"resolution": resolution} if resolution is not None else {})}
    if scene is None:
        plan = compile_plan(document, all_overrides, kinds, progress, sensors)
    else:
        plan = pipeline.compile_document(document, all_overrides, kinds, progress, sensors, scene=built_scene(scene)).plan
    return TactileModule(plan, known_kinds(kinds), dtype).to(device)

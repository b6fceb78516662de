"""The whole way from a document to a module: load, resolve, lower, freeze the scene."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from importlib.metadata import version
from os import PathLike
from typing import Any, NamedTuple

import mujoco
import torch

from tgdsl.compiler import lower
from tgdsl.compiler.resolve import resolve
from tgdsl.compiler.scene import scene_file
from tgdsl.console.progress import Progress, silent
from tgdsl.errors import TgdslError, did_you_mean
from tgdsl.formats.mjcf import xml_files
from tgdsl.layout.layout import Layout
from tgdsl.layout.unfelt import Unfelt
from tgdsl.module.module import TactileModule
from tgdsl.placement.reach import unfelt
from tgdsl.plan.plan import Origin, Plan
from tgdsl.scene.scene import portable
from tgdsl.schema.load import load
from tgdsl.schema.loaded import Loaded
from tgdsl.sensors import Kind
from tgdsl.sensors.known import known_kinds
from tgdsl.tensors.devices import device_of, dtype_of

Document = str | PathLike[str] | Mapping[str, Any]


def compile_plan(
    document: Document,
    overrides: Mapping[str, Any] | None = None,
    kinds: Sequence[Kind] = (),
    progress: Progress | None = None,
    sensors: Collection[str] | None = None,
) -> Plan:
    """Return the Plan of a document.

    Args:
        document: A YAML file, or the same as a mapping.
        overrides: By dotted path YAML text, or a plain value, set before anything is read: `{"resolution": "high"}`.
        kinds: Sensor kinds of your own, beside those of tgdsl and of installed packages: see `sensors.known`.
        progress: Is told in a line what is being done, each time that something begins.
        sensors: Names of the document's sensors that are wanted; default: all.

    Raises:
        SpecError: All mistakes in the document and its layout, with file, line and column.
        RobotError: If a robot or scene file cannot be read, or holds what is not supported.
    """
    known, tell = known_kinds(kinds), progress or silent
    loaded = load(document, overrides, known, sensors=sensors)
    resolved = resolve(loaded, tell)
    plan = lower.plan(loaded, resolved, known, _origin(loaded), tell)
    tell("compiling the scene")
    return dataclasses.replace(plan, scene=scene_file(resolved.scene, plan.inputs, resolved.own, resolved.primitives))


class Placed(NamedTuple):
    """Where a document puts taxels.

    Attributes:
        model: The model of the scene, or of the robot if there is no scene.
        layouts: The layouts, by resolution.
        unfelt: The taxels of each that are not collided, buried, or covered in the robot's initial state.
    """

    model: mujoco.MjModel
    layouts: dict[str, Layout]
    unfelt: dict[str, tuple[Unfelt, ...]]


def layouts(
    document: Document,
    overrides: Mapping[str, Any] | None = None,
    resolutions: Sequence[str] = (),
    kinds: Sequence[Kind] = (),
) -> tuple[mujoco.MjModel, dict[str, Layout]]:
    """Return the model and the layouts of `placed`."""
    found = placed(document, overrides, resolutions, kinds)
    return found.model, found.layouts


def placed(
    document: Document,
    overrides: Mapping[str, Any] | None = None,
    resolutions: Sequence[str] = (),
    kinds: Sequence[Kind] = (),
) -> Placed:
    """Return where a document puts taxels, at one resolution or more, without lowering sensors or baking objects.

    Args:
        document: A YAML file, or the same as a mapping; without sensors, all taxels of its layout count.
        overrides: YAML text, or plain values, by dotted path.
        resolutions: Default: the document's own, or all of the layout's if it names none.
        kinds: Sensor kinds of your own, beside those of tgdsl and of installed packages: see `sensors.known`.

    Raises:
        SpecError: All mistakes in the document and its layout, with file, line and column.
        RobotError: If a robot or scene file cannot be read, or holds what is not supported.
        TgdslError: If the layout has no such resolution.
    """
    chosen, known = overrides or {}, known_kinds(kinds)
    loaded = load(document, chosen, known, needs_sensors=False)
    if loaded.layout is None:
        return Placed(resolve(loaded).scene.compiled, {}, {})  # which says all that is wrong, if a layout is needed
    names, own = list(loaded.layout.spec.resolutions), loaded.resolution
    wanted = list(resolutions) or ([own] if own is not None else names)
    for name in resolutions:
        if name not in names:
            raise TgdslError(f'the layout has no resolution "{name}"; {did_you_mean(name, names, "resolutions")}')
    texts = {name: chosen if name == own else {**chosen, "resolution": name} for name in wanted}
    each = {name: resolve(load(document, text, known, needs_sensors=False)) for name, text in texts.items()}
    found = {name: unfelt(own.colliders, own.layout, own.reach) for name, own in each.items()}
    return Placed(each[wanted[0]].scene.compiled, {name: own.layout for name, own in each.items()}, found)


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
) -> TactileModule:
    """Compile a document to a module.

    Args:
        document: A YAML file, or the same as a mapping (file names in it are then relative to the working folder).
        resolution: Instead of the document's own.
        sensors: Names of the document's sensors that are wanted: of the others nothing is computed; default: all.
        overrides: YAML text, or plain values, by dotted path, such as `{"sensors.touch.normal_stiffness": 400.0}`.
        kinds: Sensor kinds of your own, beside those of tgdsl and of installed packages: see `sensors.known`.
        dtype: Dtype of the readings, and of what is computed on the way: float32 or float64; its name will do. Narrower floats
            are refused, as their rounding of places is as large as the depths; cast the readings instead,
            `readings["s"].to(torch.bfloat16)`.
        device: Where the module lives.
        progress: Is told in a line what is being done, such as "object mug: distances", each time that something begins; meshes
            that are met for the first time take seconds.

    Returns:
        The module, not yet compiled by torch: call its `compile()` for fused kernels.

    Raises:
        SpecError: All mistakes in the document and its layout, with file, line and column.
        RobotError: If a robot or scene file cannot be read, or holds what is not supported.
        TgdslError: If the dtype is neither float32 nor float64, there is no such device, a kind is none, or the overrides are
            no mapping.
    """
    dtype, device = dtype_of(dtype), device_of(device)
    if not isinstance(overrides, Mapping | None):
        raise TgdslError(f"overrides are a mapping from dotted paths to values, found {type(overrides).__name__}")
    chosen = {**(overrides or {}), **({"resolution": resolution} if resolution is not None else {})}
    plan = compile_plan(document, chosen, kinds, progress, sensors)
    return TactileModule(plan, known_kinds(kinds), dtype).to(device)


def _origin(loaded: Loaded) -> Origin:
    robot = loaded.robot_file
    assert robot is not None
    digest = hashlib.sha256()
    for path in xml_files(robot):
        digest.update(path.read_bytes())
    parts = [loaded.source.value, loaded.layout.source.value if loaded.layout else None]
    text = json.dumps(parts, sort_keys=True, default=str)
    return Origin(
        document_sha256=hashlib.sha256(text.encode()).hexdigest(),
        robot=portable(robot),
        robot_sha256=digest.hexdigest(),
        resolution=loaded.resolution or "",
        versions={"tgdsl": version("tgdsl"), "mujoco": mujoco.__version__},
    )

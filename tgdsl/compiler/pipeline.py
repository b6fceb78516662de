"""The whole way from a document to a Plan: load, resolve, lower, freeze the scene."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import version
from os import PathLike
from typing import Any, NamedTuple

import mujoco

from tgdsl.compiler import lower
from tgdsl.compiler.resolve import Resolved, models_of, resolve
from tgdsl.compiler.scene import scene_file
from tgdsl.console.progress import Progress, silent
from tgdsl.errors import SpecError, TgdslError, did_you_mean, listed
from tgdsl.formats.mjcf import xml_files
from tgdsl.formats.model import Model
from tgdsl.layout.layout import Layout, Unfelt
from tgdsl.placement.reach import unfelt
from tgdsl.plan.plan import Origin, Plan
from tgdsl.scene.scene import portable
from tgdsl.schema.load import GIVEN, Loaded, load
from tgdsl.schema.placement import LayoutSpec
from tgdsl.sensors import Kind
from tgdsl.sensors.known import known_kinds

Document = str | PathLike[str] | Mapping[str, Any]


@dataclass(frozen=True)
class Choice:
    """What was chosen."""

    changes: Mapping[str, Any] = field(default_factory=dict)  # fields by dotted path: `objects.mug.tolerance`
    notes: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # lines of `explain`, by sensor with an `accuracy`

    def noted(self, plan: Plan) -> Plan:
        """Return a Plan with notes on its chosen fields."""
        sensors = [
            dataclasses.replace(sensor, notes=(*sensor.notes, *self.notes.get(sensor.name, ()))) for sensor in plan.sensors
        ]
        return dataclasses.replace(plan, sensors=tuple(sensors))


UNCHOSEN = Choice()  # of documents without an `accuracy`


class Compiled(NamedTuple):
    """A document on the way: as read, as resolved on its robot, and its Plan."""

    loaded: Loaded
    resolved: Resolved
    plan: Plan


def compile_document(
    document: Document,
    overrides: Mapping[str, Any] | None = None,
    kinds: Sequence[Kind] = (),
    progress: Progress | None = None,
    sensors: Collection[str] | None = None,
    choice: Choice = UNCHOSEN,
    scene: Model | None = None,
) -> Compiled:
    """Compile a document to its Plan, and return it with the loaded and resolved document: see `tgdsl.compile`.

    `sensors` names the sensors to compile (default: all); `choice` is for sensors with an `accuracy`; `scene` replaces the
    document's.

    Raises:
        SpecError: All mistakes in the document and its layout, with file, line and column.
        RobotError: If a robot or scene file cannot be read, or uses unsupported features.
        TgdslError: If a sensor has an `accuracy` and nothing was chosen.
    """
    all_kinds, tell = known_kinds(kinds), progress or silent
    loaded = load(document, {**(overrides or {}), **choice.changes}, all_kinds, sensors=sensors, has_scene=scene is not None)
    resolved = resolve(loaded, tell, None if scene is None else models_of(loaded, scene))
    if names := [name for name, s in loaded.spec.sensors.items() if s.accuracy is not None and name not in choice.notes]:
        problem = f"{listed(names)}: `accuracy` takes a run of the scene"
        way = "compile with `tgdsl.compile`" if scene is None else "compile without `scene=`"
        raise TgdslError(f"{loaded.source.file}: {problem}; {way}, or set it to null")
    written = loaded
    if choice.changes:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # these were given when the document was loaded
            written = load(document, overrides, all_kinds, sensors=sensors)
    plan = lower.plan(loaded, resolved, all_kinds, _origin(written, scene), tell)
    tell("compiling the scene")
    file = scene_file(resolved.scene, plan.inputs, resolved.own, resolved.primitives)
    return Compiled(loaded, resolved, choice.noted(dataclasses.replace(plan, scene=file)))


class Placed(NamedTuple):
    """The taxels that a document places."""

    model: mujoco.MjModel  # the model of the scene, or of the robot if there is no scene
    layouts: dict[str, Layout]  # the layouts, by resolution
    unfelt: dict[str, tuple[Unfelt, ...]]  # taxels that are not collided, buried, or covered in the initial state


def placed(
    document: Document,
    overrides: Mapping[str, Any] | None = None,
    resolutions: Sequence[str] = (),
    kinds: Sequence[Kind] = (),
    progress: Progress = silent,
) -> Placed:
    """Return a document's taxels at one or more resolutions, without lowering sensors or baking objects.

    Raises:
        SpecError: All mistakes in the document and its layout, with file, line and column.
        RobotError: If a robot or scene file cannot be read, or uses unsupported features.
        TgdslError: If the layout has no such resolution.
    """
    all_overrides, all_kinds = overrides or {}, known_kinds(kinds)
    loaded = load(document, all_overrides, all_kinds, needs_sensors=False)
    if loaded.layout is None:
        return Placed(resolve(loaded).scene.compiled, {}, {})  # raises all mistakes, if a layout is needed
    names, only = list(loaded.layout.spec.resolutions), loaded.resolution
    shown_names = list(resolutions) or ([only] if only is not None else names)
    for name in resolutions:
        if name not in names:
            raise TgdslError(f'the layout has no resolution "{name}"; {did_you_mean(name, names, "resolutions")}')
    parsed = {
        name: loaded if name == only else load(document, {**all_overrides, "resolution": name}, all_kinds, needs_sensors=False)
        for name in shown_names
    }
    progress("reading robot and scene")
    models = models_of(parsed[shown_names[0]])
    each = {name: resolve(parsed[name], progress, models) for name in shown_names}
    result = {name: unfelt(placement.colliders, placement.layout, placement.reach) for name, placement in each.items()}
    return Placed(each[shown_names[0]].scene.compiled, {name: placement.layout for name, placement in each.items()}, result)


def all_layouts(
    document: Document, overrides: Mapping[str, Any], resolutions: Sequence[str] = ()
) -> tuple[LayoutSpec, dict[str, Layout]]:
    """Return a document's layout as written, and the taxels of all its links at some resolutions (default: all)."""
    loaded = load(document, overrides, known_kinds(()), needs_sensors=False)
    if loaded.layout is None:
        if loaded.is_without_layout:
            loaded.note(("robot",), 'missing key "layout"', "only a layout has taxels to write down", on_key=True)
        raise SpecError(loaded.problems)
    spec = loaded.layout.spec
    of_sensors = {**overrides, "resolution": next(iter(spec.resolutions))}
    load(document, of_sensors, known_kinds(()), needs_sensors=False).raise_problems()
    bare = {**overrides, "sensors": {}, "observations": {}}
    return spec, placed(document, bare, resolutions or tuple(spec.resolutions)).layouts


@cache
def _version() -> str:
    """Return the version of the installed package, whose metadata take milliseconds to read."""
    return version("tgdsl")


def _origin(loaded: Loaded, scene: Model | None) -> Origin:
    robot, digest = loaded.robot_file, hashlib.sha256()
    for path in () if robot is None else xml_files(robot):
        digest.update(path.read_bytes())
    if scene is not None:
        digest.update(scene.mjcf.encode())
    parts = [loaded.source.value, loaded.layout.source.value if loaded.layout else None]
    text = json.dumps(parts, sort_keys=True, default=str)
    return Origin(
        document_sha256=hashlib.sha256(text.encode()).hexdigest(),
        robot=GIVEN if robot is None else portable(robot),
        robot_sha256=digest.hexdigest(),
        resolution=loaded.resolution or "",
        versions={"tgdsl": _version(), "mujoco": mujoco.__version__},
    )

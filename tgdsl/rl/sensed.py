"""The module of a task: of the sensors' document, those sensors alone that the policy feels or the task looks at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch

from tgdsl.compiler.pipeline import compile as compile_document
from tgdsl.console.progress import Progress
from tgdsl.errors import listed
from tgdsl.module.module import TactileModule
from tgdsl.rl.load import LoadedTask
from tgdsl.rl.spec import SENSED
from tgdsl.schema.load import load
from tgdsl.sensors.known import known_kinds

GROUP = "tactile_sensors"
"""The observation group of what a policy feels."""


@dataclass(frozen=True, eq=False)
class Sensed:
    """What a task's environments feel.

    Attributes:
        touch: The module.
        felt: Name of the sensor that the policy feels; None if it feels nothing.
        contact: Name of the `link_contact` sensor; None if the task takes none.
        channels: Names of its channels: those of the force, and of the normal force if the task wants it, among them.
        distance: Name of the `surface_distance` sensor; None if the task takes none.
        object: Body of the task's object in the scene.
    """

    touch: TactileModule
    felt: str | None
    contact: str | None
    channels: tuple[str, ...]
    distance: str | None
    object: str


def compile_sensed(
    loaded: LoadedTask, device: torch.device | str, progress: Progress | None = None, only: Sequence[str] | None = None
) -> Sensed:
    """Compile what a task's environments feel.

    Args:
        loaded: The task's document.
        device: Where the module lives.
        progress: Is told in a line what is being done.
        only: Kinds of sensors that are taken instead of those that the policy feels and the task looks at.

    Raises:
        SpecError: If the sensors' document lacks a sensor or the object, at the place in the task's document; or all mistakes
            of the sensors' document.
        RobotError: If a robot or scene file cannot be read.
    """
    spec = loaded.spec
    file = loaded.folder / spec.document
    if not file.is_file():
        hint = "paths are relative to this document"
        raise loaded.error(("document",), f'there is no file "{spec.document}"', hint)
    document = load(file, kinds=known_kinds())
    document.raise_problems()
    if spec.object not in document.spec.objects:
        what = f'"{spec.document}" has no object "{spec.object}", only {listed(list(document.spec.objects))}'
        raise loaded.error(("object",), what)
    kinds = {name: sensor.kind for name, sensor in document.spec.sensors.items()}  # type: ignore[attr-defined]
    by_kind = {kind: _sensor_of(loaded, kinds, kind, ("task",)) for kind in (loaded.task.senses if only is None else only)}
    overrides: dict[str, Any] = {"observations": {}}
    if spec.resolution is not None:
        overrides["resolution"] = spec.resolution
    felt = None
    if spec.touch != "none" and only is None:
        kind, observed = SENSED[spec.touch]
        felt = _sensor_of(loaded, kinds, kind, ("touch",))
        overrides |= {f"sensors.{felt}.links": spec.placement, f"sensors.{felt}.noise": spec.noise}
        overrides["observations"] = {GROUP: [{"type": observed, "of": felt}]}
    contact = by_kind.get("link_contact")
    if contact:
        own = document.spec.sensors[contact].outputs  # type: ignore[attr-defined]
        wanted = ("force", "normal_force") if loaded.task.wants_normal_force else ("force",)
        overrides[f"sensors.{contact}.outputs"] = list(dict.fromkeys((*own, *wanted)))
    kept = {*by_kind.values(), *([felt] if felt else [])}
    touch = compile_document(file, sensors=kept, overrides=overrides, device=device, progress=progress)
    body = document.spec.objects[spec.object].body_of(spec.object)
    channels = next((own.channels for own in touch.outputs if own.name == contact), ())
    return Sensed(touch, felt, contact, channels, by_kind.get("surface_distance"), body)


def _sensor_of(loaded: LoadedTask, kinds: dict[str, str], kind: str, place: tuple[str, ...]) -> str:
    """Return the document's only sensor of a kind.

    Raises:
        SpecError: If there is none, or several.
    """
    found = [name for name, own in kinds.items() if own == kind]
    if len(found) == 1:
        return found[0]
    which = f"the sensors {listed(found)}" if found else "no sensor"
    what = f'"{loaded.spec.document}" has {which} of kind "{kind}", expected one'
    raise loaded.error(place, what)

"""The document a user writes: robot, scene, objects, sensors, noise profiles, observations."""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any, Literal, Union

from pydantic import Field, StringConstraints, Tag, create_model

from tgdsl.fields.models import TEXT_OR_OTHER, SpecModel, Text
from tgdsl.observations.observations import ObservationSpec
from tgdsl.schema.conditional import conditional
from tgdsl.schema.objects import ObjectSpec
from tgdsl.schema.placement import LayoutSpec
from tgdsl.sensors import KINDS, Kind
from tgdsl.sensors.base import AnySensorSpec, ProbeSpec
from tgdsl.sensors.known import known_kinds
from tgdsl.sensors.noise import NoiseSpec
from tgdsl.sensors.noise.pipeline import more_knobs
from tgdsl.sensors.noise.spec import noise_model

Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][A-Za-z0-9_-]*$")]


class RobotSpec(SpecModel):
    """The robot and where its taxels sit."""

    model: str
    """MJCF, URDF or USD file, relative to this document; or the name of a robot that comes with tgdsl, such as `xhand1`."""
    layout: Annotated[Text | Annotated[LayoutSpec, Tag("other")], TEXT_OR_OTHER] | None = None
    """Layout file, relative to this document, or the same mapping in line; default: the layout of a robot given by name.
    Not needed where no sensor reads taxels, such as `link_contact`: these are then on any of the robot's bodies."""
    collision: Literal["mesh", "primitive"] = "mesh"
    """What links collide with, in the scene too: `mesh`: the model's own geoms, meshes by their convex hulls; `primitive`: the
    capsules, spheres and boxes of `colliders.yaml` beside the model in their place, which are faster. Taxels stay where they
    are."""


class SceneSpec(SpecModel):
    """The scene that is simulated."""

    model: str
    """MJCF file that holds the robot, its body names unchanged, and the objects."""


class Spec(SpecModel):
    """What is felt: robot, scene, objects, sensors, noise and observations."""

    tgdsl: Literal[1]
    """Version of the grammar."""
    robot: RobotSpec
    """The robot and its layout."""
    scene: SceneSpec | None = None
    """Robot and objects in one MuJoCo scene; default: the robot's own file."""
    objects: dict[Name, ObjectSpec] = {}
    """What taxels can feel; nothing else is modelled."""
    resolution: str | None = None
    """One of the layout's resolutions; may be left out where it has only one."""
    sensors: Annotated[dict[Name, ProbeSpec], Field(min_length=1)]
    """Sensors by name."""
    noise: dict[Name, NoiseSpec] = {}
    """Named noise profiles, beside the built-in `clean` and `noisy`."""
    observations: dict[Name, Annotated[tuple[ObservationSpec, ...], Field(min_length=1)]] = {}
    """What policies read: groups of observation terms, concatenated in order."""


def document_model(kinds: tuple[Kind, ...] = KINDS, needs_sensors: bool = True) -> type[Spec]:
    """Return the document model whose sensors are of the given kinds, with the knobs of all known stages of noise."""
    return _document_model(kinds, needs_sensors, more_knobs())


@cache
def _document_model(kinds: tuple[Kind, ...], needs_sensors: bool, knobs: tuple[type[SpecModel], ...]) -> type[Spec]:
    noise: Any = noise_model(knobs)
    specs = tuple(kind.spec for kind in kinds)
    if knobs:
        field: Any = Annotated[Text | Annotated[noise, Tag("other")], TEXT_OR_OTHER]
        about = AnySensorSpec.model_fields["noise"]
        described = Field(default=about.default, description=about.description)
        specs = tuple(create_model(own.__name__, __base__=own, __doc__=own.__doc__, noise=(field, described)) for own in specs)
    union: Any = Annotated[Union[specs], Field(discriminator="kind")] if len(specs) > 1 else specs[0]  # type: ignore  # noqa: UP007
    need: dict[str, Any] = {"min_length": 1} if needs_sensors else {"default": {}}
    sensors = (dict[Name, union], Field(description="Sensors by name.", **need))
    profiles = (dict[Name, noise], Spec.model_fields["noise"])
    return create_model("Document", __base__=Spec, __doc__=Spec.__doc__, sensors=sensors, noise=profiles)


def json_schema(kinds: tuple[Kind, ...] | None = None) -> dict[str, Any]:
    """Return the JSON Schema of documents and of layout files, for editors; default: with all kinds of `known_kinds`."""
    document = document_model(known_kinds() if kinds is None else kinds).model_json_schema(ref_template="#/$defs/{model}")
    layout = LayoutSpec.model_json_schema(ref_template="#/$defs/{model}")
    layout["required"] = sorted({*layout["required"], "tgdsl"})
    definitions = {**layout.pop("$defs", {}), **document.pop("$defs", {})}
    document.pop("title", None)
    layout.pop("title", None)
    definitions |= {"Document": document, "Layout": layout}
    definitions = {name: conditional(definition, definitions) for name, definition in definitions.items()}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "tgdsl document or layout",
        "type": "object",
        "if": {"required": ["resolutions"]},
        "then": {"$ref": "#/$defs/Layout"},
        "else": {"$ref": "#/$defs/Document"},
        "$defs": dict(sorted(definitions.items())),
    }

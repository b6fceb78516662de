"""The document a user writes: robot, scene, objects, sensors, noise profiles, observations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Annotated, Any, Literal, Union

from pydantic import Field, StringConstraints, Tag, create_model

from tgdsl.fields.models import TEXT_OR_OTHER, SpecModel, Text
from tgdsl.observations.observations import TYPES, Observation, ObservationSpec
from tgdsl.schema.objects import ObjectSpec
from tgdsl.schema.placement import LayoutSpec
from tgdsl.sensors import KINDS, Kind
from tgdsl.sensors.base import AnySensorSpec, ProbeSpec
from tgdsl.sensors.known import known_kinds
from tgdsl.sensors.noise import NoiseSpec
from tgdsl.sensors.noise.pipeline import more_knobs
from tgdsl.sensors.noise.profiles import noise_model

Schema = dict[str, Any]
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][A-Za-z0-9_-]*$")]


class RobotSpec(SpecModel):
    """The robot and where its taxels sit."""

    model: str
    """MJCF, URDF or USD file, relative to this document; or the name of a robot that comes with tgdsl, such as `xhand1`."""
    layout: Annotated[Text | Annotated[LayoutSpec, Tag("other")], TEXT_OR_OTHER] | None = None
    """Layout file, relative to this document, or the same mapping in line; default: the layout of a robot given by name.
    Not needed if no sensor reads taxels, as `link_contact` does not: sensors may then be on any of the robot's bodies."""
    collision: Literal["mesh", "primitive"] = "mesh"
    """What links collide with, in the scene too: `mesh`: the model's own geoms, meshes by their convex hulls; `primitive`: the
    capsules, spheres and boxes of `colliders.yaml` next to the model instead, which are faster. Taxels stay in place."""


class SceneSpec(SpecModel):
    """The scene that is simulated."""

    model: str
    """MJCF file that holds the robot, its body names unchanged, and the objects."""


class Spec(SpecModel):
    """A tactile document: robot, scene, objects, sensors, noise and observations."""

    tgdsl: Literal[1]
    """Version of the grammar."""
    robot: RobotSpec
    """The robot and its layout."""
    scene: SceneSpec | None = None
    """Robot and objects in one MuJoCo scene; default: the robot's own file."""
    objects: dict[Name, ObjectSpec] = {}
    """Objects that taxels can sense; nothing else is modelled."""
    resolution: str | None = None
    """One of the layout's resolutions; may be left out where it has only one."""
    sensors: Annotated[dict[Name, ProbeSpec], Field(min_length=1)]
    """Sensors by name."""
    noise: dict[Name, NoiseSpec] = {}
    """Named noise profiles, in addition to the built-in `clean` and `noisy`."""
    observations: dict[Name, Annotated[tuple[ObservationSpec, ...], Field(min_length=1)]] = {}
    """What policies read: groups of observation terms, concatenated in order."""


def document_model(kinds: tuple[Kind, ...] = KINDS, needs_sensors: bool = True) -> type[Spec]:
    """Return the document model with sensors of the given kinds, all known stages of noise and types of observations."""
    return _document_model(kinds, needs_sensors, more_knobs(), TYPES.known())


@cache
def _document_model(
    kinds: tuple[Kind, ...], needs_sensors: bool, knobs: tuple[type[SpecModel], ...], types: tuple[type[Observation], ...]
) -> type[Spec]:
    noise: Any = noise_model(knobs)
    specs = tuple(kind.spec for kind in kinds)
    if knobs:
        field: Any = Annotated[Text | Annotated[noise, Tag("other")], TEXT_OR_OTHER]
        about = AnySensorSpec.model_fields["noise"]
        described = Field(default=about.default, description=about.description)
        specs = tuple(create_model(s.__name__, __base__=s, __doc__=s.__doc__, noise=(field, described)) for s in specs)
    union: Any = Annotated[Union[specs], Field(discriminator="kind")] if len(specs) > 1 else specs[0]  # type: ignore  # noqa: UP007
    need: dict[str, Any] = {"min_length": 1} if needs_sensors else {"default": {}}
    sensors = (dict[Name, union], Field(description="Sensors by name.", **need))
    profiles = (dict[Name, noise], Spec.model_fields["noise"])
    term: Any = Annotated[Union[types], Field(discriminator="type")]  # type: ignore  # noqa: UP007
    groups = (dict[Name, Annotated[tuple[term, ...], Field(min_length=1)]], Spec.model_fields["observations"])
    parts = {"sensors": sensors, "noise": profiles, "observations": groups}
    return create_model("Document", __base__=Spec, __doc__=Spec.__doc__, **parts)


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


def conditional(schema: Any, definitions: Mapping[str, Schema]) -> Any:
    """Return a schema that accepts the same values, with `if`, `then` and `else` instead of `anyOf`.

    For `anyOf` an editor only reports that no branch fits, at the whole value: a misspelt key underlines the sensor. For `if`
    and `then` it reports the mistake in the branch that applies. Branches are distinguished by JSON type, by a key, or by its
    value. `definitions` resolve references.
    """
    if isinstance(schema, list):
        return [conditional(part, definitions) for part in schema]
    if not isinstance(schema, dict):
        return schema
    branches = _branches(schema)
    result = {
        key: conditional(value, definitions) for key, value in schema.items() if not branches or key not in ("anyOf", "oneOf")
    }
    if not branches:
        return result
    by_type: dict[str, list[Schema]] = {"object": [], "array": [], "": []}
    for branch in branches:
        kind = str(_target(branch, definitions).get("type"))
        by_type[kind if kind in by_type else ""].append(branch)
    if len(by_type["array"]) > 1 or not (by_type["object"] or by_type["array"]):
        return result | {"anyOf": [conditional(branch, definitions) for branch in branches]}
    objects = _of_objects(by_type["object"], definitions, _discriminator(schema))
    chain: Schema = {"anyOf": [conditional(leaf, definitions) for leaf in by_type[""]]} if by_type[""] else {}
    if by_type["array"]:
        chain = _if({"type": "array"}, conditional(by_type["array"][0], definitions), chain or {"type": "object"})
    return result | (_if({"type": "object"}, objects, chain) if chain and by_type["object"] else objects or chain)


def _branches(schema: Schema) -> list[Schema]:
    choices = schema.get("anyOf") or schema.get("oneOf") or []
    inner = [(_branches(part) if not part.keys() - {"anyOf", "oneOf", "discriminator"} else []) or [part] for part in choices]
    return [part for parts in inner for part in parts]


def _discriminator(schema: Schema) -> Mapping[str, Any]:
    choices = schema.get("anyOf") or schema.get("oneOf") or []
    inner = (_discriminator(part) for part in choices if isinstance(part, dict))
    return schema.get("discriminator") or next((result for result in inner if result), {})


def _target(schema: Schema, definitions: Mapping[str, Schema]) -> Schema:
    return definitions[schema["$ref"].removeprefix("#/$defs/")] if "$ref" in schema else schema


def _of_objects(branches: Sequence[Schema], definitions: Mapping[str, Schema], discriminator: Mapping[str, Any]) -> Schema:
    """Return one schema for several mappings, distinguished by a key's value, or by a key that only one of them requires."""
    if len(branches) < 2:
        return conditional(branches[0], definitions) if branches else {}
    chain: Schema = {}
    if key := discriminator.get("propertyName"):
        mapping: Mapping[str, str] = discriminator["mapping"]
        for value, reference in reversed(list(mapping.items())):
            chain = _if({"properties": {key: {"const": value}}, "required": [key]}, {"$ref": reference}, chain)
        return {"type": "object", "properties": {key: {"enum": list(mapping)}}, "required": [key]} | chain
    needed = [set(_target(branch, definitions).get("required", ())) for branch in branches]
    for i, branch in reversed(list(enumerate(branches))):
        only = sorted(needed[i].difference(*needed[:i], *needed[i + 1 :]))
        if not only:
            return {"anyOf": [conditional(part, definitions) for part in branches]}
        named = {"anyOf": [{"required": [key]} for key in only]} if len(only) > 1 else {"required": only}
        chain = _if(named, conditional(branch, definitions), chain or {"anyOf": list(branches)})
    return {"type": "object"} | chain


def _if(condition: Schema, then: Schema, other: Schema) -> Schema:
    return {"if": condition, "then": then, "else": other}

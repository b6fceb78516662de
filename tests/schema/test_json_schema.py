"""The JSON Schema agrees with the loader, by a small validator of the keywords that it uses."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from documents import DOCUMENT, LAYOUT, POISSON, read, valid
from wrong import WRONG, WRONG_LAYOUT

from tgdsl.errors import SpecError
from tgdsl.files.find import robots_folder
from tgdsl.schema import yaml
from tgdsl.schema.document import json_schema
from tgdsl.schema.load import load
from tgdsl.sensors import KINDS

SCHEMA = json_schema()
TYPES = {"object": dict, "array": list, "string": str, "number": (int, float), "integer": int, "null": type(None)}
ANNOTATIONS = {"$schema", "$defs", "title", "description", "default", "discriminator", "then", "else"}


def accepts(schema: dict[str, Any], value: Any) -> bool:
    return all(holds(key, schema, value) for key in schema if key not in ANNOTATIONS)


def holds(key: str, schema: dict[str, Any], value: Any) -> bool:
    """Return whether one keyword of draft 2020-12 holds; unknown keywords raise an error."""
    expected = schema[key]
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    match key:
        case "$ref":
            return accepts(SCHEMA["$defs"][expected.removeprefix("#/$defs/")], value)
        case "type":
            return isinstance(value, TYPES[expected]) and (expected == "boolean" or not isinstance(value, bool))
        case "const":
            return value == expected
        case "enum":
            return value in expected
        case "anyOf":
            return any(accepts(part, value) for part in expected)
        case "oneOf":
            return sum(accepts(part, value) for part in expected) == 1
        case "if":
            return accepts(schema["then" if accepts(expected, value) else "else"], value)
        case "required":
            return not isinstance(value, dict) or set(expected) <= set(value)
        case "minProperties":
            return not isinstance(value, dict) or len(value) >= expected
        case "properties":
            return not isinstance(value, dict) or all(accepts(expected[k], v) for k, v in value.items() if k in expected)
        case "patternProperties":
            return not isinstance(value, dict) or all(
                accepts(part, v) for pattern, part in expected.items() for k, v in value.items() if re.search(pattern, k)
            )
        case "additionalProperties":
            if not isinstance(value, dict):
                return True
            others = [v for k, v in value.items() if k not in schema.get("properties", {})]
            return not others if expected is False else all(accepts(expected, v) for v in others)
        case "prefixItems":
            return not isinstance(value, list) or all(map(accepts, expected, value))
        case "items":
            return not isinstance(value, list) or all(accepts(expected, part) for part in value)
        case "minItems":
            return not isinstance(value, list) or len(value) >= expected
        case "maxItems":
            return not isinstance(value, list) or len(value) <= expected
        case "pattern":
            return not isinstance(value, str) or re.search(expected, value) is not None
        case "minimum":
            return not is_number or value >= expected
        case "maximum":
            return not is_number or value <= expected
        case "exclusiveMinimum":
            return not is_number or value > expected
    raise NotImplementedError(key)


def mistake_paths(schema: dict[str, Any], value: Any, path: yaml.Path = ()) -> set[str]:
    """Return where an editor shows mistakes: for `anyOf` and `oneOf`, only the value itself."""
    paths: set[str] = set()
    for key in schema:
        expected = schema[key]
        if key in ANNOTATIONS or holds(key, schema, value):
            continue
        if key == "$ref":
            paths |= mistake_paths(SCHEMA["$defs"][expected.removeprefix("#/$defs/")], value, path)
        elif key == "if":
            paths |= mistake_paths(schema["then" if accepts(expected, value) else "else"], value, path)
        elif key == "properties":
            paths |= {place for k, v in value.items() if k in expected for place in mistake_paths(expected[k], v, (*path, k))}
        elif key in ("patternProperties", "additionalProperties") and expected is not False:
            properties = schema.get("properties", {})
            part = expected if key == "additionalProperties" else next(iter(expected.values()))
            paths |= {place for k, v in value.items() if k not in properties for place in mistake_paths(part, v, (*path, k))}
        elif key == "additionalProperties":
            paths |= {yaml.path_text((*path, k)) for k in value if k not in schema.get("properties", {})}
        elif key in ("items", "prefixItems"):
            parts = [expected] * len(value) if key == "items" else expected
            pairs = zip(parts, value, strict=False)
            paths |= {place for i, (part, v) in enumerate(pairs) for place in mistake_paths(part, v, (*path, i))}
        else:
            paths.add(yaml.path_text(path))
    return paths


def plain(text: str) -> Any:
    return yaml.parse(text, "f").value


def test_the_schema_is_json_with_resolvable_references():
    text = json.dumps(SCHEMA)
    assert json.loads(text) == SCHEMA
    assert set(re.findall(r'"\$ref": "#/\$defs/(\w+)"', text)) <= set(SCHEMA["$defs"])
    assert SCHEMA["$schema"] == "https://json-schema.org/draft/2020-12/schema"


def test_good_documents_are_accepted():
    layout = robots_folder() / "xhand1" / "layout.yaml"
    for document in (plain(DOCUMENT), {"tgdsl": 1} | plain(LAYOUT), valid(), plain(layout.read_text("utf-8"))):
        assert accepts(SCHEMA, document)


BEYOND_A_SCHEMA = {
    "out of range",
    "two keys at odds",
    "colder than cold",
    "heat of nothing",
    "heat of an unknown volume",
    "missing layout",
    "duplicate key",
    "huge number",
    "an object that is nowhere",
    "not a name",
    "layout file that does not exist",
    "layout file with a name too long",
    "tab",
    "no resolution",
    "unknown object",
    "unknown sensor",
    "unknown noise profile",
    "unknown resolution",
    "knob in line",
    "knob of an own profile",
    "knob of some links",
    "profiles in a circle",
    "unknown profile to start from",
    "range the wrong way round",
}
"""Mistakes that only the loader finds: between keys, of names and files, and in the YAML itself."""


@pytest.mark.parametrize("name", sorted(set(WRONG) - {"empty", "tab", "null"}))
def test_wrong_documents_are_refused_if_a_schema_can(name):
    assert accepts(SCHEMA, plain(WRONG[name][0])) == (name in BEYOND_A_SCHEMA)


@pytest.mark.parametrize("name", sorted(WRONG_LAYOUT))
def test_wrong_layouts_are_refused_if_a_schema_can(name):
    layout = {"tgdsl": 1} | plain(LAYOUT.replace(POISSON, f"{POISSON[:-1]}, {WRONG_LAYOUT[name][0]}}}", 1))
    assert accepts(SCHEMA, layout) == (name in ("unordered box", "two of which one is wanted"))


IN_A_SENSOR = {
    "touch": {"kind": "contact", "links": "tips", "feels": ["ball"], "treshold": 0},
    "skin": {"kind": "elastomer", "links": {"includ": ["a"]}, "feels": ["ball"], "boundary": {"drag": -1, "pad": {"faing": 1}}},
    "force": {"kind": "kinematic_taxel", "links": "a", "feels": [3], "noise": {"whte_noise": 1, "read_delay": "4 mm"}},
    "near": {"kind": "proximity", "links": "a", "feels": ["ball"], "history": {"length": 0}, "rate": "50 m"},
    "typo": {"kind": "contct", "links": "a", "feels": ["ball"]},
    "pad": {"kind": "contact", "links": "a", "feels": ["ball"], "noise": {"links": {"a": {"bais": 1}}}},
}


def test_a_mistake_is_shown_where_the_loader_finds_it():
    """In all alternatives of sensors, the path is never just the sensor."""
    document = valid() | {"sensors": IN_A_SENSOR, "observations": {"policy": [{"type": "force", "fo": "x", "of": "touch"}]}}
    document["objects"] = {"ball": {"geom": {"type": "box", "size": ["4 N"]}}, "cup": {"variants": [{"mesh": "a", "scl": 1}]}}
    document["robot"]["layout"]["resolutions"]["low"]["a"] |= {"rows": 0, "region": [{"facing": [0, 0, "x"], "within": 1}]}
    with pytest.raises(SpecError) as caught:
        load(document).raise_problems()
    expected = {problem.path for problem in caught.value.problems}
    assert mistake_paths(SCHEMA, document) == expected
    assert len(expected) == 17 and not expected & {f"sensors.{name}" for name in IN_A_SENSOR}


def test_anyof_never_chooses_between_mappings():
    """`anyOf` chooses between plain values, or between mappings only if no key distinguishes them."""

    def choices(schema: Any, inside: str) -> set[str]:
        if isinstance(schema, list):
            return {choices_here for part in schema for choices_here in choices(part, inside)}
        if not isinstance(schema, dict):
            return set()
        alternatives = schema.get("anyOf", []) + schema.get("oneOf", [])
        mappings = [part for part in alternatives if "$ref" in part or "object" in part.get("type", "")]
        is_last = inside == "else" and len(mappings) == len(alternatives)  # where no key was found: any of them
        choices_here = {json.dumps(schema)} if mappings and not is_last else set()
        return choices_here | {choices_here for key, part in schema.items() for choices_here in choices(part, key)}

    assert choices(SCHEMA, "") == set()


QUANTITIES = ["4 mm", "4mm", "-4 mm", ".4e1 µm", "4.", "4", "4 mn", "4 MM", "mm", "4 mm 5", "", "٤ mm", "4 N", "1e-3 m"]


@pytest.mark.parametrize("text", QUANTITIES)
def test_patterns_of_units_agree_with_the_loader(tmp_path: Path, text):
    pos = f'{{method: points, radius: 0, points: [{{pos: ["{text}", 0, 0], normal: [0, 0, 1]}}]}}'
    layout = LAYOUT.replace(POISSON, pos)
    assert pos in layout
    try:
        read(tmp_path, layout=layout)
        is_valid = True
    except SpecError:
        is_valid = False
    assert accepts(SCHEMA, {"tgdsl": 1} | plain(layout)) == is_valid
    assert is_valid == (text in QUANTITIES[:6] + QUANTITIES[-1:])


def test_every_key_is_described():
    bare = [
        f"{name}.{key}"
        for name, definition in SCHEMA["$defs"].items()
        for key, value in definition.get("properties", {}).items()
        if not value.get("description")
    ]
    assert bare == []
    assert [name for name, definition in SCHEMA["$defs"].items() if not definition.get("description")] == []


def test_unknown_keys_are_refused_everywhere():
    assert [name for name, part in SCHEMA["$defs"].items() if part.get("additionalProperties") is not False] == []


def test_the_schema_has_all_kinds():
    sensors = SCHEMA["$defs"]["Document"]["properties"]["sensors"]
    (sensor,) = sensors["patternProperties"].values()
    assert set(sensor["discriminator"]["mapping"]) == {kind.name for kind in KINDS}
    only = json_schema(KINDS[:1])["$defs"]
    assert f"{KINDS[0].spec.__name__}" in only
    assert KINDS[1].spec.__name__ not in only

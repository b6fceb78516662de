"""YAML text to plain values and locations."""

import pytest

from tgdsl.schema import yaml


def messages_of(text: str) -> list[str]:
    return sorted(str(problem) for problem in yaml.parse(text, "f").problems)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("no", "no"),
        ("off", "off"),
        ("yes", "yes"),
        ("true", True),
        ("~", None),
        ("1e-3", 0.001),
        ("1E3", 1000.0),
        (".5", 0.5),
        ("-2", -2),
        ("010", 10),
        ("0o10", 8),
        ("1:30", "1:30"),
        ('"1"', "1"),
        (".inf", float("inf")),
        ("[a, {b: [1]}]", ["a", {"b": [1]}]),
        ("1: x\ntrue: y\n~: z", {"1": "x", "true": "y", "~": "z"}),
        ("\ufeffa: 1", {"a": 1}),
    ],
)
def test_values_follow_yaml_1_2(text, value):
    source = yaml.parse(text, "f")
    assert source.problems == []
    assert source.value == value
    assert type(source.value) is type(value)


def test_every_key_and_value_has_a_location():
    source = yaml.parse("a:\n  - b: 1\n    c: [2, 3]\n", "f")
    assert source.keys == {("a",): ("f", 1, 1), ("a", 0, "b"): ("f", 2, 5), ("a", 0, "c"): ("f", 3, 5)}
    assert source.values[()] == ("f", 1, 1)
    assert source.values["a", 0] == ("f", 2, 5)
    assert source.values["a", 0, "c", 1] == ("f", 3, 12)
    assert source.get(("a", 0, "c", 1)) == 3
    assert [source.get(path) for path in (("z",), ("a", 9), ("a", "b"), ("a", 0, "b", 0))] == [None] * 4


def test_documents_from_one_text_are_independent():
    """Overriding a value of one leaves the other unchanged."""
    first = yaml.parse("a: {b: [1]}\na: 2\n", "f")
    first.set("a.b", 5)
    first.value["a"]["c"] = 6
    first.problems.clear()
    second = yaml.parse("a: {b: [1]}\na: 2\n", "f")
    assert (second.value, second.values["a", "b"]) == ({"a": {"b": [1]}}, ("f", 1, 8))
    assert len(second.problems) == 1


def test_a_problem_is_located_at_the_nearest_existing_key():
    source = yaml.parse("a:\n  b: 1\n", "f")
    assert str(source.problem(("a", "b"), "bad")) == "f:2:6: a.b: bad"
    assert str(source.problem(("a", "b"), "bad", on_key=True)) == "f:2:3: a.b: bad"
    assert str(source.problem(("a", "c", 3), "bad", "so")) == "f:2:3: a.c[3]: bad; so"
    assert str(source.problem(("z",), "bad")) == "f:1:1: z: bad"
    assert str(yaml.from_mapping({"a": 1}, "<mapping>").problem(("a",), "bad")) == "<mapping>: a: bad"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "f:1:1: the document is empty"),
        ("# only a comment\n", "f:1:1: the document is empty"),
        ("a: 1\n\tb: 2\n", "f:2:1: not YAML: found character '\\t' that cannot start any token"),
        ("a: [1\nb: 2\n", "f:2:2: not YAML: expected ',' or ']', but got ':'"),
        ("a: 1\n---\nb: 2\n", "f:2:1: not YAML: but found another document"),
        ("a: *x\n", "f:1:4: not YAML: found undefined alias 'x'"),
        ("a: 1\nb: 2\na: 3\n", "f:3:1: a: this key stands twice, first in line 1"),
        ("? [a]\n: 1\n", "f:1:3: a key must be a plain name"),
        ("a: &x [1, *x]\n", "f:1:4: a[1]: this alias contains itself"),
        ("a: &x {b: {c: *x}}\n", "f:1:4: a.b.c: this alias contains itself"),
        ("a: &x {<<: *x}\n", "f:1:4: a: this alias contains itself"),
        ("a: {<<: 3}\n", "f:1:9: a: only a mapping can be merged in"),
        ("a: !new 3\n", "f:1:4: a: cannot read this value: could not determine a constructor for the tag '!new'"),
        ("a: 2024-02-31\n", "f:1:4: a: cannot read this value: day is out of range for month"),
        ("a: !!bool maybe\n", "f:1:4: a: cannot read this value: 'maybe'"),
        ('a: !!int ""\n', "f:1:4: a: cannot read this value: string index out of range"),
        ("[" * 1000, "f:1:1: nested more than 50 deep"),
    ],
)
def test_invalid_yaml_is_located(text, message):
    assert messages_of(text) == [message]


def test_control_characters():
    assert messages_of("a: \0")[0].startswith("f:1:1: not YAML: unacceptable character #x0000")


def test_nesting_is_bounded():
    assert yaml.parse("[" * 50 + "]" * 50, "f").problems == []
    assert messages_of("[" * 60 + "]" * 60) == [f"f:1:52: {'[0]' * 51}: nested more than 50 deep"]
    loop: dict = {}
    loop["a"] = loop
    deep: dict | int = 1
    for _ in range(50):
        deep = {"a": deep}
    assert isinstance(deep, dict) and yaml.from_mapping(deep, "<mapping>").problems == []
    for mapping in (loop, {"a": deep}):
        source = yaml.from_mapping(mapping, "<mapping>")
        assert [problem.what for problem in source.problems] == ["nested more than 50 deep"]


def test_an_anchor_may_be_redefined():
    assert yaml.parse("a: &x 1\nb: *x\nc: &x 2\nd: *x\n", "f").value == {"a": 1, "b": 1, "c": 2, "d": 2}


MERGED = """\
one: &one {a: 1, b: 1}
two: &two {b: 2, c: 2}
"""


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("{<<: *one, a: 9}", {"a": 9, "b": 1}),
        ("{a: 9, <<: *one}", {"a": 9, "b": 1}),
        ("{<<: [*one, *two]}", {"a": 1, "b": 1, "c": 2}),
        ("{<<: [*two, *one]}", {"a": 1, "b": 2, "c": 2}),
        ("{<<: *one, <<: *two}", {"a": 1, "b": 1, "c": 2}),
    ],
)
def test_written_keys_override_merged_ones(text, value):
    source = yaml.parse(f"{MERGED}it: {text}\n", "f")
    assert source.problems == []
    assert source.get(("it",)) == value
    for key, number in value.items():
        line = 3 if number == 9 else number
        assert source.keys["it", key].line == source.values["it", key].line == line
    assert source.values[("it",)] == ("f", 3, 5)


def test_a_repeated_key_is_refused_but_an_overridden_merge_is_not():
    assert messages_of(f"{MERGED}it:\n  a: 7\n  <<: *one\n  a: 8\n") == ["f:6:3: it.a: this key stands twice, first in line 4"]


def test_mappings_built_in_python_are_read_like_text():
    source = yaml.from_mapping({"a": ({1: "x"}, [2])}, "<mapping>")
    assert source.value == {"a": [{"1": "x"}, [2]]}

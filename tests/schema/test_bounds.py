"""Documents that are made to be large are refused at a place, by name, before they cost much time or memory."""

import numpy as np
import pytest

import tgdsl
from tgdsl.errors import SpecError
from tgdsl.fields import units
from tgdsl.schema import yaml
from tgdsl.schema.load import load, load_layout

MANY = "more than 100000 names and values, aliases counted as what they stand for; long lists of points go into a CSV file beside the layout"
LARGE = "more than 2097152 bytes, comments included; long lists of points go into a CSV file beside the layout"


def said(path) -> list[str]:
    with pytest.raises(SpecError) as caught:
        load(path)
    return str(caught.value).splitlines()


def laughs(levels: int, width: int, merge: str = "") -> str:
    """Return aliases of aliases: width ** levels values."""
    names = [f"a{i}" for i in range(levels)]
    lines = [f"a0: &a0 [{', '.join(['1'] * width)}]" if not merge else "a0: &a0 {x: 1}"]
    for one, other in zip(names[1:], names, strict=False):
        inner = ", ".join([f"*{other}"] * width)
        lines.append(f"{one}: &{one} {{<<: [{inner}]}}" if merge else f"{one}: &{one} [{inner}]")
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("text", "place"),
    [(laughs(9, 10), "5:5"), (laughs(40, 2), "16:6"), (laughs(9, 10, "<<"), "6:14")],
    ids=["1e9", "2^40", "merged"],
)
def test_aliases_that_unfold_to_a_multitude(tmp_path, text, place):
    """The first value that holds too many is named, and nothing is unfolded: 10^5 and 2^17 are the first powers beyond the bound."""
    source = yaml.parse(text, "f")
    assert source.value is None and source.values == source.keys == {}
    assert [str(problem) for problem in source.problems] == [f"f:{place}: {MANY}"]
    (tmp_path / "hand.yaml").write_text(text)
    assert said(tmp_path / "hand.yaml") == [f"{tmp_path / 'hand.yaml'}:{place}: {MANY}"]


def test_the_bound_is_exact(monkeypatch):
    monkeypatch.setattr(yaml, "MAX_NODES", 12)
    for text in ("a: [1, 2, 3, 4, 5, 6, 7, 8, 9]", "a: &a [1, 2, 3]\nb: [*a]", "a: &a {b: {c: [*a, *a, 1, 2, 3]}}"):
        source = yaml.parse(text, "f")
        assert all(problem.what == "this alias contains itself" for problem in source.problems)
        assert 10 <= len(source.values) + len(source.keys) <= 12, "the mapping itself counts too"
    for text, place in (
        ("a: [1, 2, 3, 4, 5, 6,\n7, 8, 9, 10]", (2, 10)),
        ("a: &a [1, 2, 3]\nb: [*a, *a]", (1, 1)),
        ("a: &a [1, 2]\nb: [*a, *a, *a, *a]", (2, 4)),
        ("a: &a {b: 1, c: 2}\nd: {<<: [*a, *a, *a]}", (2, 14)),
    ):
        (problem,) = yaml.parse(text, "f").problems
        assert (problem.line, problem.column, problem.path) == (*place, "")
    assert yaml.from_mapping({"a": list(range(10))}, "<mapping>").problems == []
    (problem,) = yaml.from_mapping({"a": list(range(11))}, "<mapping>").problems
    assert (problem.line, problem.path) == (0, "a[10]")


def test_a_long_list_of_numbers(tmp_path):
    (tmp_path / "hand.yaml").write_text("a: [\n" + "1, " * 2_000_000 + "]")
    assert said(tmp_path / "hand.yaml") == [f"{tmp_path / 'hand.yaml'}:2:1: {LARGE}"]


def test_much_comment(tmp_path):
    text = "# comment\n" * 1_000_000
    (tmp_path / "hand.yaml").write_text(text)
    line = yaml.MAX_BYTES // 10 + 1
    assert said(tmp_path / "hand.yaml") == [f"{tmp_path / 'hand.yaml'}:{line}:1: {LARGE}"]
    with pytest.raises(SpecError) as caught:
        load_layout(tmp_path / "hand.yaml")
    assert str(caught.value).endswith(LARGE)
    (tmp_path / "hand.yaml").write_bytes(b"a: 1\n".ljust(yaml.MAX_BYTES, b"#"))
    assert LARGE not in said(tmp_path / "hand.yaml")[0], "the largest that is read"


def test_a_file_without_an_end():
    assert said("/dev/zero") == [f"/dev/zero:1:1: {LARGE}"]


def test_long_texts():
    long = "x" * (yaml.MAX_TEXT + 1)
    what = f"found a text of {len(long)} characters, expected at most {yaml.MAX_TEXT}"
    assert [str(problem) for problem in yaml.parse(f"a: {long}", "f").problems] == [f"f:1:4: a: {what}"]
    assert [str(problem) for problem in yaml.parse(f"? {long}\n: 1", "f").problems] == ["f:1:3: a key must be a plain name"]
    assert [str(problem) for problem in yaml.from_mapping({"a": [long]}, "m").problems] == [f"m: a[0]: {what}"]
    assert yaml.parse(f"a: {long[1:]}", "f").value == {"a": long[1:]}


def test_documents_built_in_python():
    laugh: list = [1] * 10
    for _ in range(8):
        laugh = [laugh] * 10
    for document in ({"tgdsl": laugh}, {"tgdsl": 1, "sensors": {"x": laugh}}):
        with pytest.raises(SpecError) as caught:
            tgdsl.compile(document)
        (problem,) = caught.value.problems
        assert str(problem).startswith("<mapping>: ") and str(problem).endswith(MANY)


def test_overrides_are_bounded_too():
    with pytest.raises(SpecError) as caught:
        load({"tgdsl": 1}, {"sensors": laughs(9, 10)})
    assert next(problem.what for problem in caught.value.problems if problem.hint) + "; " in MANY


@pytest.mark.parametrize(
    "text", ["1" * 10**6 + "!", "1" + " " * 10**6 + "!", "1." + "1" * 10**6 + "!", "1 " + "m*" * 10**6 + "!"]
)
def test_a_quantity_is_read_once_over(text):
    """A pattern that tries every way to part a run of digits would take days."""
    with pytest.raises(ValueError, match="is not a quantity"):
        units.parse(text, "length")


@pytest.mark.parametrize("text", ["4 mm", "4mm", " -4.e-3 m ", "+.004", "4e-3m", "4E-3"])
def test_quantities_are_read_as_before(text):
    assert abs(units.parse(text, "length")) == pytest.approx(0.004, rel=np.finfo(float).eps)

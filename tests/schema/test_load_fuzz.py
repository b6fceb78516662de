"""Whatever a document contains, only SpecError is raised, with a printable message."""

import warnings
from pathlib import Path

import pytest
from documents import DOCUMENT, valid, write
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tgdsl.errors import SpecError
from tgdsl.schema.load import load

FUZZ = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])

WORDS = sorted(set(DOCUMENT.replace(":", " ").split()) | {"noise", "observations", "scene", "grid", "points", "box"})
SCALARS = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8), st.sampled_from(WORDS), st.dates()
)
KEYS_OR_TEXT = st.one_of(st.sampled_from(WORDS), st.text(max_size=4))
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(KEYS_OR_TEXT, inner, max_size=4)),
    max_leaves=12,
)


def assert_only_spec_errors(document: object, overrides: dict[str, str] | None = None) -> None:
    message = "nothing"
    with warnings.catch_warnings():  # unusual but possible values
        warnings.filterwarnings("ignore", r"(?s).*, usually at (most|least) ", UserWarning)
        try:
            load(document, overrides).raise_problems()  # type: ignore[arg-type]
        except SpecError as error:
            message = str(error)
    assert message.encode()


def paths_of(value: object, path: tuple = ()) -> list[tuple]:
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path] + [inner_path for key, part in inner for inner_path in paths_of(part, (*path, key))]


def test_a_radius_of_a_metre_is_a_warning_not_an_error():
    document = valid()
    document["robot"]["layout"]["resolutions"]["low"]["b"]["points"][0]["radius"] = 1
    with pytest.warns(UserWarning, match=r"points\[0\]\.radius: found 1 m, usually at most 0\.1 m"):
        assert load(document).problems == []
    assert_only_spec_errors(document)


def test_the_fuzzed_document_is_valid():
    assert load(valid()).problems == []


@FUZZ
@given(st.data())
def test_replaced_parts_raise_only_spec_errors(data):
    document = valid()
    for _ in range(data.draw(st.integers(1, 2))):
        path = data.draw(st.sampled_from(paths_of(document)[1:]))
        parent = document
        for part in path[:-1]:
            parent = parent[part]
        if isinstance(parent, dict) and data.draw(st.booleans()):
            del parent[path[-1]]
            parent[data.draw(KEYS_OR_TEXT)] = data.draw(VALUES)
        else:
            parent[path[-1]] = data.draw(VALUES)
    assert_only_spec_errors(document)


@FUZZ
@given(st.dictionaries(KEYS_OR_TEXT, VALUES, max_size=8))
def test_arbitrary_mappings_raise_only_spec_errors(document):
    assert_only_spec_errors(document)


LINES = DOCUMENT.splitlines(keepends=True)
PIECES = st.one_of(
    st.sampled_from(LINES),
    st.sampled_from(["  ", "\t", ": ", "- ", "[", "]", "{", "}", "&a ", "*a", "<<: ", "? ", "!!int ", "!!set ", "|\n"]),
    st.sampled_from(["!!timestamp ", "!!binary ", "%YAML 1.1\n", "---\n", "=", "0x", "1e400", ".nan"]),
    st.text(max_size=4),
)


@FUZZ
@given(text=st.one_of(st.lists(PIECES, max_size=12).map("".join), st.text()))
def test_arbitrary_text_raises_only_spec_errors(tmp_path: Path, text):
    assert_only_spec_errors(write(tmp_path, text))


@FUZZ
@given(data=st.data())
def test_inserted_text_raises_only_spec_errors(tmp_path: Path, data):
    text = DOCUMENT
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(text)))
        text = text[:at] + data.draw(PIECES) + text[at + data.draw(st.integers(0, 3)) :]
    assert_only_spec_errors(write(tmp_path, text))


@FUZZ
@given(data=st.data())
def test_arbitrary_overrides_raise_only_spec_errors(tmp_path: Path, data):
    key = ".".join(data.draw(st.lists(KEYS_OR_TEXT, min_size=1, max_size=4)))
    text = data.draw(st.one_of(st.text(max_size=10), PIECES))
    assert_only_spec_errors(write(tmp_path), {key: text})

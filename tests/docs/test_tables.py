"""What pages say of the code is what the code says: tables of kinds and extras, the rooms, the example's kinds."""

import importlib
import inspect
import re
import tomllib
from pathlib import Path

import pytest

from tgdsl.commands.examples import example_names
from tgdsl.sensors import KINDS

REPOSITORY = Path(__file__).parents[2]
FIRST_CELL = re.compile(r"^\| `(\w+)` \|", re.M)


def text_of(name: str) -> str:
    return (REPOSITORY / name).read_text(encoding="utf-8")


def test_the_comparison_has_every_kind_with_its_file():
    (table,) = (block for block in text_of("docs/start/which-kind.md").split("\n\n") if block.startswith("| to know"))
    files = dict(re.findall(r"^\|[^|]*\| \[`(\w+)`\]\(\.\./\.\./(tgdsl/[^)]+)\) \|", table, re.M))
    assert files.keys() == {kind.name for kind in KINDS} and len(table.splitlines()) == len(KINDS) + 2
    for kind in KINDS:
        assert files[kind.name] in {part.__module__.replace(".", "/") + ".py" for part in (kind.forward, kind.spec)}


def test_the_page_of_installing_has_every_extra():
    extras = tomllib.loads(text_of("pyproject.toml"))["project"]["optional-dependencies"]
    assert set(FIRST_CELL.findall(text_of("docs/start/install.md"))) == extras.keys()


def test_the_list_of_examples_has_each_with_existing_pictures():
    text = text_of("examples/README.md")
    files = [file.relative_to(REPOSITORY / "examples").as_posix() for file in example_names().values()]
    assert [file for file in files if f"]({file})" not in text] == []
    assert [link for link in re.findall(r"\]\(([^)]+)\)", text) if not (REPOSITORY / "examples" / link).exists()] == []


def test_every_kind_has_its_example():
    found = set(re.findall(r"\bkind: (\w+)", text_of("examples/every_sensor.yaml")))
    assert found == {kind.name for kind in KINDS}


@pytest.mark.parametrize("room", sorted(p.name for p in (REPOSITORY / "tgdsl").iterdir() if (p / "__init__.py").is_file()))
def test_the_architecture_names_every_room(room):
    assert re.search(rf"\b{room}\b", text_of("docs/reference/architecture.md"))


def test_comments_on_fields_of_documented_classes_are_shown(monkeypatch):
    """Sphinx shows comments that begin with `#:`, and leaves others out."""
    monkeypatch.syspath_prepend(REPOSITORY / "docs/_ext")
    from tgdsl_docs.api import api_pages

    paths = re.findall(r"autoclass:: ([\w.]+)\.(\w+)$", "\n".join(api_pages().values()), re.M)
    assert ("tgdsl.sensors.base", "Lowered") in paths
    for module, name in paths:
        documented = getattr(importlib.import_module(module), name)
        if inspect.isclass(documented):
            hidden = re.findall(
                r"^    (?!_)\w+: .*  # (?!type:|noqa)|^    # .*\n    (?!_)\w+: ", inspect.getsource(documented), re.M
            )
            assert not hidden, f"{module}.{name}"

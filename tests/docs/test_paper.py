"""The tables that compare the paper with tgdsl have the values of tgdsl's documents."""

import re
from collections.abc import Mapping
from pathlib import Path

import pytest
from pydantic import BaseModel
from ruamel.yaml import YAML

from tgdsl.rl.load import load_task
from tgdsl.rl.tasks.in_palm_rotate import InPalmRotate

REPOSITORY = Path(__file__).parents[2]
SECTIONS = re.split(r"^## ", (REPOSITORY / "docs" / "records" / "paper.md").read_text(encoding="utf-8"), flags=re.M)[1:]
NAMED = {section.partition("\n")[0]: section for section in SECTIONS}
KEYED = {name: section for name, section in NAMED.items() if re.search(r"^(Document|Defaults): ", section, re.M)}
PUBLISHED = {name: section for name, section in NAMED.items() if "Published: `" in section}
ENTRY = re.compile(r"`([a-z_.]+): ([^`]+)`")
CODE, TGDSL, COMPARED = 2, 3, 4
"""Columns: what the authors' code has, tgdsl's document, and the published one."""


def spec_of(section):
    document = re.search(r"^Document: `([^`]+)`", section, re.M)
    if document:
        return load_task(REPOSITORY / document[1]).spec
    return InPalmRotate.Spec(tgdsl=1, task="in_palm_rotate", document="palm.yaml", object="item", joints=("a",))


def rows_of(section):
    lines = [line for line in section.splitlines() if line.startswith("| ")][1:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def entries_of(section, column=TGDSL):
    return [entry for row in rows_of(section) for entry in ENTRY.findall(row[column])]


def value_of(spec, key, terms=None):
    owner = {"terms": terms} if key.startswith("terms.") else spec
    for name in key.split("."):
        owner = getattr(owner, name) if isinstance(owner, BaseModel) else owner[name]
    return list(owner) if isinstance(owner, tuple) else owner


def differences(entries, spec, terms=None):
    wrong = []
    for key, text in entries:
        shown, value = YAML(typ="safe", pure=True).load(text), value_of(spec, key, terms)
        is_text = (
            isinstance(value, str | bool | Mapping) or value is None or (isinstance(value, list) and isinstance(value[0], str))
        )
        if not (shown == value if is_text else shown == pytest.approx(value, rel=1e-4)):
            wrong.append(f"{key}: {text}, but the document has {value}")
    return wrong


@pytest.mark.parametrize("name", KEYED)
def test_each_key_of_the_page_has_its_value(name):
    entries = entries_of(KEYED[name])
    assert entries
    wrong = differences(entries, spec_of(KEYED[name]))
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("name", PUBLISHED)
def test_each_key_of_the_published_documents_has_its_value(name):
    loaded = load_task(REPOSITORY / re.search(r"Published: `([^`]+)`", PUBLISHED[name])[1])
    entries = entries_of(PUBLISHED[name], COMPARED)
    assert entries
    wrong = differences(entries, loaded.spec, loaded.terms)
    assert not wrong, "\n".join(wrong)


def test_each_setting_of_the_authors_code_has_a_key_in_a_published_document():
    stated = [(name, row) for name, section in NAMED.items() for row in rows_of(section) if row[CODE] != "–"]
    assert len(stated) > 30
    assert [(name, row[0]) for name, row in stated if not ENTRY.search(row[COMPARED])] == []


def test_the_page_has_all_weights_of_each_reward():
    for name in ("in_palm_rotate", "in_hand_repose", "screwdriver"):
        shown = {key.removeprefix("rewards.") for key, _ in entries_of(KEYED[name]) if key.startswith("rewards.")}
        weights = {key for key, field in type(spec_of(KEYED[name]).rewards).model_fields.items() if field.default}
        assert weights <= shown, f"{name}: {sorted(weights - shown)}"

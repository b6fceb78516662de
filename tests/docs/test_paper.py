"""The page that sets the paper beside tgdsl says what tgdsl's documents have."""

import re
from pathlib import Path

import pytest
from pydantic import BaseModel
from ruamel.yaml import YAML

from tgdsl.rl.load import load_task
from tgdsl.rl.tasks.in_palm_rotate import InPalmRotateSpec

REPOSITORY = Path(__file__).parents[2]
SECTIONS = re.split(r"^## ", (REPOSITORY / "docs" / "paper.md").read_text(encoding="utf-8"), flags=re.M)[1:]
KEYED = {section.partition("\n")[0]: section for section in SECTIONS if re.search(r"^(Document|Defaults): ", section, re.M)}
ENTRY = re.compile(r"`([a-z_.]+): ([^`]+)`")


def spec_of(section):
    document = re.search(r"^Document: `(.+)`", section, re.M)
    if document:
        return load_task(REPOSITORY / document[1]).spec
    return InPalmRotateSpec(tgdsl=1, task="in_palm_rotate", document="palm.yaml", object="item", joints=("a",))


def entries_of(section):
    rows = [line.split(" | ") for line in section.splitlines() if line.startswith("| ")]
    return [entry for row in rows[1:] for entry in ENTRY.findall(row[3])]


def value_of(spec, key):
    for name in key.split("."):
        spec = getattr(spec, name) if isinstance(spec, BaseModel) else spec[name]
    return list(spec) if isinstance(spec, tuple) else spec


@pytest.mark.parametrize("name", KEYED)
def test_each_key_of_the_page_has_its_value(name):
    spec, entries = spec_of(KEYED[name]), entries_of(KEYED[name])
    assert entries
    wrong = []
    for key, text in entries:
        shown, value = YAML(typ="safe", pure=True).load(text), value_of(spec, key)
        is_same = shown == value if isinstance(value, str | bool) or value is None else None
        if is_same is None and isinstance(value, list) and isinstance(value[0], str):
            is_same = shown == value
        if not (shown == pytest.approx(value, rel=1e-4) if is_same is None else is_same):
            wrong.append(f"{key}: {text}, but the document has {value}")
    assert not wrong, "\n".join(wrong)


def test_the_page_has_all_weights_of_each_reward():
    for name in ("in_palm_rotate", "in_hand_repose", "screwdriver"):
        shown = {key.removeprefix("rewards.") for key, _ in entries_of(KEYED[name]) if key.startswith("rewards.")}
        weights = {key for key, field in type(spec_of(KEYED[name]).rewards).model_fields.items() if field.default}
        assert weights <= shown, f"{name}: {sorted(weights - shown)}"

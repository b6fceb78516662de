"""Private parts of MuJoCo Warp: one file uses them, and an error names one that a version lacks."""

import ast
import re
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import mujoco_warp
import pytest

from tgdsl.errors import SimulationError
from tgdsl.runtime.warp.contacts import TRIED, constraint_contact_bit, contact_force_function

REPOSITORY = Path(__file__).parents[3]


def private_lines(file: Path) -> list[int]:
    """Return the lines that name `_src`: as an attribute, in an import, or alone in a string."""
    lines, text = [], file.read_text(encoding="utf-8")
    for node in ast.walk(ast.parse(text)) if "_src" in text else ():
        if isinstance(node, ast.ImportFrom):
            names = [node.module or "", *(alias.name for alias in node.names)]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.Attribute):
            names = [node.attr]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and " " not in node.value:
            names = [node.value]
        else:
            continue
        lines += [node.lineno for name in names if "_src" in name.split(".")]
    return lines


@pytest.mark.parametrize(
    ("text", "is_private"),
    [
        ("mjw._src.types", True),
        ("import mujoco_warp._src.support", True),
        ("from mujoco_warp._src import types", True),
        ("from mujoco_warp import _src", True),
        ("getattr(mjw, '_src')", True),
        ("import mujoco_warp; mujoco_warp.step", False),
        ("'the folder _src is private'", False),
    ],
)
def test_private_lines_finds_private_names(tmp_path, text, is_private):
    (tmp_path / "one.py").write_text(text)
    assert bool(private_lines(tmp_path / "one.py")) is is_private


def test_no_other_file_uses_private_parts():
    allowed = {"tgdsl/runtime/warp/contacts.py", Path(__file__).relative_to(REPOSITORY).as_posix()}
    folders = ("tgdsl", "tests", "benchmarks", "examples", "robots")
    files = {
        file.relative_to(REPOSITORY).as_posix(): file for folder in folders for file in (REPOSITORY / folder).rglob("*.py")
    }
    assert allowed <= files.keys()
    assert {name for name, file in files.items() if private_lines(file)} <= allowed


def test_the_installed_version_has_the_private_parts_and_was_tried():
    assert version("mujoco-warp") in TRIED
    assert constraint_contact_bit(mujoco_warp) == 1
    assert contact_force_function(mujoco_warp).key == "contact_force_fn"


def test_an_error_names_a_missing_private_part():
    bare = SimpleNamespace(_src=SimpleNamespace(types=SimpleNamespace()))
    for function, path in ((contact_force_function, "support.contact_force_fn"), (constraint_contact_bit, "types.ContactType")):
        with pytest.raises(SimulationError, match=re.escape(f"has no `{path}")) as caught:
            function(bare)
        assert version("mujoco-warp") in str(caught.value) and "tried was 3.11.0, 3.17.0" in str(caught.value)

"""`tgdsl examples`: copies are complete, and the user's files are not overwritten."""

import filecmp
from pathlib import Path

import mujoco
import pytest

from tgdsl.commands.examples import example_names
from tgdsl.rl.load import load_task

REPOSITORY = Path(__file__).parents[2]
SCENES = {"pyramid": 0, "plugins/plugins": 1, "tasks/find_ridge": 1, "tasks/published/screwdriver": 1}
"""Examples and their numbers of robots."""


def copies(folder: Path) -> dict[str, Path]:
    return {file.relative_to(folder).as_posix(): file for file in folder.rglob("*") if file.is_file()}


@pytest.mark.parametrize("name", SCENES)
def test_a_copy_is_complete(name, tmp_path, here):
    code, out, errors = here(tmp_path, "examples", "copy", name)
    assert code == 0, errors
    files = copies(tmp_path)
    assert f"examples/{name}.yaml" in files and f"examples/{name}.yaml\n" in out
    assert all(filecmp.cmp(file, REPOSITORY / path, shallow=False) for path, file in files.items())
    for path, file in files.items():
        if path.startswith("examples/") and file.suffix == ".xml":
            mujoco.MjModel.from_xml_path(str(file))
    assert len([path for path in files if path.endswith("_right.xml")]) == SCENES[name]


def test_a_task_is_copied_with_its_class_and_its_policy(tmp_path, here):
    code, _, errors = here(tmp_path, "examples", "copy", "examples/tasks/find_ridge.yaml", "-o", "new/folder")
    assert code == 0, errors
    folder = tmp_path / "new" / "folder"
    loaded = load_task(folder / "examples" / "tasks" / "find_ridge.yaml")
    assert loaded.spec.task == "find_ridge.py:FindRidge"
    assert {path for path in copies(folder) if path.startswith("policies")} == {
        "policies/find_ridge.json",
        "policies/find_ridge.pt",
    }


def test_without_a_name_all_examples_are_copied(tmp_path, here):
    assert here(tmp_path, "examples", "copy")[0] == 0
    files = copies(tmp_path)
    assert {f"examples/{name}{file.suffix}" for name, file in example_names().items()} <= files.keys()
    assert not [path for path in files if path.endswith(".pyc")]


def test_changed_files_are_not_overwritten(tmp_path, here):
    assert here(tmp_path, "examples", "copy", "pyramid")[0] == 0
    modified_at = (tmp_path / "examples" / "pyramid.xml").stat().st_mtime_ns
    assert here(tmp_path, "examples", "copy", "pyramid")[0] == 0
    assert (tmp_path / "examples" / "pyramid.xml").stat().st_mtime_ns == modified_at  # equal content is not rewritten
    (tmp_path / "examples" / "pyramid.yaml").write_text("mine")
    code, _, error = here(tmp_path, "examples", "copy", "pyramid", "xhand1_palm")
    assert code == 2 and error.startswith("tgdsl: already there, with other content: examples/pyramid.yaml; ")
    assert (tmp_path / "examples" / "pyramid.yaml").read_text() == "mine" and not (tmp_path / "robots").exists()


def test_an_unknown_example_is_refused(tmp_path, here):
    code, _, error = here(tmp_path, "examples", "copy", "xhand1_pam")
    assert code == 2 and error == 'tgdsl: there is no example "xhand1_pam"; did you mean "xhand1_palm"?\n'
    assert not list(tmp_path.iterdir())


def test_the_list_has_every_document_with_a_summary(tmp_path, here):
    code, out, _ = here(tmp_path, "examples", "list")
    rows = dict(line.split(None, 1) for line in out.partition("\n\n")[0].splitlines())
    documents = (REPOSITORY / "examples").rglob("*.yaml")
    assert (
        code == 0
        and {file.relative_to(REPOSITORY / "examples").with_suffix("").as_posix() for file in documents} <= rows.keys()
    )
    assert rows["tasks/find_ridge"] == "A finger slides over a plate and stops on a ridge, which it can only feel"
    assert "in_palm_rotate_cube" in out.splitlines()[-1]

"""Atomic writes: files have the permissions of a new file, and the process stays unchanged."""

import os
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hand_logs import random_readings, write_log
from joint_scenes import ALL, ROBOT_XML, joint_module

import tgdsl
from tgdsl.errors import FileError
from tgdsl.files.write import atomic_path, atomic_write, atomic_write_all, check_writable, new_folder
from tgdsl.formats.robot import export_model
from tgdsl.runtime.rollout import Recorder


@pytest.fixture(scope="module")
def touch(tmp_path_factory):
    """Return a module, with its scene file next to it."""
    return joint_module(tmp_path_factory.mktemp("scene"), {"policy": ALL})


@pytest.mark.filterwarnings("ignore:.*USD holds no")
@pytest.mark.parametrize("umask", [0o022, 0o027, 0o077])
def test_written_files_have_the_permissions_of_a_new_file(tmp_path, touch, umask):
    (tmp_path / "scene.xml").write_text(ROBOT_XML)
    writers = {
        "a.safetensors": lambda path: tgdsl.save(touch, path),
        "a.npz": lambda path: Recorder(touch, 1, 1).write(path, np.zeros((1, 4)), Path("scene.yaml"), list("abcd")),
        "log.npz": lambda path: write_log(path, random_readings(np.arange(3.0))),
        "a.usda": lambda path: export_model(tmp_path / "scene.xml", path),
        "plain": lambda path: path.touch(),
    }
    before = os.umask(umask)
    try:
        for name, write in writers.items():
            write(tmp_path / name)
    finally:
        os.umask(before)
    assert {name: (tmp_path / name).stat().st_mode & 0o777 for name in writers} == dict.fromkeys(writers, 0o666 & ~umask)


def test_the_process_keeps_its_umask(tmp_path, monkeypatch):
    """All threads share the umask: changing it briefly would affect other files."""

    def refuse(mask):
        raise AssertionError("the umask was changed")

    monkeypatch.setattr(os, "umask", refuse)
    atomic_write(tmp_path / "a.txt", b"text")
    write_log(tmp_path / "a.npz", random_readings(np.arange(3.0)))
    assert (tmp_path / "a.txt").read_bytes() == b"text"


def test_a_file_is_replaced_only_on_success(tmp_path):
    target = tmp_path / "a.txt"
    target.write_text("old")

    def fail_half_way():
        with atomic_path(target) as temporary:
            temporary.write_text("half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_half_way()
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert target.read_text() == "old"
    with atomic_path(target) as temporary:
        assert (temporary.parent, temporary.suffix) == (tmp_path, ".txt")
        temporary.write_text("new")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert target.read_text() == "new"


def test_files_that_belong_together_appear_together(tmp_path):
    model, mesh = tmp_path / "a.xml", tmp_path / "assets" / "a.obj"
    model.write_text("old")
    (tmp_path / "assets" / "folder.obj").mkdir(parents=True)
    with pytest.raises(FileError, match=r"folder\.obj: this is a folder, expected a file's name$"):
        atomic_write_all({mesh: b"mesh", tmp_path / "assets" / "folder.obj": b"", model: b"new"})
    assert model.read_text() == "old"
    assert [path.name for path in (tmp_path / "assets").iterdir()] == ["folder.obj"]
    atomic_write_all({mesh: b"mesh", model: b"new"})
    assert (model.read_bytes(), mesh.read_bytes()) == (b"new", b"mesh")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a.obj", "a.xml", "assets", "folder.obj"]


@pytest.mark.parametrize("folder", ["assets", "deep/er/assets"])
def test_a_folder_made_for_a_failed_write_is_removed(tmp_path, folder):
    (tmp_path / "a.xml").mkdir()
    with pytest.raises(FileError, match=r"a\.xml: this is a folder"):
        atomic_write_all({tmp_path / "a.xml": b"", tmp_path / folder / "a.obj": b"mesh"})
    assert [path.name for path in tmp_path.iterdir()] == ["a.xml"]


def test_a_folder_with_other_files_stays(tmp_path):
    with suppress(ZeroDivisionError), new_folder(tmp_path / "a" / "b" / "file"):
        (tmp_path / "a" / "other").touch()
        raise ZeroDivisionError
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a", "other"]


def test_check_writable_finds_problems_without_creating_files(tmp_path):
    """Folders may be missing, but existing parts of the path must be folders, and the target must not be one."""
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    before = sorted(tmp_path.rglob("*"))
    for target in (tmp_path / "new", tmp_path / "file", tmp_path / "a" / "b" / "new", tmp_path / "folder" / "new"):
        assert check_writable(target) == target
    for target, says in (
        (tmp_path / "file" / "a" / "new", f"{tmp_path / 'file'} is a file, expected a folder"),
        (tmp_path / "folder", "this is a folder, expected a file's name"),
    ):
        with pytest.raises(FileError) as caught:
            check_writable(target)
        assert str(caught.value).startswith(str(target)) and says in str(caught.value)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_librarys_error_is_raised_even_if_it_removed_its_file(tmp_path):
    def fail() -> None:
        with atomic_path(tmp_path / "a.usda") as temporary:
            temporary.unlink()
            raise ValueError("no such format")

    with pytest.raises(ValueError, match="no such format"):
        fail()
    assert list(tmp_path.iterdir()) == []
